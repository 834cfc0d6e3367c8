"use strict";
// The page: views by the part of the address behind #, filled from JSON answers of the server.

const main = document.getElementById("main");
const POLL_MS = 1000;
const ENDED = ["done", "partial", "failed", "stopped", "lost"];
const STATUS = {
  waiting: "waiting", running: "running", stopping: "stopping", done: "done",
  partial: "done, with less than nine tenths of the frames", failed: "failed", stopped: "stopped",
  lost: "ended without a word",
};
const MAIN_FIELDS = ["frames", "trajectory", "camera", "masks", "out"]; // the others are folded
let start = null; // forms and choices
let view = 0; // number of the view that is shown: answers for an earlier one are dropped

// Elements

function make(name, attributes = {}, ...children) {
  const node = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (key in node && typeof value !== "string") node[key] = value;
    else node.setAttribute(key, value);
  }
  node.append(...children.filter((child) => child !== null && child !== undefined));
  return node;
}
const card = (title, ...children) =>
  make("section", { class: "card" }, title ? make("h2", {}, title) : null, ...children);
const badge = (status) => make("span", { class: `badge ${status}` }, STATUS[status] || status);
const show = (...children) => main.replaceChildren(...children.filter(Boolean));
const link = (path) => "files/" + path.split("/").map(encodeURIComponent).join("/");
const open = (kind, name) => `#${kind}/${encodeURIComponent(name)}`;

