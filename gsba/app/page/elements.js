"use strict";
// Elements, requests and words that all parts of the page use.

const main = document.getElementById("main");
const POLL_MS = 1000;
let start = null; // forms and choices of the server
let view = 0; // number of the view that is shown: answers for an earlier one are dropped

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
const show = (...children) => main.replaceChildren(...children.filter(Boolean));
const picture = (path, more = "") => `api/picture?path=${encodeURIComponent(path)}${more}`;
const link = (path) => "files/" + path.split("/").map(encodeURIComponent).join("/");
const open = (kind, name) => `#${kind}/${encodeURIComponent(name)}`;

// Words of a command: a line does not break within an option.
const words = (command) => command.split(/(\s+)/).map((word) =>
  word.startsWith("-") ? make("span", { class: "option" }, word) : word);

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

function bytes(number) {
  const [size, unit] = [[1e12, "TB"], [1e9, "GB"], [1e6, "MB"], [1e3, "kB"]].find(([one]) => number >= one) || [1, "B"];
  return `${Number((number / size).toPrecision(3))} ${unit}`;
}
