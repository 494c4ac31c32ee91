"use strict";
(() => {
  const find = document.getElementById("find"), found = document.getElementById("found");
  const items = [...document.querySelectorAll("[data-find]")];
  const search = () => {
    const words = find.value.toLowerCase().split(/\s+/).filter(Boolean);
    let packs = 0;
    for (const item of items) {
      item.hidden = !words.every((w) => item.dataset.find.includes(w));
      if (!item.hidden && item.closest("#ranking")) packs += 1;
    }
    for (const fold of document.querySelectorAll("details")) {
      fold.open = words.length > 0 && fold.querySelector("[data-find]:not([hidden])") !== null;
    }
    found.textContent = words.length ? `${packs} pack${packs === 1 ? "" : "s"}` : "";
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
})();
