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

  // a unit's chart: drag to zoom into its dates, double click to see all
  for (const chart of document.querySelectorAll(".track")) {
    let span = [0, 1000], from = 0;
    const show = (...next) => {
      span = next;
      chart.querySelector(".plot").setAttribute("viewBox", `${span[0]} 0 ${span[1] - span[0]} 1000`);
      for (const sign of chart.querySelectorAll("[data-x]")) {
        const place = (100 * (sign.dataset.x - span[0])) / (span[1] - span[0]);
        sign.style.display = place < 0 || place > 100 ? "none" : "";
        for (const name of ["x", "x1", "x2", "cx"]) if (sign.hasAttribute(name)) sign.setAttribute(name, `${place}%`);
      }
    };
    const at = (event) => {
      const box = chart.getBoundingClientRect();
      return span[0] + ((span[1] - span[0]) * (event.clientX - box.left)) / box.width;
    };
    chart.addEventListener("mousedown", (event) => { from = at(event); event.preventDefault(); });
    chart.addEventListener("mouseup", (event) => {
      const ends = [from, at(event)].sort((a, b) => a - b);
      if (ends[1] - ends[0] > 0.02 * (span[1] - span[0])) show(...ends);
    });
    chart.addEventListener("dblclick", () => show(0, 1000));
  }

  // figures: drawn when they come into view, anew when units or ground change
  const dark = () => matchMedia("(prefers-color-scheme: dark)"), coarse = matchMedia("(pointer: coarse)").matches;
  const lighter = {
    "#1a1a1a": "#e6e6e6", "#d5d5d5": "#3d3d3d", "#6b6b6b": "#a8a8a8", "#0072B2": "#56B4E9",
    "#56B4E9": "#8fd0f5", "#D55E00": "#ff8f4d", "#009E73": "#3fcf9f",
  };
  const adapt = (figure) => JSON.parse(JSON.stringify(figure), (_, v) => {
    if (coarse && v?.name === "Toolbar") v.attributes.active_drag = null; // a finger scrolls the page
    return (dark().matches && typeof v === "string" && lighter[v]) || v;
  });
  const drawNow = async (box) => {
    const figure = data[`${box.dataset.chart}-${root.dataset.units}`] ?? data[`${box.dataset.chart}-si`];
    box.replaceChildren();
    const view = await Bokeh.embed.embed_item(adapt(figure), box);
    box.view = [...view.roots][0] ?? view;
  };
  // one after the other: units or ground may change while a figure is being drawn, and the last to come must stay
  const draw = (box) => {
    const now = () => drawNow(box);
    box.dataset.drawn = "1";
    return (box.drawing = Promise.resolve(box.drawing).then(now, now));
  };
  const boxes = [...document.querySelectorAll("[data-chart]")];
  const observer = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting && !entry.target.dataset.drawn) draw(entry.target);
  }, { rootMargin: "300px" });
  for (const box of boxes) observer.observe(box);
  const again = () => boxes.filter((box) => box.dataset.drawn).forEach(draw);
  dark().addEventListener("change", again); // of its own: one whose `matches` was read first tells of no change
  document.getElementById("units").addEventListener("change", (event) => {
    root.dataset.units = event.target.value;
    boxes.filter((box) => box.dataset.drawn && box.dataset.units).forEach(draw);
  });
})();
