"use strict";

// Tables of class "sortable" get a button in every header: once for ascending, again for descending. A cell's number
// is its data-value, or what its text begins with; a column with other text is sorted as text. Empty cells come last.

const NUMBER = /^[≈\s]*([+-]?\d[\d.]*(?:e[+-]?\d+)?)/i;

function column(table, place) {
  const cells = [...table.tBodies[0].rows].map((row) => {
    const cell = row.cells[place];
    return cell.dataset.value ?? cell.textContent.trim();
  });
  const numbers = cells.map((text) => (text === "" ? NaN : Number(NUMBER.exec(text)?.[1] ?? NaN)));
  const numeric = cells.every((text, i) => text === "" || !Number.isNaN(numbers[i]));
  return cells.map((text, i) => (text === "" ? null : numeric ? numbers[i] : text));
}

function sort(table, place, descending) {
  const keys = column(table, place);
  const order = keys.map((key, i) => i).sort((i, j) => {
    const [a, b] = [keys[i], keys[j]];
    if (a === null || b === null) return (a === null) - (b === null);
    const difference = typeof a === "number" ? a - b : a.localeCompare(b, undefined, { numeric: true });
    return descending ? -difference : difference;
  });
  const rows = [...table.tBodies[0].rows];
  table.tBodies[0].append(...order.map((i) => rows[i]));
}

for (const table of document.querySelectorAll("table.sortable")) {
  const headers = [...table.tHead.rows[0].cells];
  headers.forEach((header, place) => {
    const name = header.textContent.trim();
    if (name === "" || header.classList.contains("fixed")) return;
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = name;
    button.title = `Sort by ${name}`;
    button.addEventListener("click", () => {
      const descending = header.getAttribute("aria-sort") === "ascending";
      for (const other of headers) other.removeAttribute("aria-sort");
      header.setAttribute("aria-sort", descending ? "descending" : "ascending");
      sort(table, place, descending);
    });
    header.replaceChildren(button);
  });
}
