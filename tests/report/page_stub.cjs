// A browser in name only: every element takes every call, canvases draw into nothing.
// Runs the script of the page named on the command line, and every listener it registers.
const fs = require("fs");
const page = fs.readFileSync(process.argv[2], "utf8");
const data = page.match(/id="data">(.*?)<\/script>/s)[1];
const script = page.match(/<script>\n(.*?)<\/script>/s)[1];
const tiles = [], errors = [];
const context = () => new Proxy({ measureText: text => ({ width: 6 * text.length }) }, {
  get: (t, k) => k in t ? t[k] : (...a) => {
    for (const v of a) if (typeof v === "number" && !Number.isFinite(v)) errors.push(`${String(k)}(${a})`);
  },
  set: (t, k, v) => { t[k] = v; return true; },
});
function element(id) {
  const node = {
    id, dataset: {}, style: {}, listeners: {}, children: [], textContent: id === "data" ? data : "",
    clientWidth: 400, clientHeight: 200, offsetWidth: 50, offsetHeight: 20, width: 0, height: 0,
    classList: { add() {} }, append(...c) { node.children.push(...c); }, setAttribute() {}, remove() {}, setPointerCapture() {},
    addEventListener(kind, f) { (node.listeners[kind] ??= []).push(f); },
    getContext: () => node.context ??= context(),
    replaceChildren(...c) { node.children = c; }, complete: true, naturalWidth: 4,
  };
  all.push(node);
  return node;
}
const all = [], byId = {};
globalThis.document = {
  documentElement: element("root"), title: "",
  getElementById: id => byId[id] ??= element(id),
  createElement: tag => element(tag), createElementNS: (_, tag) => element(tag),
};
document.querySelectorAll = () => [];
globalThis.window = { devicePixelRatio: 2, addEventListener() {} };
globalThis.location = { protocol: "file:", pathname: "/runs/a%20walk/report.html" };
globalThis.getSelection = () => ({ selectAllChildren() {} });
globalThis.innerWidth = 800; globalThis.innerHeight = 600;
globalThis.getComputedStyle = () => ({ getPropertyValue: () => "#336699" });
globalThis.matchMedia = () => ({ matches: true, addEventListener() {} });
globalThis.requestAnimationFrame = f => f();
(0, eval)(script.replaceAll('"use strict";', ""));
const event = { offsetX: 120, offsetY: 80, clientX: 10, clientY: 10, deltaY: 50, key: "+", pointerId: 1, preventDefault() {} };
for (const node of [...all]) for (const kind of ["pointermove", "pointerdown", "pointermove", "pointerup", "wheel", "keydown", "dblclick", "pointerenter", "pointerleave", "change", "click"])
  for (const f of node.listeners[kind] ?? []) f(event);
if (errors.length) throw new Error("not finite: " + errors.slice(0, 3));
console.log(JSON.stringify([byId.tiles.children.length, byId.run.textContent, byId.worst?.children.length, byId.stages.children.length, byId.verdict?.children.at(-1)?.children[1]?.children,
  byId.tiles.children[0].children[2].children[0], byId["maps-table"]?.children.map(row => row.children.map(cell => cell.children[0]))]));
