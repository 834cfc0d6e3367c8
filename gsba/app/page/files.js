"use strict";
// Lists of files: pictures and facts arrive later, for the rows in sight.

const FACTS_MS = 400; // between two questions about rows in sight
const LEVELS = { good: "good to train", look: "look at some places", stop: "do not train" };
let dropFolder = ""; // folder of the list that is shown: dropped files go there

// Rows of a folder as buttons; `onPick` gets an entry.
function fileList(entries, onPick) {
  const list = make("ul", { class: "plain files" }), rows = new Map(), inSight = new Set();
  const watch = new IntersectionObserver((seen) => seen.forEach(({ target, isIntersecting }) =>
    isIntersecting ? inSight.add(target.dataset.path) : inSight.delete(target.dataset.path)), { rootMargin: "200px" });
  for (const one of entries) {
    const shot = make("span", { class: "shot" }), facts = make("span", { class: "facts" });
    const size = one.size === null || one.size === undefined ? "" : bytes(one.size);
    const row = make("li", {}, make("button", { type: "button", onclick: () => onPick(one) }, shot,
      make("span", { class: "about" }, make("span", { class: "name" }, one.name), " ", facts),
      make("span", { class: "kind" }, ` ${one.kind} ${size}`)));
    list.append(row);
    if (one.kind === "file") continue;
    row.dataset.path = one.path;
    rows.set(one.path, { shot, facts });
    watch.observe(row);
  }
  fillInSight(rows, inSight, watch);
  return list;
}

async function fillInSight(rows, inSight, watch) {
  const own = view, pictures = new Set();
  while (own === view && rows.size) {
    await new Promise((done) => setTimeout(done, FACTS_MS));
    const paths = [...inSight].filter((path) => rows.has(path));
    if (own !== view || !paths.length || document.hidden) continue;
    let about;
    try {
      ({ about } = await ask("api/about", { paths }));
    } catch {
      continue;
    }
    for (const [path, found] of Object.entries(about)) {
      const row = rows.get(path);
      if (found.picture && !pictures.has(path)) {
        pictures.add(path);
        row.shot.append(make("img", { src: picture(path), alt: "", loading: "lazy" }));
      }
      if (found.facts || found.problem) row.facts.replaceChildren(...shortFacts(found));
      if (!found.pending) rows.delete(path);
    }
  }
  watch.disconnect();
}

// Facts of `gsba info` in one or two lines.
function shortFacts({ facts, problem }) {
  const known = facts || {}, lines = [];
  const first = [known.camera, known.layout || known.size, lengthOf(known.frames), known.refined].filter(Boolean).join(" · ");
  if (known.verdict) lines.push(make("span", { class: `level ${known.verdict}` }, LEVELS[known.verdict] || known.verdict));
  if (known.state) lines.push(make("span", {}, known.state));
  if (first) lines.push(make("span", {}, first));
  const sensors = ["gyro", "GPS"].filter((name) => known[name]).map((name) => sensor(name, known[name]));
  if (sensors.length) lines.push(make("span", {}, sensors.join(" · ")));
  // A single image is no fault of a list; other problems are said where they are seen first.
  if (problem && !/ is one image: /.test(problem)) lines.push(make("span", { class: "error" }, problem));
  return lines;
}
// "60, 8 a second, 7.5 s" of a video as "7.5 s, 60 frames"; frames without times have no length.
function lengthOf(text) {
  if (!text) return "";
  const parts = text.split(", "), last = parts[parts.length - 1];
  return `${/ (s|min)\b/.test(last) ? `${last}, ` : ""}${parts[0]} frames`;
}
function sensor(name, text) {
  if (/not checked|pip install/.test(text)) return `${name}: not checked`;
  return text.startsWith("none") ? `no ${name}` : `${name}: ${text}`;
}

// Chooser of a path within a form; `onPick` gets its path and its kind.
async function choose(where, path, onPick) {
  let found;
  try {
    found = await ask(`api/browse?path=${encodeURIComponent(path)}`);
  } catch (error) {
    failure(where, error);
    return;
  }
  const up = found.parent === null ? [] : [{ name: "..", path: found.parent, kind: "folder" }];
  const pick = (one) => (one.kind === "folder" || one.kind === "run" ? choose(where, one.path, onPick) : onPick(one.path, one.kind));
  const whole = found.images ? `Take this folder (${found.images} images)` : "Take this folder";
  const list = fileList([...up, ...found.entries], pick);
  list.classList.add("low");
  where.replaceChildren(
    make("div", { class: "row" },
      make("strong", {}, found.path === "." ? "Folder of the page" : found.path),
      make("button", { type: "button", onclick: () => onPick(found.path, found.kind) }, whole)),
    list, leftOut(found));
}
function leftOut(found) {
  return found.left_out ? make("p", { class: "faint" }, `${found.left_out} more are not shown`) : "";
}

// The first view: what is in the folder, and where to drop more.
async function footage(path) {
  const where = make("div"), own = view;
  dropFolder = path;
  const title = path && path !== "." ? path : "Footage and runs";
  show(make("h1", {}, title), dropCard(), where);
  let found;
  try {
    found = await ask(`api/browse?path=${encodeURIComponent(path)}`);
  } catch (error) {
    if (own === view) failure(where, error);
    return;
  }
  if (own !== view) return;
  if (found.kind === "run") {
    location.replace(open("run", found.path));
    return;
  }
  const go = (one) => {
    const to = { folder: "files", run: "run", video: "start", image: "start", file: "start" }[one.kind];
    location.hash = open(to, one.path);
  };
  const up = found.parent === null ? null : make("a", { href: open("files", found.parent) }, "One folder up");
  const use = (kind, text) => make("button", { type: "button", class: kind, onclick: () => { location.hash = open("start", found.path); } }, text);
  const inner = found.parent !== null && found.entries.some((one) => one.kind === "folder");
  const whole = found.images ? use("main", `Use these ${found.images} images`)
    : inner ? use("", "Use this folder, with a folder for each lens or recording") : null;
  const bar = make("div", { class: "row" }, up, whole);
  where.replaceChildren(...unfinishedCards(found),
    found.entries.length ? card("", bar, fileList(found.entries, go), leftOut(found)) : make("div", {}, bar, lesson()));
}

// What to do with an empty folder.
function lesson() {
  const step = (title, text) => make("li", {}, make("strong", {}, title), " ", text);
  return card("Nothing is here yet. This is the way:", make("ol", { class: "steps" },
    step("Film.", "Walk slowly through the place with the 360° camera above your head, and come back to where you began. Video of 4K or more, or a picture each half metre."),
    step("Drop.", "Drop the camera's files onto this page: stitched (.mp4, 2:1) or raw (.insv, .360, two fisheyes). They are copied into the folder of this page."),
    step("Start.", "Choose the video in the list and press Start. A minute of video takes some minutes."),
    step("Train.", "When the verdict is good, press the name of your trainer: that writes its dataset.")),
    make("p", { class: "faint" }, `Footage that lies elsewhere is not copied if you start gsba app in its folder. This page shows ${start.root}.`));
}