function spoken(seconds) {
  if (seconds === null || seconds === undefined) return "";
  if (seconds < 100) return `${seconds < 10 ? seconds.toFixed(1) : Math.round(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 100 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

// Requests

async function ask(path, body) {
  const options = body === undefined ? {} : {
    method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body),
  };
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    document.getElementById("offline").hidden = false;
    throw new Error("the server does not answer");
  }
  document.getElementById("offline").hidden = true;
  const kind = answer.headers.get("content-type") || "";
  if (!kind.includes("json")) {
    const text = await answer.text();
    if (!answer.ok) throw new Error(text);
    return text;
  }
  const content = await answer.json();
  if (!answer.ok) throw new Error(content.error || answer.statusText);
  return content;
}

// Call `look` now and every second, until another view is shown or it returns false.
async function follow(look) {
  const own = view;
  while (own === view) {
    let more = true;
    try {
      more = await look(() => own === view);
    } catch { /* the server may be back with the next call */ }
    if (more === false) return;
    await new Promise((done) => setTimeout(done, POLL_MS));
  }
}

function failure(where, error) {
  where.replaceChildren(make("p", { class: "error", role: "alert" }, error.message));
}

// The chooser of files

async function choose(where, path, onPick) {
  let found;
  try {
    found = await ask(`api/browse?path=${encodeURIComponent(path)}`);
  } catch (error) {
    failure(where, error);
    return;
  }
  const go = (to) => () => choose(where, to, onPick);
  const entry = (name, kind, onclick) => make("button", { type: "button", onclick },
    make("span", {}, name), make("span", { class: "kind" }, kind));
  const list = make("div", { class: "files" });
  if (found.parent !== null) list.append(entry("..", "up", go(found.parent)));
  for (const one of found.entries) {
    const inner = one.kind === "folder" || one.kind === "run";
    list.append(entry(one.name, one.kind, inner ? go(one.path) : () => onPick(one.path, one.kind)));
  }
  const whole = found.images ? `Take this folder (${found.images} images)` : "Take this folder";
  where.replaceChildren(
    make("div", { class: "row" },
      make("strong", {}, found.path === "." ? "Folder of the page" : found.path),
      make("button", { type: "button", onclick: () => onPick(found.path, found.kind) }, whole)),
    list,
    found.left_out ? make("p", { class: "faint" }, `${found.left_out} more are not shown`) : "");
}

// A new run

function newRun() {
  const chooser = make("div"), info = make("div"), form = make("div");
  const values = {};
  const pick = async (path, kind) => {
    if (kind === "run") {
      location.hash = open("run", path);
      return;
    }
    values.frames = path;
    info.replaceChildren(make("p", { class: "faint", role: "status" }, `Reading ${path} …`));
    form.replaceChildren();
    const own = view;
    try {
      const found = await ask(`api/info?path=${encodeURIComponent(path)}`);
      if (own !== view || values.frames !== path) return;
      const facts = make("dl");
      for (const [name, text] of Object.entries(found.facts)) {
        facts.append(make("dt", {}, name), make("dd", {}, text));
      }
      info.replaceChildren(card(path, facts,
        found.problem ? make("p", { class: "error", role: "alert" }, found.problem) : null));
      if (!found.problem) {
        const name = path.split("/").pop().replace(/\.[^.]*$/, "") || "run";
        values.out = values.out || `${name}-run`;
        form.replaceChildren(runForm(values));
      }
      info.scrollIntoView({ block: "start" });
    } catch (error) {
      failure(info, error);
    }
  };
  show(make("h1", {}, "New run"),
    card("What was filmed", make("p", { class: "faint" },
      "Choose a video, a folder of frames, or a finished run to look at."), chooser),
    info, form);
  choose(chooser, "", pick);
}

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
    line.textContent = answer.command;
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

function runForm(values) {
  const form = start.forms.refine, { line, problem, row, changed, submit } = commandLine("refine", values);
  const known = form.fields.filter((field) => field.name !== "frames" && field.name !== "config");
  const first = known.filter((field) => MAIN_FIELDS.includes(field.name));
  const rest = known.filter((field) => !MAIN_FIELDS.includes(field.name));
  const whole = make("form", { onsubmit: submit },
    card("How", presets(values, changed), ...first.map((field) => input(field, values, changed))),
    make("details", { class: "card" }, make("summary", {}, "All options"),
      input(form.fields.find((field) => field.name === "config"), values, changed),
      ...rest.map((field) => input(field, values, changed))),
    card("The command", make("p", { class: "faint" }, `It runs in ${start.root}. The terminal does the same with it.`),
      line, problem, row));
  changed();
  return whole;
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

function presets(values, changed) {
  const about = Object.fromEntries(start.choices.presets);
  const one = (name, label, help) => make("label", { class: "choice", title: help },
    make("input", {
      type: "radio", name: "preset", value: name, checked: (values.config || "") === name,
      onchange: () => {
        values.config = name;
        const box = document.getElementById("field-config");
        if (box) box.value = name;
        changed();
      },
    }), label);
  return make("fieldset", {}, make("legend", {}, "Preset"),
    one("fast", "Fast", about.fast), one("", "Normal", "The defaults"),
    one("accurate", "Accurate", about.accurate),
    make("span", { class: "faint" }, `Fast: ${about.fast} Accurate: ${about.accurate}, slower.`));
}

function input(field, values, changed) {
  const id = `field-${field.name}`, label = field.option || (field.metavar || field.name);
  const title = label.replace(/^--/, "").replace(/-/g, " ");
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

// Jobs

function jobs() {
  const list = make("ul", { class: "plain jobs" });
  show(make("h1", {}, "Queue"), card("", make("p", { class: "faint" },
    "One job runs at a time. Jobs go on when this page is closed."), list));
  follow(async (current) => {
    const found = (await ask("api/jobs")).jobs;
    if (!current()) return false;
    if (!list.contains(document.activeElement)) {
      list.replaceChildren(...(found.length ? found.map(jobRow) : [make("li", {}, "No job yet.")]));
    }
    return true;
  });
}

function jobRow(job) {
  return make("li", {},
    make("div", { class: "row" }, badge(job.status),
      make("a", { href: open("job", job.id) }, `${job.kind} ${job.run || ""}`),
      job.stage ? make("span", { class: "faint" }, job.stage) : null, ...actions(job)),
    make("code", { class: "faint" }, job.command),
    job.error ? make("div", { class: "error" }, job.error) : null);
}

function actions(job) {
  const act = (label, action, kind) => make("button", {
    type: "button", class: kind || "",
    onclick: async (happening) => {
      happening.target.disabled = true;
      try {
        await ask(`api/jobs/${job.id}/${action}`, {});
      } catch (error) {
        window.alert(error.message);
      }
      happening.target.blur();
      if (action === "remove") location.hash = "#jobs";
    },
  }, label);
  if (job.status === "waiting") return [act("Take out", "stop")];
  if (job.status === "running") return [act("Stop", "stop")];
  if (job.status === "stopping") return [act("Stop at once", "stop")];
  const more = ["stopped", "failed", "lost"].includes(job.status) ? [act("Go on", "go-on", "main")] : [];
  return [...more, act("Forget", "remove")];
}

function job(id) {
  const head = make("div"), now = make("div"), stages = make("ul", { class: "plain stages" });
  const canvas = make("canvas", { role: "img" }), caption = make("p", { class: "faint" });
  const notes = make("div"), log = make("pre", { class: "log" }), after = make("div");
  const plan = card("From above", canvas, caption), stageCard = card("Stages", stages);
  show(head, after, make("div", { class: "two" }, make("div", {}, now, plan),
    make("div", {}, notes, stageCard)),
    make("details", { class: "card" }, make("summary", {}, "Output of the command"), log));
  let drawn = "", shownStatus = "";
  follow(async (current) => {
    const found = await ask(`api/jobs/${id}`);
    const progress = found.progress, key = `${progress.keyframes} ${progress.stages.length}`;
    const text = await ask(`api/jobs/${id}/log`);
    if (!current()) return false;
    fillHead(head, found);
    fillNow(now, found);
    fillStages(stages, progress);
    stageCard.hidden = !progress.stages.length;
    fillNotes(notes, found);
    if (log.textContent !== text) log.textContent = text;
    plan.hidden = found.kind !== "refine";
    if (key !== drawn && found.kind === "refine") {
      const map = await ask(`api/jobs/${id}/map`);
      if (!current()) return false;
      drawn = key;
      drawPlan(canvas, map);
      caption.textContent = map.stage === "odometry" ? `${map.path.length} keyframes of the odometry`
        : map.path.length ? `${map.path.length} frames, after: ${titleOf(progress, map.stage)}` : "Nothing yet.";
    }
    if (found.status !== shownStatus) {
      shownStatus = found.status;
      after.replaceChildren();
      if (found.figures && found.figures.length) after.append(figureCard(found.figures));
      else if (["done", "partial"].includes(found.status) && found.run) await results(after, found.run, current);
    }
    return true;
  });
}

function titleOf(progress, name) {
  const stage = progress.stages.find((one) => one.name === name);
  return stage ? stage.title : name;
}

function fillHead(head, job) {
  if (head.contains(document.activeElement)) return;
  const taken = job.began ? spoken((job.ended || Date.now() / 1000) - job.began) : "";
  const copy = make("button", { type: "button", onclick: () => copied(job.command, copy) }, "Copy the command");
  head.replaceChildren(make("h1", {}, `${job.kind} ${job.run || ""}`),
    card("", make("div", { class: "row" }, badge(job.status),
      make("span", { class: "faint" }, taken), ...actions(job), copy),
      make("pre", { class: "command" }, job.command),
      job.error ? make("p", { class: "error", role: "alert" }, job.error) : null));
}

function fillNow(now, job) {
  const { stage, work, seconds_left: left } = job.progress;
  if (ENDED.includes(job.status) || !(stage || work)) {
    now.replaceChildren();
    return;
  }
  const parts = [make("p", {}, make("strong", {}, stage ? stage.title : work.what))];
  if (work && work.total) {
    const rate = work.rate ? `${work.rate.toPrecision(3)} a second` : "";
    const more = [`${work.done} of ${work.total}`, rate, left ? `${spoken(left)} left` : "", work.note];
    parts.push(make("progress", { max: work.total, value: work.done, "aria-label": work.what }),
      make("p", { class: "faint" }, `${work.what}: ${more.filter(Boolean).join(", ")}`));
  } else {
    parts.push(make("progress", { "aria-label": "at work" }));
  }
  now.replaceChildren(card("Now", ...parts));
}

function fillStages(list, progress) {
  if (list.childElementCount === progress.stages.length) return;
  list.replaceChildren(...progress.stages.map((stage) => make("li", {}, make("span", {}, stage.title),
    make("span", {}, stage.resumed ? "kept" : spoken(stage.seconds)))));
  list.scrollTop = list.scrollHeight;
}

function fillNotes(notes, job) {
  const parts = [];
  if (job.camera && job.camera.length && !["done", "partial"].includes(job.status)) {
    parts.push(card("The camera so far", make("ul", {}, ...job.camera.map((line) => make("li", {}, line)))));
  }
  if (job.progress.warnings.length) {
    parts.push(card("Warnings", make("ul", { class: "warning" },
      ...job.progress.warnings.map((line) => make("li", {}, line)))));
  }
  notes.replaceChildren(...parts);
}

// Results of a run

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
  const report = make("a", { href: link(`${run}/report.html`), target: "_blank", rel: "noopener" }, "Report");
  where.replaceChildren(
    card(`${run}: ${summary.refined} of ${summary.frames} frames refined`, facts,
      found.notes.length ? make("ul", {}, ...found.notes.map((note) => make("li", {}, note))) : null,
      make("div", { class: "row" }, viewer, report,
        make("button", { type: "button", onclick: add("plot", { runs: [run], out: `${run}/figures` }) }, "Plot"),
        make("a", { href: `#compare/${encodeURIComponent(run)}` }, "Compare"),
        ...found.files.slice(1).map((name) => make("a", { href: link(`${run}/${name}`) }, name))),
      message),
    card("Export for", make("div", { class: "row" }, ...start.choices.exports.map((to) =>
      make("button", { type: "button", title: `gsba export ${run} --to ${to} --up auto`,
        onclick: add("export", { run, to, up: "auto" }) }, to))),
      make("p", { class: "faint" }, `Datasets are written into ${run}, and stand upright.`)),
    growing(run, found),
    found.figures.length ? figureCard(found.figures.map((name) => `${run}/figures/${name}`)) : "");
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
    ["time of all stages", spoken(found.seconds)],
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
  const where = make("div"), canvas = make("canvas", { role: "img" });
  show(make("h1", {}, run), where, card("From above", canvas));
  const own = view, current = () => own === view;
  results(where, run, current).catch((error) => failure(where, error));
  ask(`api/run/map?path=${encodeURIComponent(run)}`).then((map) => current() && drawPlan(canvas, map)).catch(() => undefined);
}

