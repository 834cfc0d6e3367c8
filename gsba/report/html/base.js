"use strict";
const D = JSON.parse(document.getElementById("data").textContent);
const F = D.frames, N = F.name.length;
const el = id => document.getElementById(id);
const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const pxPerDeg = D.erp_width / 360;

/* Elements, with texts as texts: names of frames are never markup. */
function make(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...children.filter(child => child !== null));
  return node;
}

/* Four digits, thousands apart. */
function num(value, digits = 3) {
  if (value === null || value === undefined) return "–";
  if (Number.isInteger(value)) return value.toLocaleString("en").replace(/,/g, "\u202f");
  const size = Math.abs(value);
  if (size >= 1e5 || (size < 1e-4 && size > 0)) return value.toExponential(2);
  return String(+value.toPrecision(digits));
}

/* Drawing surfaces: sharp on every screen, drawn anew when size or theme change. */
const surfaces = [];
function surface(canvas, draw) {
  const one = { canvas, draw, width: 0, height: 0 };
  one.redraw = () => {
    const ratio = window.devicePixelRatio || 1;
    one.width = canvas.clientWidth; one.height = canvas.clientHeight;
    canvas.width = Math.round(one.width * ratio); canvas.height = Math.round(one.height * ratio);
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, one.width, one.height);
    context.font = "11px system-ui, sans-serif";
    draw(context, one.width, one.height);
  };
  surfaces.push(one);
  return one;
}
let waiting = false;
function redraw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => { waiting = false; surfaces.forEach(one => one.redraw()); });
}
window.addEventListener("resize", redraw);

/* The frame pointed at, wherever that is. */
let marked = -1;
function mark(f) {
  if (f !== marked) { marked = f; redraw(); }
}
const STARTED = D.report.start !== "pairs of frames";  // else there are no poses before refinement
const SOURCES = [D.report.start, "interpolated", "extrapolated", D.report.start];
function describe(f) {
  const moved = STARTED ? `moved ${num(F.moved[f])} units, turned ${num(F.turned_deg[f])}°\n` : "";
  return `${F.name[f]}  ·  ${F.time[f].toFixed(3)} s\n${moved}` +
    `residual ${residualText(F.residual_deg[f])}, ${num(F.observations[f])} observations\n` +
    `start: ${SOURCES[F.source[f]]}${F.status[f] ? "  ·  not refined" : ""}`;
}
function residualText(degrees) {
  return degrees === null ? "none" : `${num(degrees)}° (${num(degrees * pxPerDeg)} px)`;
}

function tip(event, text) {
  const box = el("tip");
  if (!text) { box.style.opacity = 0; return; }
  box.textContent = text;
  box.style.opacity = 0.96;
  const width = box.offsetWidth, height = box.offsetHeight;
  const x = Math.min(event.clientX + 14, innerWidth - width - 8);
  const y = event.clientY + 18 + height > innerHeight ? event.clientY - height - 12 : event.clientY + 18;
  box.style.transform = `translate(${Math.max(4, x)}px, ${Math.max(4, y)}px)`;
}
/* `locate` gives [text, frame] for a place on a canvas, or null. */
function hover(canvas, locate) {
  canvas.addEventListener("pointermove", event => {
    const found = locate(event.offsetX, event.offsetY);
    tip(event, found ? found[0] : "");
    mark(found ? found[1] : -1);
  });
  canvas.addEventListener("pointerleave", event => { tip(event, ""); mark(-1); });
}

/* Text that stays legible on whatever is below it. */
function label(g, text, x, y) {
  g.strokeStyle = css("--card"); g.lineWidth = 4; g.lineJoin = "round"; g.strokeText(text, x, y);
  g.fillStyle = css("--quiet"); g.fillText(text, x, y);
}

/* Round steps for an axis from low to high. */
function ticks(low, high, count) {
  const raw = (high - low) / Math.max(count, 1) || 1;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].find(s => s * power >= raw) * power;
  const out = [];
  for (let v = Math.ceil(low / step) * step; v <= high + step * 1e-9; v += step) out.push(+v.toPrecision(12));
  return out;
}

/* Colours between two, 0..1. */
function rgb(hex) { return [1, 3, 5].map(i => parseInt(hex.slice(i, i + 2), 16)); }
function ramp(low, high) {
  const a = rgb(low), b = rgb(high);
  return t => `rgb(${a.map((v, i) => Math.round(v + (b[i] - v) * Math.min(1, Math.max(0, t)))).join(",")})`;
}

/* Theme: as the system has it, until somebody chooses. */
const dark = matchMedia("(prefers-color-scheme: dark)");
function theme(name) { document.documentElement.dataset.theme = name; redraw(); }
theme(dark.matches ? "dark" : "light");
dark.addEventListener("change", () => theme(dark.matches ? "dark" : "light"));
el("theme").addEventListener("click", () =>
  theme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"));
