const COLOURS = ["--a", "--b", "--c", "--d", "--e", "--f"];

function tiles() {
  const s = D.report.summary, extra = s.frames_fetched;
  const length = path => path.reduce((sum, p, i) => i ? sum + Math.hypot(...p.map((v, k) => v - path[i - 1][k])) : 0, 0);
  const seconds = s.seconds;
  const px = degrees => degrees === null ? "–" : `${num(degrees * pxPerDeg)} px`;
  const apart = [[s.exported - s.refined, `with the pose of the ${D.report.start}`], [s.frames_in_other_maps, "in other maps"], [s.frames_in_no_map, "in no map"]]
    .concat([[s.fetched, "more strengthened the map, datasets skip them"]]).filter(([count]) => count).map(([count, where]) => `${num(count)} ${where}`).join(", ");
  const rows = [
    ["Frames refined", `${num(s.refined - s.fetched)} / ${num(s.frames - extra)}`, apart || "all of them"],
    ["Median residual", px(s.median_residual_deg), STARTED ? `was ${px(s.median_residual_deg_coarse)} under the ${D.report.start}` : "started from pairs of frames"],
    STARTED ? ["Largest move", num(Math.max(...F.moved)), `map units, on a path of ${num(length(D.map.after))}`]
      : ["Path", num(length(D.map.after)), "map units"],
    ["Points", num(s.points), `in ${num(+(s.mean_track_length || 0).toFixed(1))} frames each on average`],
    ["Observations", num(s.observations), `${num(Math.round(s.observations / s.exported))} a frame`],
    ["Time", seconds < 90 ? `${num(seconds)} s` : `${num(seconds / 60)} min`, `${num(D.report.machine.cpus)} cores`],
  ];
  for (const [label, value, more] of rows)
    el("tiles").append(make("div", { class: "tile" }, make("span", { class: "label" }, label), make("b", {}, value), make("span", {}, ...termed(more))));
}

function maps() {
  const table = el("maps-table"), reasons = D.report.maps.some(m => m.reason);
  const names = ["Map", "Frames", "Refined", "Steps", "Points", "Extent", "First to last frame", ...(reasons ? ["Reason why it was not joined"] : [])];
  table.append(make("tr", {}, ...names.map((t, i) => make("th", i < 6 ? { class: "n" } : {}, t))));
  for (const m of D.report.maps) table.append(make("tr", {},
    ...[m.map, m.frames, m.refined, m.steps, m.points, m.extent].map(v => make("td", { class: "n" }, num(v))),
    make("td", {}, m.spans.map(([a, b]) => a === b ? a : `${a} to ${b}`).join(", ")),
    reasons ? make("td", {}, m.reason || "") : null));
}

function mapLegend() {
  const names = { before: `before (${D.report.start})`, after: STARTED ? "after" : "positions", points: "points" };
  if (!STARTED) { delete names.before; layers.before = false; }
  el("trajectory-lead").textContent = STARTED ? `Positions of the frames before (${D.report.start}) and after refinement.`
    : "Positions of the frames; the run started from pairs of frames.";
  for (const [key, text] of Object.entries(names)) {
    const box = make("input", { type: "checkbox", checked: "" });
    box.addEventListener("change", () => { layers[key] = box.checked; redraw(); });
    el("map-legend").append(make("label", {}, box, key === "points" ? null : make("i", { style: `background:var(--${key})` }), text));
  }
  D.recordings.forEach((name, i) => el("map-legend").append(make("span", {}, make("i", { style: `background:var(${COLOURS[i % 6]})` }), ` ${name}`)));
  if (D.map.up < .5) el("map-legend").append(make("span", {}, "the rigs have no common up axis: up is the direction of the path's smallest extent"));
}