// Comparison

function compare(first) {
  const chosen = first ? [first] : [], table = make("div", { class: "scroll" });
  const picked = make("ul", { class: "plain" }), chooser = make("div"), message = make("p", { class: "error" });
  const fill = async () => {
    const own = view, found = [];
    for (const run of chosen) {
      try {
        found.push(await ask(`api/run?path=${encodeURIComponent(run)}`));
      } catch (error) {
        message.textContent = error.message;
      }
    }
    if (own !== view) return;
    picked.replaceChildren(...chosen.map((run, k) => make("li", { class: "row" }, run, make("button", {
      type: "button", "aria-label": `Leave out ${run}`, onclick: () => { chosen.splice(k, 1); fill(); },
    }, "×"))));
    const done = found.filter((one) => one.finished);
    const rows = {};
    done.forEach((one, k) => [["frames refined", `${one.summary.refined} of ${one.summary.frames}`], ...figures(one)]
      .forEach(([name, text]) => { (rows[name] = rows[name] || [])[k] = text; }));
    table.replaceChildren(done.length ? make("table", {},
      make("thead", {}, make("tr", {}, make("th", {}, ""), ...done.map((one) => make("th", { scope: "col" }, one.path)))),
      make("tbody", {}, ...Object.entries(rows).map(([name, cells]) => make("tr", {}, make("th", { scope: "row" }, name),
        ...done.map((_, k) => make("td", { class: "number" }, cells[k] || "")))))) : "No finished run is chosen.");
  };
  const pick = (path, kind) => {
    message.textContent = kind === "run" ? "" : `${path} is no run`;
    if (kind === "run" && !chosen.includes(path)) chosen.push(path);
    choose(chooser, "", pick);
    fill();
  };
  const plot = make("button", {
    type: "button",
    onclick: async () => {
      const out = `compared/${chosen.map((run) => run.split("/").pop()).join("-")}`;
      try {
        location.hash = open("job", (await ask("api/add", { command: "plot", values: { runs: [...chosen], out } })).id);
      } catch (error) {
        message.textContent = error.message;
      }
    },
  }, "Plot them side by side");
  show(make("h1", {}, "Compare runs"), card("Runs", picked, message, chooser), card("Figures", table, plot));
  choose(chooser, "", pick);
  fill();
}

// Views

async function route() {
  view += 1;
  const [name, rest] = location.hash.slice(1).split(/\/(.*)/s), argument = decodeURIComponent(rest || "");
  for (const tab of document.querySelectorAll("nav a")) {
    const here = tab.getAttribute("href") === `#${name || "new"}` || (name === "job" && tab.hash === "#jobs");
    if (here) tab.setAttribute("aria-current", "page"); else tab.removeAttribute("aria-current");
  }
  if (!start) {
    const own = view;
    await follow(async () => {
      start = await ask("api/start");
      return false;
    });
    if (own !== view || !start) return;
    document.getElementById("root").textContent = start.root;
  }
  const views = { jobs, job, run: runPage, compare, new: newRun };
  (views[name] || newRun)(argument);
  window.scrollTo(0, 0);
}

async function countJobs() {
  try {
    const open = (await ask("api/jobs")).jobs.filter((one) => !ENDED.includes(one.status)).length;
    document.getElementById("queue-count").textContent = open ? ` (${open})` : "";
  } catch { /* the next call may succeed */ }
  setTimeout(countJobs, 3 * POLL_MS);
}

window.addEventListener("hashchange", route);
route();
countJobs();
