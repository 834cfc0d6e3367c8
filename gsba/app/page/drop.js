"use strict";
// Files dropped onto the page: sent in parts, one after another, and taken up again after a break.

const PART_BYTES = 8 * 2 ** 20, RETRY_MS = 2000, MAX_PLAN = 200;
const drops = { queue: [], now: null, began: 0, sent: 0 };
const dropList = document.getElementById("drops-list"), dropNews = document.getElementById("drops-news");

function dropCard() {
  const files = make("input", { type: "file", id: "drop-files", hidden: true, multiple: true, "aria-label": "Files to drop",
    onchange: () => { take([...files.files].map((file) => ({ file, name: file.name }))); files.value = ""; } });
  return make("div", { class: "card drop" },
    make("p", {}, make("strong", {}, "Drop videos or folders of images here"), make("br"),
      make("span", { class: "faint" }, "They are copied into this folder. A copy that breaks off goes on when you drop the same file again.")),
    make("button", { type: "button", onclick: () => files.click() }, "Choose files"), files);
}

// Files of a drop with their paths in dropped folders. Entries must be asked for before any wait.
async function filesOf(transfer) {
  const entries = [...transfer.items].map((item) => [item.webkitGetAsEntry && item.webkitGetAsEntry(), item.getAsFile && item.getAsFile()]);
  const found = [];
  for (const [entry, file] of entries) {
    if (entry) await walk(entry, found);
    else if (file) found.push({ file, name: file.name });
  }
  return found;
}
async function walk(entry, found) {
  if (entry.name.startsWith(".")) return;
  if (entry.isFile) {
    const file = await new Promise((done, fail) => entry.file(done, fail));
    found.push({ file, name: entry.fullPath.replace(/^\//, "") });
    return;
  }
  const reader = entry.createReader();
  for (;;) { // a reader gives some entries at a time
    const some = await new Promise((done, fail) => reader.readEntries(done, fail));
    if (!some.length) return;
    for (const one of some) await walk(one, found);
  }
}

async function take(files) {
  if (!files.length) {
    say("Nothing was dropped that is a file.");
    return;
  }
  const folder = dropFolder;
  for (let first = 0; first < files.length; first += MAX_PLAN) {
    const some = files.slice(first, first + MAX_PLAN);
    let plans;
    try {
      plans = (await ask("api/drop", { folder, files: some.map(identity) })).files;
    } catch (error) {
      plans = some.map(() => ({ error: error.message }));
    }
    some.forEach((one, k) => {
      const drop = { ...one, folder, plan: plans[k], row: null };
      if (drop.plan.error) finish(drop, drop.plan.error, true);
      else if (drop.plan.state === "here") finish(drop, `${drop.plan.path} is here already`);
      else {
        if (drop.plan.renamed) note(`Another ${one.name} is here: this one becomes ${drop.plan.path}`);
        drops.queue.push(drop);
      }
    });
  }
  sendNext();
}
const identity = ({ file, name }) => ({ name, size: file.size, modified: file.lastModified });

async function sendNext() {
  if (drops.now) return;
  const drop = drops.now = drops.queue.shift() || null;
  if (!drop) return;
  Object.assign(drops, { began: Date.now(), sent: 0 });
  try {
    const went = await send(drop);
    if (went) finish(drop, `${drop.plan.path} has arrived`);
  } catch (error) {
    finish(drop, error.message, true);
  }
  drops.now = null;
  if (!drops.queue.length) refreshFiles();
  sendNext();
}

// Send a file from where it is; true = it is whole, false = the user stopped it.
async function send(drop) {
  let offset = drop.plan.offset;
  while (!drop.stopped) {
    showDrop(drop, offset);
    let part, answer;
    try {
      part = await drop.file.slice(offset, offset + PART_BYTES).arrayBuffer();
    } catch {
      throw new Error(`${drop.name} cannot be read: it was moved or changed; drop it again`);
    }
    const { path, size, modified } = drop.plan;
    try {
      answer = await fetch(`upload?${new URLSearchParams({ path, size, modified, offset })}`,
        { method: "POST", headers: { "content-type": "application/octet-stream" }, body: part });
    } catch { // the server is gone: it knows when it is back
      await new Promise((done) => setTimeout(done, RETRY_MS));
      offset = await arrived(drop, offset);
      continue;
    }
    const found = await answer.json().catch(() => ({ error: answer.statusText }));
    if (!answer.ok) throw new Error(found.error);
    drops.sent += found.offset - offset;
    offset = found.offset;
    if (found.done) return true;
  }
  refreshFiles();
  return false;
}
async function arrived(drop, offset) {
  try {
    const [plan] = (await ask("api/drop", { folder: drop.folder, files: [identity(drop)] })).files;
    return plan.error ? offset : plan.offset;
  } catch {
    return offset;
  }
}

function showDrop(drop, offset) {
  if (!drop.row) {
    const bar = make("progress", { "aria-label": `${drop.name} arriving` }), text = make("span", { class: "faint" });
    const stop = make("button", { type: "button", onclick: () => { drop.stopped = true; drop.row.node.remove(); hideDrops(); } }, "Stop");
    drop.row = { bar, text, node: make("li", {}, make("span", { class: "name" }, drop.name), bar, text, stop) };
    dropList.append(drop.row.node);
    document.getElementById("drops").hidden = false;
    say(`${drop.name} is being copied`);
  }
  const { size } = drop.plan, speed = drops.sent / Math.max(Date.now() - drops.began, 1); // bytes a ms
  drop.row.bar.max = size;
  drop.row.bar.value = offset;
  const left = drops.sent ? `, ${spoken((size - offset) / speed / 1000)} left` : "";
  const more = drops.queue.length ? `, ${drops.queue.length} more waiting` : "";
  drop.row.text.textContent = `${Math.floor(100 * offset / size)} % of ${bytes(size)}${left}${more}`;
}
function finish(drop, text, failed) {
  if (drop.row) drop.row.node.remove();
  note(text, failed);
}
function note(text, failed) {
  const row = make("li", { class: failed ? "error" : "" }, make("span", { class: "name" }, text),
    make("button", { type: "button", "aria-label": `Dismiss: ${text}`, onclick: () => { row.remove(); hideDrops(); } }, "×"));
  dropList.append(row);
  while (dropList.childElementCount > 8) dropList.firstElementChild.remove();
  document.getElementById("drops").hidden = false;
  say(text);
}
const say = (text) => { dropNews.textContent = text; };
const hideDrops = () => { document.getElementById("drops").hidden = !dropList.childElementCount; };
function refreshFiles() {
  const [name] = location.hash.slice(1).split("/");
  if (!name || name === "files") route();
}

// Drops that broke off earlier: the same file, dropped again, goes on.
function unfinishedCards(found) {
  const waiting = found.unfinished.filter((one) => !(drops.now && drops.now.plan.path.endsWith(one.name)));
  return waiting.map((one) => make("section", { class: "card" },
    make("p", {}, make("strong", {}, one.name), ` has arrived to ${Math.floor(100 * one.offset / one.size)} % of ${bytes(one.size)}. Drop the same file again, and the rest is copied.`),
    make("button", { type: "button", onclick: async () => {
      try {
        await ask("api/discard", { folder: found.path, part: one.part });
      } catch (error) {
        note(error.message, true);
      }
      refreshFiles();
    } }, `Discard ${one.name}`)));
}

const carriesFiles = (happening) => [...(happening.dataTransfer ? happening.dataTransfer.types : [])].includes("Files");
window.addEventListener("dragover", (happening) => {
  if (!carriesFiles(happening)) return;
  happening.preventDefault();
  document.body.classList.add("dragged");
});
window.addEventListener("dragleave", (happening) => { if (!happening.relatedTarget) document.body.classList.remove("dragged"); });
window.addEventListener("drop", async (happening) => {
  if (!carriesFiles(happening)) return;
  happening.preventDefault();
  document.body.classList.remove("dragged");
  try {
    await take(await filesOf(happening.dataTransfer));
  } catch (error) {
    note(`the drop cannot be read: ${error.message}`, true);
  }
});
window.addEventListener("beforeunload", (happening) => { if (drops.now) happening.preventDefault(); });