function scan() {
  const { before, after } = D.scan, parts = before ? [before, after] : [after];
  const names = before ? ["before", "after"] : ["after"];
  el("scan-lead").textContent = `From the points to the surfaces of ${D.scan.scan}, in its units. `
    + parts.map((p, i) => `${names[i]}: median ${num(p.median)}, nine in ten within ${num(p.percentile90)}`).join("; ") + ".";
  const edges = after.histogram.edges, table = el("distances");
  const most = Math.max(...parts.flatMap(p => p.histogram.counts.map(n => n / p.points)), 1e-9);
  const bar = (p, k, colour) => make("td", {}, make("div", { class: "bar" },
    make("i", { style: `background:var(--${colour});width:${100 * p.histogram.counts[k] / p.points / most}%` })));
  table.append(make("tr", {}, make("th", { class: "n" }, "Distance"), ...names.map(n => make("th", {}, `Points ${n}`))));
  after.histogram.counts.forEach((_, k) => table.append(make("tr", {},
    make("td", { class: "n" }, k + 1 < edges.length ? `to ${num(edges[k + 1])}` : "beyond"),
    ...parts.map((p, i) => bar(p, k, names[i])))));
}

function splat() {
  const names = D.splat.pictures.map(one => one.name);
  el("splat-lead").textContent = `Frame ${D.splat.frame}, which no splat was trained on: left of the border ${names[0]}, right of it ${names[1]}.`;
  const [, over] = D.splat.pictures.map(one => {
    const [width, height] = D.splat.size, picture = make("img", { src: `data:image/jpeg;base64,${one.jpeg}`, alt: one.name, width, height });
    el("splat-pictures").append(picture);
    return picture;
  });
  const move = () => { over.style.clipPath = `inset(0 0 0 ${el("splat-border").value}%)`; };
  el("splat-border").addEventListener("input", move);
  move();
}

function worst() {
  const lengths = D.worst.flatMap(w => w.vectors.map(v => Math.hypot(v[2], v[3]))).sort((a, b) => a - b);
  const median = lengths[lengths.length >> 1] || 1;
  const times = Math.max(1, +(3 / median).toPrecision(1));  // a median residual becomes three degrees long
  el("worst-lead").textContent = D.worst.length
    ? `The frames with the largest median residual. Lines run from each observation to its reprojected point, ${num(times)} times as long.`
    : "No frame has observations.";
  for (const w of D.worst) {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    svg.setAttribute("viewBox", "0 0 360 180");
    svg.setAttribute("preserveAspectRatio", "none");
    const path = (chosen, colour) => {
      const line = document.createElementNS("http://www.w3.org/2000/svg", "path");
      line.setAttribute("d", chosen.map(v => {
        const x = 360 * v[0], y = 180 * v[1], dx = times * v[2], dy = times * v[3], cap = Math.min(1, 40 / Math.hypot(dx, dy || 1e-9));
        return `M${x.toFixed(2)} ${y.toFixed(2)}l${(cap * dx).toFixed(2)} ${(cap * dy).toFixed(2)}`;
      }).join(""));
      line.setAttribute("stroke", colour); line.setAttribute("stroke-width", ".9"); line.setAttribute("fill", "none"); line.setAttribute("stroke-linecap", "round");
      svg.append(line);
    };
    path(w.vectors.filter(v => Math.hypot(v[2], v[3]) <= 3 * median), "#7ee0ff");
    path(w.vectors.filter(v => Math.hypot(v[2], v[3]) > 3 * median), "#ff5a4f");
    const figure = make("figure", {}, make("div", {},
      make("img", { src: `data:image/jpeg;base64,${w.jpeg}`, alt: F.name[w.frame], width: w.width, height: w.height }), svg),
      make("figcaption", {}, make("b", {}, F.name[w.frame]), ` · ${residualText(F.residual_deg[w.frame])} · ${num(F.observations[w.frame])} observations`));
    figure.addEventListener("pointerenter", () => mark(w.frame));
    figure.addEventListener("pointerleave", () => mark(-1));
    el("worst").append(figure);
  }
  if (!D.patches.length) el("patches-lead").remove();
  for (const p of D.patches) el("patches").append(make("figure", {},
    make("img", { class: "patches", src: `data:image/png;base64,${p.png}`, alt: `Patches of ${F.name[p.reference]} and ${F.name[p.frame]}, and their difference` }),
    make("figcaption", {}, make("b", {}, F.name[p.frame]), ` as in ${F.name[p.reference]} · ${residualText(p.residual_deg)} · correlation ${num(p.correlation, 2)}`)));
}

