"use strict";
// Figures of several runs side by side.

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
    done.forEach((one, k) => [["frames", one.counts], ...figures(one)]
      .forEach(([name, text]) => { (rows[name] = rows[name] || [])[k] = text; }));
    table.replaceChildren(done.length ? make("table", {},
      make("thead", {}, make("tr", {}, make("th", { scope: "col" }, "Figure"), ...done.map((one) => make("th", { scope: "col" }, one.path)))),
      make("tbody", {}, ...Object.entries(rows).map(([name, cells]) => make("tr", {}, make("th", { scope: "row" }, name),
        ...done.map((_, k) => make("td", { class: "number" }, cells[k] || "")))))) : "Choose two finished runs above, or more: their figures stand side by side here.");
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

