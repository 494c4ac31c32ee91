"use strict";
(() => {
  const root = document.documentElement, data = JSON.parse(document.getElementById("data").textContent);
  const find = document.getElementById("find"), found = document.getElementById("found");
  const items = [...document.querySelectorAll("[data-find]")];

  const search = () => {
    const words = find.value.toLowerCase().split(/\s+/).filter(Boolean);
    let packs = 0;
    for (const item of items) {
      item.hidden = !words.every((w) => item.dataset.find.includes(w));
      if (!item.hidden && item.closest("#tonight")) packs += 1;
    }
    for (const group of document.querySelectorAll("[data-group]")) {
      group.hidden = group.querySelector("[data-find]:not([hidden])") === null;
    }
    for (const fold of document.querySelectorAll("details")) {
      fold.open = words.length > 0 && fold.querySelector("[data-find]:not([hidden])") !== null;
    }
    found.textContent = !words.length ? "" : packs === 1 ? found.dataset.one : `${packs} ${found.dataset.many}`;
  };
  find.addEventListener("input", search);
  search();

  const key = (row, i) => row.cells[i].dataset.v;
  const number = (v) => v !== undefined && v !== "" && !Number.isNaN(Number(v));
  const compare = (a, b) => (number(a) && number(b) ? a - b : a.localeCompare(b));
  for (const head of document.querySelectorAll("table.sortable th")) {
    head.addEventListener("click", () => {
      const body = head.closest("table").tBodies[0], i = head.cellIndex;
      const up = head.getAttribute("aria-sort") !== "ascending";
      for (const other of head.parentNode.cells) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const rows = [...body.rows];
      // what is not known stays below, whichever way the rest goes
      rows.sort((a, b) => {
        const x = key(a, i), y = key(b, i);
        if (x === undefined || y === undefined) return (x === undefined) - (y === undefined);
        return up ? compare(x, y) : compare(y, x);
      });
      body.append(...rows);
    });
  }

  // charts: drawn when they come into view, anew when units or ground change
  const dark = () => matchMedia("(prefers-color-scheme: dark)"), coarse = matchMedia("(pointer: coarse)").matches;
  const lighter = {
    "#1a1a1a": "#e6e6e6", "#d5d5d5": "#3d3d3d", "#6b6b6b": "#a8a8a8", "#0072B2": "#56B4E9",
    "#56B4E9": "#8fd0f5", "#D55E00": "#ff8f4d", "#B0578D": "#e39ac6", "#009E73": "#3fcf9f",
  };
  const coloured = (value) =>
    JSON.parse(JSON.stringify(value), (_, v) => (typeof v === "string" && lighter[v] ? lighter[v] : v));

  const asked = (box) => {
    const own = data.charts[box.dataset.units ? `${box.dataset.chart}-${root.dataset.units}` : box.dataset.chart]
      ?? data.charts[`${box.dataset.chart}-si`];
    if (own.figure) return { figure: own.figure, fill: own.fill };
    const other = own.other ? data.charts[own.other].own : {};
    const alone = own.own.x.length === 1 ? own.own : {};
    return { figure: data.track, fill: { ...own, other, alone, fleet: own.cc ? data.fleet : {}, cc: own.cc ?? {} } };
  };
  const fill = (node, values) => {
    if (node === null || typeof node !== "object") return;
    const told = values[node.attributes?.name];
    if (Array.isArray(told)) Object.assign(node.attributes, { start: told[0], end: told[1] });
    else if (told) {
      const columns = Object.fromEntries(node.attributes.data.entries.map(([name, none]) => [name, told[name] ?? none]));
      node.attributes.data = { type: "map", entries: Object.entries(columns) };
    }
    if (coarse && node.name === "Toolbar") node.attributes.active_drag = null; // a finger scrolls the page
    for (const child of Object.values(node)) fill(child, values);
  };
  const drawNow = async (box) => {
    const chart = structuredClone(asked(box));
    fill(chart.figure, chart.fill);
    box.replaceChildren();
    const view = await Bokeh.embed.embed_item(dark().matches ? coloured(chart.figure) : chart.figure, box);
    box.view = [...view.roots][0] ?? view;
    if (box.dataset.print) await toPaper(box, chart.figure);
  };
  // one after the other: units or ground may change while a chart is being drawn, and the last to come must stay
  const draw = (box) => {
    const now = () => drawNow(box);
    box.dataset.drawn = "1";
    return (box.drawing = Promise.resolve(box.drawing).then(now, now));
  };
  // what is printed is a picture: a page's width is another one on paper, and its ground is white
  const toPaper = async (box, figure) => {
    const plain = Object.entries(lighter).map(([light, onDark]) => [onDark, light]);
    const svg = new XMLSerializer().serializeToString(box.view.export("svg").canvas);
    const image = new Image();
    image.className = "paper";
    image.alt = "";
    image.src = `data:image/svg+xml,${encodeURIComponent(dark().matches ? plain.reduce((s, [a, b]) => s.replaceAll(a, b), svg) : svg)}`;
    box.nextElementSibling?.matches(".paper") && box.nextElementSibling.remove();
    box.after(image);
  };

  const boxes = [...document.querySelectorAll("[data-chart]")];
  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting && !entry.target.dataset.drawn) draw(entry.target);
  }, { rootMargin: "300px" });
  for (const box of boxes) seen.observe(box);
  const again = () => boxes.filter((box) => box.dataset.drawn).forEach(draw);
  dark().addEventListener("change", again); // of its own: one whose `matches` was read first tells of no change
  document.getElementById("units").addEventListener("change", (event) => {
    root.dataset.units = event.target.value;
    boxes.filter((box) => box.dataset.drawn && box.dataset.units).forEach(draw);
  });
  // those that are printed are made ready while nothing else is to do
  const ready = async () => {
    for (const box of boxes.filter((one) => one.dataset.print)) {
      await new Promise((idle) => requestIdleCallback(idle));
      if (!box.dataset.drawn) await draw(box);
    }
  };
  addEventListener("load", ready);
})();
