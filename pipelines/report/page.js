"use strict";
(() => {
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

  document.getElementById("units").addEventListener("change", (event) => {
    document.documentElement.dataset.units = event.target.value;
  });
})();
