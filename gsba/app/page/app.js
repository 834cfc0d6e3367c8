"use strict";
// Views by the part of the address behind #.

async function route() {
  view += 1;
  const [name, rest] = location.hash.slice(1).split(/\/(.*)/s), argument = decodeURIComponent(rest || "");
  for (const tab of document.querySelectorAll("nav a")) {
    const of = { "#files": ["", "files", "start", "run"], "#jobs": ["jobs", "job"], "#compare": ["compare"] }[tab.hash];
    const here = of.includes(name);
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
  const views = { jobs, job, run: runPage, compare, start: startPage, files: footage };
  (views[name] || footage)(argument);
  window.scrollTo(0, 0);
}

async function countJobs() {
  try {
    const open = (await ask("api/jobs")).jobs.filter((one) => !ENDED.includes(one.status)).length;
    document.getElementById("queue-count").textContent = open ? ` (${open})` : "";
  } catch { /* the next call may succeed */ }
  setTimeout(countJobs, 3 * POLL_MS);
}

window.addEventListener("hashchange", () => {
  route();
  main.focus({ preventScroll: true }); // readers begin with the new view
});
route();
countJobs();
