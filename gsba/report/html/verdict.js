/* The verdict, its reasons with their frames, and what else was found. */
const MAX_CHIPS = 12;

function verdict() {
  const found = D.report.verdict, card = el("verdict");
  const [title, ...rest] = found.sentence.split(": ");
  card.classList.add({ "good to train": "good", "do not train": "bad" }[found.level] || "look");
  card.append(make("h2", {}, upper(title)), make("p", {}, ...termed(upper(rest.join(": ")))));
  if (found.reasons.length) {
    const list = make("ul", {});
    for (const reason of found.reasons) list.append(make("li", {},
      make("b", {}, upper(reason.cause) + "."), ` What to do: ${reason.remedy}. `, make("div", {}, ...chips(reason.frames)), command(reason.command)));
    card.append(list);
  }
  if (D.report.notes.length) {
    const notes = make("details", {}, make("summary", {}, `What else was found (${D.report.notes.length})`));
    for (const note of D.report.notes) notes.append(make("p", { class: "quiet" }, ...termed(note)));
    card.append(notes);
  }
}

const upper = text => text[0].toUpperCase() + text.slice(1);

/* A command of this run, and a button that copies it; the run's folder is known where the report lies in it. */
function command(text) {
  if (!text) return "";
  const folder = location.protocol === "file:" ? decodeURIComponent(location.pathname.replace(/\/[^/]*$/, "")) : "RUN";
  const line = text.replace("RUN", /^[\w./-]+$/.test(folder) ? folder : `'${folder.replaceAll("'", "'\\''")}'`);
  const code = make("code", {}, ...line.split(/(\s+)/).map(word => word.startsWith("-") ? make("span", { class: "option" }, word) : word)), button = make("button", { type: "button" }, "Copy");
  button.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(line);
      button.textContent = "Copied";
    } catch { getSelection().selectAllChildren(code); }
  });
  return make("p", { class: "command" }, code, " ", button);
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
