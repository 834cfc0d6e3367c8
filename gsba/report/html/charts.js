/* A map of the path in two of its three axes. */
const layers = { before: true, after: true, points: true };
function worldMap(canvas, across, up) {
  const view = { x: 0, y: 0, scale: 1, fitted: false };
  const { before, after, points, colors } = D.map;
  function fit(width, height) {
    const all = layers.before ? before.concat(after) : after;
    const range = k => [Math.min(...all.map(p => p[k])), Math.max(...all.map(p => p[k]))];
    const [x0, x1] = range(across), [y0, y1] = range(up);
    view.x = (x0 + x1) / 2; view.y = (y0 + y1) / 2;
    view.scale = 0.82 * Math.min(width / (x1 - x0 || 1), height / (y1 - y0 || 1));
    view.fitted = true;
  }
  const one = surface(canvas, (g, width, height) => {
    if (!view.fitted && width) fit(width, height);
    const X = p => width / 2 + (p[across] - view.x) * view.scale;
    const Y = p => height / 2 - (p[up] - view.y) * view.scale;
    view.place = p => [X(p), Y(p)];
    if (layers.points) {
      g.globalAlpha = +css("--cloud");
      points.forEach((p, i) => { g.fillStyle = `rgb(${colors[i]})`; g.fillRect(X(p) - 1, Y(p) - 1, 2, 2); });
      g.globalAlpha = 1;
    }
    const line = (path, colourOf, size) => {  // one for each recording
      g.lineWidth = 1.4; g.lineJoin = "round";
      for (let first = 0, end; first < N; first = end) {
        for (end = first; end < N && F.recording[end] === F.recording[first];) end++;
        const own = path.slice(first, end);
        g.strokeStyle = g.fillStyle = css(colourOf(F.recording[first]));
        g.beginPath(); own.forEach((p, i) => i ? g.lineTo(X(p), Y(p)) : g.moveTo(X(p), Y(p))); g.stroke();
        for (const p of own) { g.beginPath(); g.arc(X(p), Y(p), size, 0, 7); g.fill(); }
      }
    };
    if (layers.before && layers.after) {
      g.strokeStyle = css("--quiet"); g.globalAlpha = .5; g.lineWidth = 1; g.beginPath();
      for (let f = 0; f < N; f++) { g.moveTo(X(before[f]), Y(before[f])); g.lineTo(X(after[f]), Y(after[f])); }
      g.stroke(); g.globalAlpha = 1;
    }
    if (layers.before) line(before, () => D.recordings.length ? "--quiet" : "--before", 1.6);
    if (layers.after) line(after, number => D.recordings.length ? COLOURS[number % 6] : "--after", 2.2);
    if (layers.after) for (let f = 0; f < N; f++) if (F.status[f]) {
      g.strokeStyle = css("--bad"); g.lineWidth = 1.5; g.beginPath(); g.arc(X(after[f]), Y(after[f]), 5, 0, 7); g.stroke();
    }
    if (marked >= 0) {
      g.strokeStyle = css("--mark"); g.lineWidth = 2;
      for (const path of [before, after]) { g.beginPath(); g.arc(X(path[marked]), Y(path[marked]), 6, 0, 7); g.stroke(); }
    }
    const unit = ticks(0, 120 / view.scale, 1).pop() || 1, length = unit * view.scale;
    g.strokeStyle = css("--quiet"); g.lineWidth = 1.5; g.textAlign = "right";
    g.beginPath(); g.moveTo(width - 12 - length, height - 12); g.lineTo(width - 12, height - 12); g.stroke();
    label(g, `${num(unit)} map unit${unit === 1 ? "" : "s"}`, width - 12, height - 18);
  });
  let held = null;
  canvas.addEventListener("pointerdown", e => { held = [e.offsetX, e.offsetY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointerup", () => { held = null; });
  canvas.addEventListener("pointercancel", () => { held = null; });
  canvas.addEventListener("pointermove", e => {
    if (!held) return;
    view.x -= (e.offsetX - held[0]) / view.scale; view.y += (e.offsetY - held[1]) / view.scale;
    held = [e.offsetX, e.offsetY]; redraw();
  });
  const zoom = (factor, x, y) => {
    const dx = (x - one.width / 2) / view.scale, dy = (one.height / 2 - y) / view.scale;
    view.scale *= factor; view.x += dx * (1 - 1 / factor); view.y += dy * (1 - 1 / factor); redraw();
  };
  canvas.addEventListener("wheel", e => { e.preventDefault(); zoom(Math.exp(-e.deltaY * .0015), e.offsetX, e.offsetY); }, { passive: false });
  canvas.addEventListener("dblclick", () => { view.fitted = false; redraw(); });
  canvas.addEventListener("keydown", e => {
    const step = 40 / view.scale, moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (moves[e.key]) { view.x += moves[e.key][0]; view.y += moves[e.key][1]; }
    else if (e.key === "+" || e.key === "-") return zoom(e.key === "+" ? 1.25 : .8, one.width / 2, one.height / 2);
    else return;
    e.preventDefault(); redraw();
  });
  hover(canvas, (x, y) => {
    let best = 144, found = -1;
    for (const path of [layers.after && after, layers.before && before]) if (path && view.place)
      path.forEach((p, f) => { const [a, b] = view.place(p), d = (a - x) ** 2 + (b - y) ** 2; if (d < best) { best = d; found = f; } });
    return found < 0 ? null : [describe(found), found];
  });
  return view;
}

/* A value for each frame; null leaves a gap. */
function series(parent, title, unit, values, colour) {
  const canvas = make("canvas", { class: "chart", "aria-label": title });
  const known = values.filter(v => v !== null);
  const sorted = [...known].sort((a, b) => a - b);
  const median = sorted.length ? sorted[sorted.length >> 1] : null;
  parent.append(make("div", { class: "row" },
    make("div", {}, make("b", {}, title), make("br"),
      make("span", { class: "quiet" }, `median ${num(median)} ${unit}`), make("br"),
      make("span", { class: "quiet" }, `largest ${num(sorted.length ? sorted[sorted.length - 1] : null)} ${unit}`)), canvas));
  const left = 52, right = 8, top = 8, bottom = 6;
  surface(canvas, (g, width, height) => {
    const high = (sorted[sorted.length - 1] || 1) * 1.06;
    const X = f => left + (N > 1 ? f / (N - 1) : .5) * (width - left - right), Y = v => height - bottom - v / high * (height - top - bottom);
    g.textAlign = "right"; g.textBaseline = "middle"; g.lineWidth = 1;
    for (const v of ticks(0, high, 3)) {
      g.strokeStyle = css("--grid"); g.beginPath(); g.moveTo(left, Y(v)); g.lineTo(width - right, Y(v)); g.stroke();
      g.fillStyle = css("--quiet"); g.fillText(num(v), left - 8, Y(v));
    }
    g.strokeStyle = g.fillStyle = css(colour); g.lineWidth = 1.4; g.beginPath();
    let down = false;
    values.forEach((v, f) => { if (v === null) { down = false; return; } down ? g.lineTo(X(f), Y(v)) : g.moveTo(X(f), Y(v)); down = true; });
    g.stroke();
    if (N <= 200) values.forEach((v, f) => { if (v !== null) { g.beginPath(); g.arc(X(f), Y(v), 2, 0, 7); g.fill(); } });
    if (marked >= 0) {
      g.strokeStyle = css("--mark"); g.globalAlpha = .4; g.beginPath(); g.moveTo(X(marked), top); g.lineTo(X(marked), height - bottom); g.stroke(); g.globalAlpha = 1;
      if (values[marked] !== null) { g.beginPath(); g.arc(X(marked), Y(values[marked]), 4, 0, 7); g.fill(); }
    }
  });
  hover(canvas, x => {
    const f = Math.round((x - left) / (canvas.clientWidth - left - right) * (N - 1));
    return f >= 0 && f < N ? [`${title}: ${num(values[f])} ${unit}\n${describe(f)}`, f] : null;
  });
}

function matrix(canvas, scale) {
  const { cells, frames_per_cell: step } = D.matches, n = cells.length;
  const highest = Math.max(1, ...cells.map(row => Math.max(...row))), most = Math.log1p(highest);
  scale.append("1", make("i"), `${num(highest)} points`);
  surface(canvas, (g, width) => {
    const size = width / n, colour = ramp(css("--low"), css("--high"));
    g.fillStyle = css("--card"); g.fillRect(0, 0, width, width);
    for (let i = 0; i < n; i++) for (let j = 0; j < n; j++) if (cells[i][j]) {
      g.fillStyle = colour(Math.log1p(cells[i][j]) / most);
      g.fillRect(j * size, i * size, Math.ceil(size), Math.ceil(size));
    }
    if (marked >= 0) {
      const at = (Math.floor(marked / step) + .5) * size;
      g.strokeStyle = css("--before"); g.lineWidth = 1; g.beginPath();
      g.moveTo(at, 0); g.lineTo(at, width); g.moveTo(0, at); g.lineTo(width, at); g.stroke();
    }
  });
  hover(canvas, (x, y) => {
    const size = canvas.clientWidth / n, i = Math.floor(y / size), j = Math.floor(x / size);
    if (i < 0 || j < 0 || i >= n || j >= n) return null;
    return [`${F.name[i * step]}  and  ${F.name[j * step]}\n${num(cells[i][j])} points in common`, i * step];
  });
}

function sphere(canvas, scale, data) {
  const { rows, columns, median_deg: median, east_deg: east, south_deg: south, count } = data;
  const known = median.flat().filter(v => v !== null).sort((a, b) => a - b);
  const high = known.length ? known[Math.floor(.98 * (known.length - 1))] : 1;
  const solid = (i, j) => !count || (count[i][j] >= 20 && east[i][j] !== null);
  const biases = east.flatMap((row, i) => row.flatMap((e, j) => solid(i, j) ? [Math.hypot(e, south[i][j])] : [])).sort((a, b) => a - b);
  const stretch = biases[Math.floor(.98 * (biases.length - 1))] || 1;
  surface(canvas, (g, width, height) => {
    const w = width / columns, h = height / rows, colour = ramp(css("--low"), css("--high"));
    g.fillStyle = css("--grid"); g.fillRect(0, 0, width, height);
    for (let i = 0; i < rows; i++) for (let j = 0; j < columns; j++) if (median[i][j] !== null) {
      g.fillStyle = colour(median[i][j] / high); g.fillRect(j * w, i * h, w + .6, h + .6);
    }
    g.strokeStyle = css("--before"); g.lineWidth = 1.2;
    for (let i = 0; i < rows; i += 2) for (let j = 0; j < columns; j += 2) if (solid(i, j)) {
      const x = (j + .5) * w, y = (i + .5) * h, k = 1.8 * w / stretch;
      g.beginPath(); g.moveTo(x, y); g.lineTo(x + k * east[i][j], y + k * south[i][j]); g.stroke();
    }
    g.textAlign = "center"; g.textBaseline = "bottom";
    ["left", "front", "right"].forEach((text, i) => label(g, text, width * (i + 1) / 4, height - 4));
  });
  scale.append("0", make("i"), `${num(high)}° (${num(high * pxPerDeg)} px)`);
  hover(canvas, (x, y) => {
    const i = Math.floor(y / canvas.clientHeight * rows), j = Math.floor(x / canvas.clientWidth * columns);
    if (!median[i] || median[i][j] === undefined) return null;
    const where = `longitude ${num((j + .5) * 360 / columns - 180)}°, latitude ${num(90 - (i + .5) * 180 / rows)}°`;
    if (!count) return [`${where}\ncorrected by ${num(east[i][j] * pxPerDeg)} px right, ${num(south[i][j] * pxPerDeg)} px down`, -1];
    const bias = median[i][j] === null ? "too few observations" :
      `median ${residualText(median[i][j])}\nsystematic ${num(east[i][j] * pxPerDeg)} px right, ${num(south[i][j] * pxPerDeg)} px down`;
    return [`${where}\n${bias}\n${num(count[i][j])} observations`, -1];
  });
}

/* The video's own odometry from above: maps side by side, keyframes, loops, and where it was lost. */
function odometryMap(canvas, legend) {
  const { maps, loops, joins } = D.odometry;
  const entries = [["keyframe", "--after"], ["loop closed", "--good"], ["maps joined", "--d"], ["lost until the next frame", "--bad"]];
  for (const [name, colour] of entries)
    legend.append(make("span", {}, make("i", { style: `background:var(${colour})` }), ` ${name}`));
  const all = maps.flatMap(m => m.positions);
  const range = k => [Math.min(...all.map(p => p[k])), Math.max(...all.map(p => p[k]))];
  const [x0, x1] = range(0), [y0, y1] = range(1);
  surface(canvas, (g, width, height) => {
    const scale = 0.82 * Math.min(width / (x1 - x0 || 1), height / (y1 - y0 || 1));
    const X = p => width / 2 + (p[0] - (x0 + x1) / 2) * scale, Y = p => height / 2 - (p[1] - (y0 + y1) / 2) * scale;
    const line = (a, b, colour, size) => {
      g.strokeStyle = css(colour); g.lineWidth = size;
      g.beginPath(); g.moveTo(X(a), Y(a)); g.lineTo(X(b), Y(b)); g.stroke();
    };
    maps.forEach((m, number) => {
      m.positions.forEach((p, i) => { if (i) line(m.positions[i - 1], p, m.lost[i] ? "--bad" : "--quiet", m.lost[i] ? 2 : 1.4); });
      g.fillStyle = css("--after");
      m.positions.forEach((p, i) => { if (m.keyframes[i]) { g.beginPath(); g.arc(X(p), Y(p), 2.2, 0, 7); g.fill(); } });
      if (maps.length > 1) { g.textAlign = "left"; label(g, `map ${number + 1}`, X(m.positions[0]) + 8, Y(m.positions[0]) - 8); }
    });
    for (const [pairs, colour] of [[loops, "--good"], [joins, "--d"]]) for (const [a, b] of pairs) {
      line(a, b, colour, 2);
      for (const p of [a, b]) { g.strokeStyle = css(colour); g.beginPath(); g.arc(X(p), Y(p), 5, 0, 7); g.stroke(); }
    }
  });
}
