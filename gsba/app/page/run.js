"use strict";
// A finished run: its verdict, datasets, pictures and figures.

const TRAINERS = {
  inria: "INRIA 3DGS", postshot: "Postshot", brush: "Brush", lichtfeld: "LichtFeld Studio", gsplat: "gsplat",
  "3dgrut": "3DGRUT", opensplat: "OpenSplat", nerfstudio: "Nerfstudio", "instant-ngp": "instant-ngp",
  "3dgs-deblur": "3DGS deblur", blender: "Blender",
};

async function results(where, run, current) {
  const found = await ask(`api/run?path=${encodeURIComponent(run)}`);
  if (!current()) return;
  if (!found.finished) {
    where.replaceChildren(card("", `${run} has no report yet.`));
    return;
  }
  const summary = found.summary, message = make("p", { role: "status" });
  const facts = make("dl", {});
  for (const [name, text] of figures(found)) facts.append(make("dt", {}, name), make("dd", {}, text));
  const viewer = make("button", {
    class: "main", type: "button",
    onclick: async () => {
      message.textContent = "Loading the viewer …";
      try {
        const { address } = await ask("api/view", { path: run });
        message.replaceChildren("The viewer is at ", make("a", { href: address, target: "_blank", rel: "noopener" }, address));
        window.open(address, "_blank", "noopener");
      } catch (error) {
        message.textContent = error.message;
      }
    },
  }, "Open the viewer");
  const add = (command, values) => async () => {
    try {
      location.hash = open("job", (await ask("api/add", { command, values })).id);
    } catch (error) {
      message.textContent = error.message;
    }
  };
  const button = (text, onclick, title = "", kind = "") => make("button", { type: "button", class: kind, title, onclick }, text);
  const choices = datasetChoices(found);
  const dataset = (to, text) => {
    const made = button(text, () => add("export", { run, to, up: "auto", ...choices.values() })());
    choices.follow((options) => { made.title = `gsba export ${quoted(run)} --to ${to} --up auto${options}`; });
    return made;
  };
  const report = make("a", { href: link(`${run}/report.html`), target: "_blank", rel: "noopener" }, "Report");
  const level = found.verdict ? found.verdict.level : "";
  where.replaceChildren(
    verdictCard(found),
    card("Dataset for your trainer",
      level === "stop" ? make("p", { class: "error" }, "The verdict is: do not train. A dataset of this map wastes the training.") : null,
      ...choices.fields,
      make("div", { class: "row" }, ...start.choices.programs.map((to) => dataset(to, TRAINERS[to] || to))),
      make("details", {}, make("summary", {}, "Other formats"),
        make("div", { class: "row" }, ...start.choices.formats.map((to) => dataset(to, to)))),
      make("p", { class: "faint" }, `Datasets are written into ${run}, and stand upright.`)),
    card("Look at it", make("div", { class: "row" }, viewer, report,
      button("Plot", add("plot", { runs: [run], out: `${run}/figures` })),
      make("a", { href: `#compare/${encodeURIComponent(run)}` }, "Compare")),
    message, facts,
    found.notes.length ? make("details", {}, make("summary", {}, `Notes (${found.notes.length})`),
      make("ul", {}, ...found.notes.map((note) => make("li", {}, note)))) : null,
    make("p", { class: "row" }, ...found.files.slice(1).map((name) => make("a", { href: link(`${run}/${name}`) }, name)))),
    growing(run, found),
    found.figures.length ? figureCard(found.figures.map((name) => `${run}/figures/${name}`)) : "");
}

// Fields of what a dataset holds, where there is a choice: the map, and frames in doubt. `values` gives their values;
// `follow` calls `told` now and at each change with the options of the command line that they stand for.
function datasetChoices(found) {
  const sizes = found.map_sizes, doubted = found.verdict ? found.verdict.doubted : [];
  const map = make("select", { id: "map-number" }, ...sizes.map((frames, n) => make("option", { value: String(n + 1) }, `${n + 1}: ${frames} frames`)));
  const without = make("input", { type: "checkbox", id: "without", checked: doubted.length > 0 });
  const values = () => ({
    ...(map.value > 1 ? { map_number: map.value } : doubted.length && without.checked ? { without: ["doubted"] } : {}),
  });
  const options = () => {
    const { map_number: number, without: left } = values();
    return (number ? ` --map ${number}` : "") + (left ? ` --without ${left}` : "");
  };
  map.addEventListener("change", () => { without.disabled = map.value > 1; });
  const follow = (told) => {
    told(options());
    for (const field of [map, without]) field.addEventListener("change", () => told(options()));
  };
  return {
    values,
    follow,
    fields: [
      sizes.length > 1 ? make("p", {}, make("label", {}, "Map ", map)) : null,
      doubted.length ? make("p", {}, make("label", {}, without, " Leave out frames in doubt: "), make("span", { class: "faint" }, doubted.slice(0, 6).join(", ") + (doubted.length > 6 ? ` and ${doubted.length - 6} more` : ""))) : null,
    ],
  };
}