function cost() {
  const steps = [], rounds = [];
  for (const stage of D.report.solver) stage.rounds.forEach((round, r) => {
    rounds.push({ start: steps.length, stage: stage.stage, number: r + 1, round });
    for (const step of round.iterations) steps.push({ ...step, where: rounds[rounds.length - 1] });
  });
  const families = [...new Set(steps.flatMap(step => Object.keys(step.costs)))];
  families.forEach((name, i) => el("cost-legend").append(make("span", {}, make("i", { style: `background:var(${COLOURS[i % 6]})` }), ` ${name}`)));
  el("cost-legend").append(make("span", {}, "× step rejected · shaded: round undone"));
  const known = steps.flatMap(step => Object.values(step.costs)).filter(v => v > 0);
  if (!known.length) return;
  const low = Math.max(Math.min(...known), Math.max(...known) * 1e-6), high = Math.max(...known);
  const left = 62, right = 10, top = 26, bottom = 10, canvas = el("cost");
  const X = i => left + (i + .5) / steps.length * (canvas.clientWidth - left - right);
  surface(canvas, (g, width, height) => {
    const span = Math.log10(high / low) || 1;
    const Y = v => height - bottom - Math.max(0, Math.log10(v / low)) / span * (height - top - bottom);
    const edge = i => left + i / steps.length * (width - left - right);
    g.textBaseline = "middle"; g.textAlign = "right"; g.lineWidth = 1;
    for (let p = Math.ceil(Math.log10(low)); p <= Math.log10(high); p++) {
      g.strokeStyle = css("--grid"); g.beginPath(); g.moveTo(left, Y(10 ** p)); g.lineTo(width - right, Y(10 ** p)); g.stroke();
      g.fillStyle = css("--quiet"); g.fillText(num(10 ** p), left - 8, Y(10 ** p));
    }
    g.textAlign = "left";
    let free = left; // where the last name of a stage ends
    rounds.forEach((r, i) => {
      const end = i + 1 < rounds.length ? rounds[i + 1].start : steps.length;
      if (!r.round.accepted) { g.fillStyle = css("--bad"); g.globalAlpha = .12; g.fillRect(edge(r.start), top, edge(end) - edge(r.start), height - top - bottom); g.globalAlpha = 1; }
      g.strokeStyle = css("--line"); g.globalAlpha = r.number === 1 ? 1 : .5; g.beginPath(); g.moveTo(edge(r.start), r.number === 1 ? 8 : top); g.lineTo(edge(r.start), height - bottom); g.stroke(); g.globalAlpha = 1;
      if (r.number === 1 && edge(r.start) >= free) {
        g.fillStyle = css("--quiet"); g.fillText(r.stage, edge(r.start) + 5, 13);
        free = edge(r.start) + 10 + g.measureText(r.stage).width;
      }
    });
    families.forEach((name, n) => {
      g.strokeStyle = g.fillStyle = css(COLOURS[n % 6]); g.lineWidth = 1.6;
      for (const r of rounds) {
        g.beginPath(); let down = false;
        steps.forEach((step, i) => { if (step.where !== r || !(step.costs[name] > 0)) return; down ? g.lineTo(X(i), Y(step.costs[name])) : g.moveTo(X(i), Y(step.costs[name])); down = true; });
        g.stroke();
      }
      steps.forEach((step, i) => { if (step.costs[name] > 0) { g.beginPath(); g.arc(X(i), Y(step.costs[name]), 2, 0, 7); g.fill(); } });
    });
    g.fillStyle = css("--quiet"); g.textAlign = "center";
    steps.forEach((step, i) => { if (!step.accepted) g.fillText("×", X(i), height - bottom - 6); });
  });
  hover(canvas, x => {
    const step = steps[Math.floor((x - left) / (canvas.clientWidth - left - right) * steps.length)];
    if (!step) return null;
    const r = step.where.round, costs = Object.entries(step.costs).map(([k, v]) => `${k} ${num(v, 5)}`).join("\n");
    return [`${step.where.stage}, round ${step.where.number}, iteration ${step.number}\n${costs || `rejected, cost ${num(step.cost, 5)}`}\n` +
      `gate ${num(r.gate_sigmas)} σ · ${num(r.observations)} observations · noise ${num(r.noise)}\n${r.accepted ? r.reason : "round undone: it had fewer inliers"}`, -1];
  });
}

