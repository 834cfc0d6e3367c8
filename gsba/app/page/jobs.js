"use strict";
// The queue, and the page of one job.

const ENDED = ["done", "partial", "failed", "stopped", "lost"];
const STATUS = {
  waiting: "waiting", running: "running", stopping: "stopping", done: "done",
  partial: "done, with less than nine tenths of the frames", failed: "failed", stopped: "stopped",
  lost: "ended without a word",
};
const badge = (status) => make("span", { class: `badge ${status}` }, STATUS[status] || status);

function jobs() {
  const list = make("ul", { class: "plain jobs" });
  show(make("h1", {}, "Queue"), card("", make("p", { class: "faint" },
    "One job runs at a time. Jobs go on when this page is closed."), list));
  follow(async (current) => {
    const found = (await ask("api/jobs")).jobs;
    if (!current()) return false;
    if (!list.contains(document.activeElement)) {
      list.replaceChildren(...(found.length ? found.map(jobRow) : [make("li", {}, "No job yet. Choose a video under ", make("a", { href: "#files" }, "Footage"), " and press Start: it waits and runs here.")]));
    }
    return true;
  });
}

function jobRow(job) {
  return make("li", {},
    make("div", { class: "row" }, badge(job.status),
      make("a", { href: open("job", job.id) }, `${job.kind} ${job.run || ""}`),
      job.stage ? make("span", { class: "faint" }, job.stage) : null, ...actions(job)),
    make("code", { class: "faint" }, ...words(job.command)),
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
  let run = "";
  const seen = places(() => run), plan = seen.plan;
  const notes = make("div"), log = make("pre", { class: "log" }), after = make("div");
  const stageCard = card("Stages", stages);
  const output = make("details", { class: "card" }, make("summary", {}, "Output of the command"), log);
  show(head, after, make("div", { class: "two" }, make("div", {}, now, plan),
    make("div", {}, seen.looks, notes, stageCard)), output);
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
    if (!shownStatus) output.open = ["export", "localize"].includes(found.kind); // their output is the result
    if (key !== drawn && found.kind === "refine") {
      const map = await ask(`api/jobs/${id}/map`);
      if (!current()) return false;
      drawn = key;
      run = found.run;
      seen.show(map, map.stage === "odometry" ? `${map.path.length} keyframes of the odometry`
        : map.path.length ? `${map.path.length} frames, after: ${titleOf(progress, map.stage)}` : "Nothing yet.");
    }
    if (found.status !== shownStatus) {
      shownStatus = found.status;
      after.replaceChildren();
      if (found.figures && found.figures.length) after.append(figureCard(found.figures));
      else if (found.kind === "export" || found.kind === "localize") after.append(backTo(found.run));
      else if (["done", "partial"].includes(found.status) && found.run) await results(after, found.run, current);
    }
    return true;
  });
}

function backTo(run) {
  return run ? card("", make("a", { href: open("run", run) }, `Back to ${run}`)) : "";
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
      make("pre", { class: "command" }, ...words(job.command)),
      job.error ? make("p", { class: "error", role: "alert" }, job.error) : null));
}

function fillNow(now, job) {
  const { stage, work, left } = job.progress;
  if (ENDED.includes(job.status) || !(stage || work)) {
    now.replaceChildren();
    return;
  }
  const parts = [make("p", {}, make("strong", {}, stage ? stage.title : work.what))];
  if (left) parts.unshift(make("p", { class: "left" }, `${left[0].toUpperCase()}${left.slice(1)} left of the run`));
  if (work && work.total) {
    const rate = work.rate ? `${Number(work.rate.toPrecision(3))} a second` : "";
    const stepLeft = work.rate ? (work.total - work.done) / work.rate : 0;
    const more = [`${work.done} of ${work.total}`, rate, stepLeft ? `${spoken(stepLeft)} left of it` : "", work.note];
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

