"use strict";
// The start of a run: what was chosen, a look at it, a preset, and Start.

const FIRST_FIELDS = ["trajectory", "camera", "masks"]; // of the folded options; the others follow

async function startPage(path) {
  const about = make("div"), form = make("div"), own = view;
  show(make("h1", {}, path), about, form);
  about.replaceChildren(make("p", { class: "faint", role: "status" }, `Reading ${path} …`));
  let found;
  try {
    found = await ask(`api/info?path=${encodeURIComponent(path)}`);
  } catch (error) {
    if (own === view) failure(about, error);
    return;
  }
  if (own !== view) return;
  const facts = make("dl");
  for (const [name, text] of Object.entries(found.facts)) facts.append(make("dt", {}, name), make("dd", {}, text));
  about.replaceChildren(make("div", { class: "two" }, lookAround(path, found.facts.layout || ""),
    card("What it is", facts, found.problem ? make("p", { class: "error", role: "alert" }, found.problem) : null, wayOut(path, found.problem))));
  if (found.problem) return;
  const name = path.split("/").pop().replace(/\.[^.]*$/, "") || "run";
  form.replaceChildren(runForm({ frames: path, out: `${name}-run` }));
}

// The folder of a single image, which alone cannot be refined.
function wayOut(path, problem) {
  if (!/ is one image: /.test(problem || "")) return null;
  const folder = path.split("/").slice(0, -1).join("/") || ".";
  return make("a", { href: open("start", folder) }, folder === "." ? "Use all images beside it" : `Use all images of ${folder}`);
}

function lookAround(path, layout) {
  const shown = panoramaView(`A look at ${path}`), turnable = layout.startsWith("stitched");
  const slider = make("input", { type: "range", min: "0", max: "1", step: "0.05", value: "0.1", "aria-label": "Place in the recording" });
  const load = () => shown.load(picture(path, `&at=${slider.value}`), turnable, turnable ? "Drag to look around." : "Raw lenses, as they were recorded.");
  slider.addEventListener("change", load);
  load();
  return card("Look around", shown.figure, slider);
}

function runForm(values) {
  const form = start.forms.refine, { line, problem, row, changed, submit } = commandLine("refine", values);
  const field = (name) => form.fields.find((one) => one.name === name);
  const shown = ["frames", "config", "out", ...FIRST_FIELDS];
  const rest = form.fields.filter((one) => !shown.includes(one.name));
  const whole = make("form", { onsubmit: submit },
    card("How carefully", presets(values, changed), input(field("out"), values, changed, "Name of the run"), problem, row,
      make("p", { class: "faint" }, `This command runs in ${start.root}. The terminal does the same with it.`), line),
    make("details", { class: "card" }, make("summary", {}, "Options: trajectory, camera, masks and all others"),
      ...FIRST_FIELDS.map((name) => input(field(name), values, changed)),
      input(field("config"), values, changed), ...rest.map((one) => input(one, values, changed))));
  changed();
  return whole;
}

function presets(values, changed) {
  const about = Object.fromEntries(start.choices.presets);
  const one = (name, label, help) => make("label", { class: "choice" },
    make("input", {
      type: "radio", name: "preset", value: name, checked: (values.config || "") === name,
      onchange: () => {
        values.config = name;
        const box = document.getElementById("field-config");
        if (box) box.value = name;
        changed();
      },
    }), make("span", {}, make("strong", {}, label), " ", make("span", { class: "faint" }, help)));
  return make("fieldset", { class: "presets" }, make("legend", { class: "unseen" }, "Preset"),
    one("fast", "Fast", `A first look in less time. ${about.fast || ""}`), one("", "Normal", "What most footage needs: the defaults."),
    one("accurate", "Accurate", `Slower. ${about.accurate || ""}`));
}
