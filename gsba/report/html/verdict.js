/* The verdict, its reasons with their frames, and what else was found. */
const MAX_CHIPS = 12;

function verdict() {
  const found = D.report.verdict, card = el("verdict");
  const [title, ...rest] = found.sentence.split(": ");
  card.classList.add({ "good to train": "good", "do not train": "bad" }[found.level] || "look");
  card.append(make("h2", {}, title[0].toUpperCase() + title.slice(1)), make("p", {}, ...termed(rest.join(": "))));
  if (found.reasons.length) {
    const list = make("ul", {});
    for (const reason of found.reasons) list.append(make("li", {},
      make("b", {}, reason.cause[0].toUpperCase() + reason.cause.slice(1) + "."), ` What to do: ${reason.remedy}. `, ...chips(reason.frames)));
    card.append(list);
  }
  if (D.report.notes.length) {
    const notes = make("details", {}, make("summary", {}, `What else was found (${D.report.notes.length})`));
    for (const note of D.report.notes) notes.append(make("p", { class: "quiet" }, ...termed(note)));
    card.append(notes);
  }
}

/* Names of frames; to point at one, or to reach it by the keyboard, marks it everywhere. */
function chips(names) {
  const shown = names.slice(0, MAX_CHIPS).map(name => {
    const f = F.name.indexOf(name);
    if (f < 0) return make("span", { class: "chip" }, name);
    const chip = make("button", { type: "button", class: "chip", "aria-label": `mark frame ${name}` }, P.shown.includes(f) ? make("img", { src: jpeg(P.shown.indexOf(f)), alt: "" }) : null, name);
    for (const event of ["pointerenter", "focus"]) chip.addEventListener(event, () => mark(f));
    for (const event of ["pointerleave", "blur"]) chip.addEventListener(event, () => mark(-1));
    return chip;
  });
  const more = names.length - shown.length;
  return more > 0 ? [...shown, make("span", { class: "quiet" }, `and ${more} more, in report.json`)] : shown;
}
