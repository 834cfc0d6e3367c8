/* Terms of docs/glossary.md that this page uses: where they stand, they link to the list at its end. */
const TERMS = {
  carrier: "Who or what holds the camera, and fills a part of every picture",
  covariance: "Uncertainty of a pose, 6 × 6: rotation in radians, then position; the marginal one counts in all others",
  gate: "Largest residual, in standard deviations, of an observation that is kept",
  gauge: "Position, rotation and scale of a map's world, which images leave open: seven numbers",
  "loop closure": "Tying frames that show one place again, after drift",
  "map unit": "Unit of length of a map's world: of the trajectory that it started from; arbitrary without one, metres by GPS",
  "rolling shutter": "Rows are read one after another within the readout time, while the camera moves",
  "stitching field": "How far stitching bends bearings, as a smooth function on the sphere",
  strength: "How firmly images hold scale and positions along a map, foretold from its points before more are matched",
  σ: "Standard deviation: the error of two in three values is below it, of 95 in a hundred below its double",
  baseline: "Distance between the two lenses' centres",
  family: "Residuals of one kind: bearings, reprojection, patches, pixels, splat, GPS, or your own",
};

/* A text as nodes, its terms as links. */
function termed(text) {
  return text.split(new RegExp(`(?<!\\w)((?:${Object.keys(TERMS).join("|")})s?)(?!\\w)`, "i")).map((part, i) => {
    const term = part.toLowerCase().replace(/s$/, "");
    return i % 2 ? make("a", { href: `#term-${term}`, title: TERMS[term] }, part) : part;
  });
}
/* Texts of the page, written before this: their terms become links. */
function linkTerms() {
  for (const text of document.querySelectorAll("main .lead, .row b")) for (const node of [...text.childNodes])
    if (node.nodeType === Node.TEXT_NODE) node.replaceWith(...termed(node.data));
}
function terms() {
  for (const [term, meaning] of Object.entries(TERMS).sort()) el("terms").append(make("dt", { id: `term-${term}` }, term), make("dd", { class: "quiet" }, meaning));
}