function stages() {
  const table = el("stages"), longest = Math.max(...D.report.stages.map(s => s.seconds), 1e-9);
  table.append(make("tr", {}, ...["Stage", "Seconds", "Share of time", "Received", "Kept", "Dropped, with reasons"].map((t, i) => make("th", i === 1 || i === 3 || i === 4 ? { class: "n" } : {}, t))));
  for (const stage of D.report.stages) {
    const counts = stage.counts.length ? stage.counts : [null];
    counts.forEach((c, i) => {
      const dropped = c ? Object.entries(c.dropped).filter(([, n]) => n).map(([why, n]) => `${num(n)} ${why}`).join(", ") : "";
      table.append(make("tr", {},
        make("td", {}, ...termed(i ? "" : (stage.title || stage.name) + (stage.workers ? `, ${stage.workers} workers` : ""))), make("td", { class: "n" }, i ? "" : stage.seconds.toFixed(1)),
        make("td", {}, i ? "" : make("div", { class: "bar" }, make("i", { style: `width:${100 * stage.seconds / longest}%` }))),
        make("td", { class: "n", "data-head": "received " }, c ? `${num(c.received)} ${c.unit}` : ""),
        make("td", { class: "n", "data-head": "kept " }, c ? num(c.kept) : ""), make("td", { "data-head": "dropped " }, dropped)));
    });
  }
}

el("run").textContent = D.run;
document.title = `${D.run} – gsba`;
el("when").textContent = `finished ${D.report.finished.replace("T", " ").replace("+00:00", " UTC")} · gsba ${D.report.gsba}`;
el("gauge").append(...termed(`${D.report.gauge}. The numbers behind this page are in report.json and poses.csv.`));
terms();
el("settings").textContent = JSON.stringify({ settings: D.report.settings, machine: D.report.machine, versions: D.report.versions }, null, 1);
verdict();
tiles();
if (D.report.maps.length > 1) maps();
else el("maps").remove();
mapLegend();
worldMap(el("top"), 0, 1);
worldMap(el("side"), 0, 2);
if (STARTED) {
  series(el("series"), "Moved", "units", F.moved, "--after");
  series(el("series"), "Turned", "°", F.turned_deg, "--after");
}
series(el("series"), "Residual", "px", F.residual_deg.map(v => v === null ? null : v * pxPerDeg), "--c");
series(el("series"), "Observations", "", F.observations, "--c");
series(el("series"), "σ of position", "units", F.std, "--d");
series(el("series"), "σ of rotation", "°", F.std_deg, "--d");
matrix(el("matrix"), el("matrix-scale"));
sphere(el("sphere"), el("sphere-scale"), D.sphere);
if (D.field) sphere(el("field"), el("field-scale"), D.field);
else el("field-card").remove();
if (D.odometry) {
  el("odometry-lead").textContent = `Camera path by the odometry on the video, before refinement: ${D.odometry.summary}.`;
  odometryMap(el("walk"), el("odometry-legend"));
} else el("odometry").remove();
if (D.scan) scan();
else el("scan").remove();
if (D.splat) splat();
else el("splat").remove();
pictures();
worst();
cost();
stages();
linkTerms();
redraw();
