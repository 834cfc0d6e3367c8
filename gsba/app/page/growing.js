"use strict";
// A finished run that grows: recordings added or taken out, runs merged, pictures localised.

// Card of a finished run, by what `api/run` says of it.
function growing(run, found) {
  const where = make("div"), chooser = make("div");
  const begin = (command, values, hidden) => {
    chooser.replaceChildren();
    where.replaceChildren(commandForm(command, values, hidden));
    where.scrollIntoView({ block: "nearest" });
  };
  const pick = (title, onPick) => () => {
    const list = make("div");
    where.replaceChildren();
    chooser.replaceChildren(make("p", { class: "faint" }, title), list);
    choose(list, "", onPick);
  };
  const add = pick("Choose a video, or a folder of frames, of the same place.", (path) =>
    begin("add", { run, new: [path] }, ["run"]));
  const merge = pick("Choose another finished run of the same place.", (path, kind) => {
    if (kind !== "run" || path === run) {
      where.replaceChildren(make("p", { class: "error", role: "alert" },
        kind === "run" ? `${path} is this run` : `${path} is no run`));
      return;
    }
    begin("merge", { runs: [run, path], out: `${run}-${path.split("/").pop()}` }, []);
  });
  const localize = pick("Choose pictures of the same place: a file, a folder or a video.", (path) =>
    begin("localize", { run, images: [path] }, ["run"]));
  const button = (text, onclick) => make("button", { type: "button", onclick }, text);
  const names = found.recordings.length > 1 ? found.recordings : [];
  return card("Grow", make("div", { class: "row" }, button("Add a recording", add), button("Merge with a run", merge),
    button("Localise pictures", localize),
    ...names.map((name) => button(`Take out ${name}`, () => begin("remove", { run, names: [name] }, ["run"])))),
    make("p", { class: "faint" }, `It starts from the map of ${run}. Without a folder of its own the result takes its place, and ${run} is kept as ${run}-before.`),
    chooser, where);
}

// Form of a command, its line, and the button that starts it; fields with values are shown first.
function commandForm(command, values, hidden) {
  const { line, problem, row, changed, submit } = commandLine(command, values);
  const fields = start.forms[command].fields.filter((field) => !hidden.includes(field.name));
  const main = (field) => field.name in values || field.required || ["out", "fixed", "rigid"].includes(field.name);
  const rest = fields.filter((field) => !main(field));
  const whole = make("form", { onsubmit: submit },
    ...fields.filter(main).map((field) => input(field, values, changed)),
    rest.length ? make("details", {}, make("summary", {}, "All options"),
      ...rest.map((field) => input(field, values, changed))) : null,
    line, problem, row);
  changed();
  return whole;
}
