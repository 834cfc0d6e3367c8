"use strict";
// Forms of commands: fields, the line that they make, and the button that starts it.

// The line of a command by values of its form, its problem, and the button that starts it.
function commandLine(command, values) {
  const line = make("pre", { class: "command", id: "command" });
  const problem = make("p", { class: "error", role: "alert" });
  const button = make("button", { class: "main", type: "submit" }, "Start");
  let newest = 0; // answers may arrive in another order than their questions
  const changed = async () => {
    const own = ++newest;
    let answer;
    try {
      answer = await ask("api/command", { command, values: filled(values) });
    } catch (error) {
      answer = { command: "", error: error.message };
    }
    if (own !== newest) return;
    line.replaceChildren(...words(answer.command));
    problem.textContent = answer.error;
    button.disabled = Boolean(answer.error);
  };
  const submit = async (happening) => {
    happening.preventDefault();
    button.disabled = true;
    try {
      const job = await ask("api/add", { command, values: filled(values) });
      location.hash = open("job", job.id);
    } catch (error) {
      problem.textContent = error.message;
      button.disabled = false;
    }
  };
  const copy = make("button", { type: "button", onclick: () => copied(line.textContent, copy) }, "Copy");
  return { line, problem, row: make("div", { class: "row" }, button, copy), changed, submit };
}

function filled(values) {
  const empty = (value) => value === "" || value === false || (Array.isArray(value) && !value.length);
  return Object.fromEntries(Object.entries(values).filter(([, value]) => !empty(value)));
}

async function copied(text, button) {
  try {
    await navigator.clipboard.writeText(text);
    button.textContent = "Copied";
  } catch {
    button.textContent = "Select the line and copy it";
  }
}

function input(field, values, changed, name = "") {
  const id = `field-${field.name}`, label = field.option || (field.metavar || field.name);
  const title = name || label.replace(/^--/, "").replace(/-/g, " ");
  const help = make("span", { class: "help", id: `${id}-help` }, field.help);
  const many = field.repeatable || field.parts > 1;
  if (field.kind === "flag") {
    const box = make("input", { type: "checkbox", id, onchange: () => { values[field.name] = box.checked; changed(); } });
    return make("div", { class: "field" }, make("label", {}, box, " ", title), help);
  }
  const shown = values[field.name] || "";
  const box = make("input", {
    id, value: Array.isArray(shown) ? shown.map(quoted).join(" ") : shown, autocomplete: "off", spellcheck: false,
    "aria-describedby": `${id}-help`, placeholder: field.metavar || "",
    ...(field.kind === "number" ? { inputmode: "decimal" } : {}),
  });
  const take = () => {
    const text = box.value.trim();
    values[field.name] = many ? split(text) : text;
    changed();
  };
  box.addEventListener("change", take);
  box.addEventListener("input", take);
  const known = suggestions(field.name);
  const list = known.length ? make("datalist", { id: `${id}-list` },
    ...known.map(([value, text]) => make("option", { value }, text || ""))) : null;
  if (list) box.setAttribute("list", `${id}-list`);
  const chooser = make("div");
  const browse = field.kind !== "path" || field.name === "out" ? null : make("button", {
    type: "button", "aria-label": `Choose a file for ${title}`,
    onclick: () => choose(chooser, "", (path) => {
      box.value = field.repeatable && box.value ? `${box.value} ${quoted(path)}` : field.repeatable ? quoted(path) : path;
      chooser.replaceChildren();
      take();
    }),
  }, "Choose");
  return make("div", { class: "field" }, make("label", { for: id }, title, list),
    make("div", { class: "pick" }, box, browse), help, chooser);
}

function suggestions(name) {
  const known = start.choices;
  return {
    camera: known.cameras.map((one) => [one]),
    masks: known.masks.map((one) => [one]),
    config: known.presets,
    overrides: known.settings.map(([key, value, allowed]) => [`${key}=${value}`, allowed]),
  }[name] || [];
}

// Words of a line; quotes keep spaces.
function split(text) {
  return [...text.matchAll(/"([^"]*)"|(\S+)/g)].map((found) => found[1] ?? found[2]);
}
const quoted = (text) => (/\s/.test(text) ? `"${text}"` : text);

