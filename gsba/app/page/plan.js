"use strict";
// A map from above on a canvas: points by height or colour, the path, its start and its end.

function drawPlan(canvas, map, chosen = -1) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  const path = map.path, points = map.points;
  const known = path.filter(Boolean); // frames of other maps, and of none, have no place
  canvas.setAttribute("aria-label", known.length
    ? `The path from above: ${known.length} poses, ${points.length} points shown`
    : "The path from above: nothing yet");
  if (!known.length) return;
  const color = (name) => { // resolved for the light or the dark page
    canvas.style.color = `var(${name})`;
    return getComputedStyle(canvas).color;
  };
  const faint = color("--faint");
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  const grow = ([x, y]) => {
    box[0] = Math.min(box[0], x); box[1] = Math.min(box[1], y);
    box[2] = Math.max(box[2], x); box[3] = Math.max(box[3], y);
  };
  known.forEach(grow);
  // Points far from the path do not make it small: the box takes nine tenths of them.
  for (const axis of [0, 1]) {
    const values = points.map((point) => point[axis]).sort((a, b) => a - b);
    if (values.length) {
      box[axis] = Math.min(box[axis], values[Math.floor(0.05 * values.length)]);
      box[axis + 2] = Math.max(box[axis + 2], values[Math.floor(0.95 * (values.length - 1))]);
    }
  }
  const pad = 16, wide = Math.max(box[2] - box[0], 1e-9), tall = Math.max(box[3] - box[1], 1e-9);
  const scale = Math.min((width - 2 * pad) / wide, (height - 2 * pad) / tall);
  const at = ([x, y]) => [
    width / 2 + scale * (x - (box[0] + box[2]) / 2),
    height / 2 - scale * (y - (box[1] + box[3]) / 2),
  ];
  context.globalAlpha = 0.65;
  points.forEach((point, k) => {
    const own = map.colors && map.colors[k];
    context.fillStyle = own ? `rgb(${own[0]} ${own[1]} ${own[2]})` : faint;
    const [x, y] = at(point);
    context.fillRect(x - 1, y - 1, 2, 2);
  });
  context.globalAlpha = 1;
  context.strokeStyle = context.fillStyle = color("--blue");
  context.lineWidth = 2;
  const starts = new Set(map.starts);
  context.beginPath();
  path.forEach((position, k) => {
    if (!position) return;
    const [x, y] = at(position);
    if (starts.has(k) || !path[k - 1]) context.moveTo(x, y); else context.lineTo(x, y);
  });
  context.stroke();
  const dot = (position, name) => {
    context.fillStyle = color(name);
    context.beginPath();
    context.arc(...at(position), 5, 0, 2 * Math.PI);
    context.fill();
  };
  dot(known[0], "--green");
  dot(known[known.length - 1], "--orange");
  if (path[chosen]) {
    context.strokeStyle = color("--text");
    context.beginPath();
    context.arc(...at(path[chosen]), 9, 0, 2 * Math.PI);
    context.stroke();
  }
  canvas.placed = path.map((position) => position && at(position));
}

// Number of the pose that is drawn nearest to a place; -1 = none.
function nearestOnPlan(canvas, x, y) {
  const away = (place) => (place ? (place[0] - x) ** 2 + (place[1] - y) ** 2 : Infinity), placed = canvas.placed || [];
  return placed.reduce((best, place, k) => (best < 0 || away(place) < away(placed[best]) ? k : best), -1);
}
