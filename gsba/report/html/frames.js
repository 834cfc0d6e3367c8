/* Frames as small panoramas: the one pointed at, and two neighbours with their matches. */
const P = D.pictures, MAX_STRIP = 9;
const drawn = { mask: true, seam: true, matches: true };
let chosen = 0;

/* Pictures are decoded when they are first drawn. */
const images = {};
function image(kind, number, address) {
  const key = `${kind}${number}`;
  if (!images[key]) {
    images[key] = make("img", { src: address, alt: "" });
    images[key].addEventListener("load", redraw);
  }
  return images[key];
}
const jpeg = k => `data:image/jpeg;base64,${P.jpegs[k]}`;
/* Number of the picture nearest to a frame: long runs show some frames only. */
function nearest(f) {
  let low = 0, high = P.shown.length - 1;
  while (low < high) { const middle = (low + high) >> 1; if (P.shown[middle] < f) low = middle + 1; else high = middle; }
  return low > 0 && f - P.shown[low - 1] < P.shown[low] - f ? low - 1 : low;
}

/* A frame's picture in a box, with its mask, and the seam and circles of its lenses. */
function paint(g, f, x, y, width, height) {
  const k = nearest(f), whole = image("p", k, jpeg(k));
  g.fillStyle = css("--grid"); g.fillRect(x, y, width, height);
  if (whole.complete && whole.naturalWidth) g.drawImage(whole, x, y, width, height);
  if (drawn.mask && P.mask[k] >= 0) {
    const mask = image("m", P.mask[k], `data:image/png;base64,${P.masks[P.mask[k]]}`);
    if (mask.complete && mask.naturalWidth) g.drawImage(mask, x, y, width, height);
  }
  if (!drawn.seam) return;
  const camera = P.cameras[f];
  for (const [lines, colour] of [[P.seams[camera], "--before"], [P.circles[camera], "--after"]]) for (const line of lines) {
    g.strokeStyle = css(colour); g.lineWidth = 1.2; g.beginPath();
    let last = null; // a line breaks where it leaves the picture at one side and comes back at the other
    for (const [u, v] of line) {
      if (u === null || v === null) { last = null; continue; }
      if (last === null || Math.abs(u - last) > .45) g.moveTo(x + u * width, y + v * height); else g.lineTo(x + u * width, y + v * height);
      last = u;
    }
    g.stroke();
  }
}

/* Matches of a frame with the next one, rows of [u, v, u, v, residual in degrees]. */
const packed = new DataView(Uint8Array.from(atob(P.matches.data), c => c.charCodeAt(0)).buffer);
const firstMatch = P.matches.counts.reduce((sums, n) => { sums.push(sums[sums.length - 1] + n); return sums; }, [0]);
function matches(f) {
  const rows = [];
  for (let row = firstMatch[f]; row < firstMatch[f + 1]; row++)
    rows.push([0, 1, 2, 3, 4].map(k => packed.getUint16(10 * row + 2 * k, true) / (k < 4 ? 65535 : 1000)));
  return rows;
}
function drawPair(g, width, height) {
  const f = Math.min(chosen, Math.max(N - 2, 0)), half = (height - 6) / 2;
  paint(g, f, 0, 0, width, half);
  if (f + 1 >= N) return;
  paint(g, f + 1, 0, half + 6, width, half);
  if (!drawn.matches) return;
  const rows = matches(f), sizes = rows.map(row => row[4]).sort((a, b) => a - b), limit = 3 * sizes[sizes.length >> 1];
  for (const [u0, v0, u1, v1, size] of rows) {
    // The end goes the short way round; what leaves the picture is drawn at the other side, too.
    const turn = Math.round(u0 - u1);
    g.strokeStyle = g.fillStyle = size > limit ? "#ff5a4f" : "#7ee0ff"; g.lineWidth = size > limit ? 1.8 : 1; g.globalAlpha = .85;
    for (const shift of turn ? [0, -turn] : [0]) {
      g.beginPath(); g.moveTo((u0 + shift) * width, v0 * half); g.lineTo((u1 + turn + shift) * width, half + 6 + v1 * half); g.stroke();
    }
    for (const [u, v, top] of [[u0, v0, 0], [u1, v1, half + 6]]) { g.beginPath(); g.arc(u * width, top + v * half, 2.4, 0, 7); g.fill(); }
  }
  g.globalAlpha = 1;
}

function chooseFrame(f) {
  chosen = Math.max(0, Math.min(N - 1, f));
  el("frame").value = chosen;
  const next = Math.min(chosen, Math.max(N - 2, 0)), rows = next + 1 < N ? matches(next).map(row => row[4]).sort((a, b) => a - b) : [];
  const other = P.shown[nearest(next)] === next ? "" : ` Pictures of every frame would make this page too large: this is that of ${F.name[P.shown[nearest(next)]]}.`;
  el("pair-text").textContent = next + 1 < N ? `${F.name[next]} and ${F.name[next + 1]}: ${num(P.matches.shared[next])} points in common` +
    (rows.length ? `, residual of those drawn ${residualText(rows[rows.length >> 1])} in the median, ${residualText(rows[rows.length - 1])} at most.` : ".") + other : `${F.name[next]} is the only frame.`;
  fillStrip();
  redraw();
}
function fillStrip() {
  const middle = nearest(chosen), most = Math.min(MAX_STRIP, P.shown.length);
  const first = Math.max(0, Math.min(middle - (most >> 1), P.shown.length - most));
  el("strip").replaceChildren(...Array.from({ length: most }, (_, i) => {
    const k = first + i, f = P.shown[k], button = make("button", { type: "button", "aria-label": `Frame ${F.name[f]}`, "aria-pressed": String(k === middle) },
      make("img", { src: jpeg(k), alt: "" }));
    button.addEventListener("click", () => chooseFrame(f));
    button.addEventListener("pointerenter", () => mark(f));
    button.addEventListener("pointerleave", () => mark(-1));
    return button;
  }));
}

function pictures() {
  if (!P.shown.length) {
    el("pictures").remove();
    el("pointed-card").remove();
    return;
  }
  const has = { mask: P.masks.length, seam: P.seams.concat(P.circles).some(lines => lines.length), matches: 1 };
  const names = { mask: "masked", seam: "seam, and edges of the lenses' pictures", matches: "matches" };
  for (const key of Object.keys(names).filter(one => has[one])) {
    const box = make("input", { type: "checkbox", checked: "" });
    box.addEventListener("change", () => { drawn[key] = box.checked; redraw(); });
    el("pictures-legend").append(make("label", {}, box, names[key]));
  }
  let told = -1; // frame whose text is shown
  surface(el("pointed"), (g, width, height) => {
    const f = marked >= 0 ? marked : chosen;
    paint(g, f, 0, 0, width, height);
    if (f === told) return;
    told = f;
    const k = P.shown[nearest(f)];
    el("pointed-text").textContent = describe(f) + (k === f ? "" : `\npicture of ${F.name[k]}`);
  });
  surface(el("pair"), drawPair);
  el("frame").setAttribute("max", N - 1);
  el("frame").addEventListener("input", () => chooseFrame(Number(el("frame").value)));
  el("top").addEventListener("click", () => { if (marked >= 0) chooseFrame(marked); });
  const worstFrame = D.worst.length ? D.worst[0].frame : 0;
  chooseFrame(worstFrame);
}