// The verdict in one sentence; runs of earlier versions have none.
function verdictCard(found) {
  const counts = found.counts;
  if (!found.verdict) return card(counts);
  const { level, sentence, reasons } = found.verdict, title = { good: "Good to train", look: "Look at these places", stop: "Do not train" };
  return make("section", { class: `card verdict ${level}` }, make("h2", {}, title[level] || "Verdict"),
    make("p", {}, sentence), reasons.length ? make("ul", {}, ...reasons.map((reason) => make("li", {}, reason))) : null,
    make("p", { class: "faint" }, counts));
}

function figureCard(paths) {
  return card("Figures", ...paths.map((path) => make("img", { src: link(path), alt: path.split("/").pop(), loading: "lazy" })));
}

function degrees(angle) {
  return angle === null ? "none" : `${angle.toPrecision(3)}°`; // rotations only: there are no points
}

function figures(found) {
  const summary = found.summary, camera = found.camera;
  const rows = [
    ["points", String(summary.points)],
    ["median residual", `${degrees(summary.median_residual_deg)} (before: ${degrees(summary.median_residual_deg_coarse)})`],
    ["maps", String(summary.maps)],
    ["time of all stages", spoken(summary.seconds)],
  ];
  if (camera && camera.taken) {
    rows.push(["lenses", `${camera.baseline.toPrecision(3)} map units apart`]);
    const readout = camera.readout;
    if (readout && readout.taken && readout.ms) {
      rows.push(["readout", `${readout.ms.toFixed(1)} ms (sigma ${readout.ms_sigma.toFixed(1)})`]);
    }
  }
  return rows;
}

function runPage(run) {
  const where = make("div"), seen = places(() => run);
  show(make("h1", {}, run), where, make("div", { class: "two" }, seen.plan, seen.looks));
  const own = view, current = () => own === view;
  results(where, run, current).catch((error) => failure(where, error));
  ask(`api/run/map?path=${encodeURIComponent(run)}`).then((map) => current() && seen.show(map)).catch(() => undefined);
}

// Cards of the path from above, and of the panorama of the frame that is chosen on it; `runOf` gives the run's folder.
function places(runOf) {
  const canvas = make("canvas", { role: "img", class: "pointed" }), caption = make("p", { class: "faint" });
  const slider = make("input", { type: "range", id: "frame", min: "0", value: "0" }), shown = panoramaView("Panorama of the chosen frame");
  const choice = make("label", { for: "frame" }, "Frame: click the map, or move here", slider);
  const plan = card("From above", canvas, choice, caption), looks = card("What the camera saw there", shown.figure);
  let map = null, timer = 0, address = "";
  const choose = (frame) => {
    slider.value = String(frame);
    drawPlan(canvas, map, frame);
    const next = picture(runOf(), `&frame=${frame}`);
    if (next === address) return;
    address = next;
    clearTimeout(timer); // a slider passes many frames
    timer = setTimeout(() => shown.load(next, true, `Frame ${frame + 1} of ${map.path.length}${map.path[frame] ? "" : ", not in the map"}`), 150);
  };
  slider.addEventListener("input", () => choose(Number(slider.value)));
  canvas.addEventListener("click", (happening) => {
    const frame = nearestOnPlan(canvas, happening.offsetX, happening.offsetY);
    if (frame >= 0 && !looks.hidden) choose(frame);
  });
  // Keyframes of the odometry are not files yet: they have no pictures.
  const update = (newest, text = "") => {
    map = newest;
    caption.textContent = text;
    looks.hidden = choice.hidden = !map.path.length || map.stage === "odometry";
    slider.max = String(Math.max(map.path.length - 1, 0));
    if (looks.hidden) drawPlan(canvas, map); else choose(Math.min(Number(slider.value), map.path.length - 1));
  };
  looks.hidden = choice.hidden = true;
  return { plan, looks, show: update };
}
