"use strict";
(() => {
  // The table is complete without this script, which sorts and filters its rows.
  const body = document.querySelector("#cells tbody");
  const rows = [...body.rows].map((row) => ({ row, text: row.textContent.toLowerCase() }));
  const filter = document.getElementById("filter");
  const count = document.getElementById("count");

  function applyFilter() {
    const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    let shown = 0;
    for (const { row, text } of rows) {
      row.hidden = !words.every((word) => text.includes(word));
      shown += row.hidden ? 0 : 1;
    }
    count.textContent = shown === rows.length ? `${shown}` : `${shown} of ${rows.length}`;
    document.getElementById("none").hidden = shown > 0;
  }

  /** Numbers sort before texts, and empty cells come last in either direction. */
  function compare(a, b, direction) {
    if (a === b) return 0;
    if (a === "" || b === "") return a === "" ? 1 : -1;
    const [x, y] = [Number(a), Number(b)];
    const order = Number.isNaN(x) || Number.isNaN(y) ? (a < b ? -1 : 1) : x - y;
    return direction * order;
  }

  function sortBy(head) {
    const direction = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    for (const other of head.parentElement.cells) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", direction > 0 ? "ascending" : "descending");
    const key = ({ row }) => row.cells[head.cellIndex].dataset.key ?? row.cells[head.cellIndex].textContent;
    body.append(...rows.slice().sort((a, b) => compare(key(a), key(b), direction)).map(({ row }) => row));
  }

  for (const head of document.querySelectorAll("#cells thead th")) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = head.textContent;
    button.addEventListener("click", () => sortBy(head));
    head.replaceChildren(button);
  }
  filter.disabled = false;
  filter.addEventListener("input", applyFilter);
  applyFilter();
})();
