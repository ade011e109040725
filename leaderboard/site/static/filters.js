"use strict";

// Hides the rows of the leaderboard that were not asked for. Tasks have different context sizes: where the chosen one
// does not exist, the task's middle one takes its place.

const filters = document.getElementById("filters");

function matches(row, names) {
  return names.every((name) => filters.elements[name].value === "" || filters.elements[name].value === row.dataset[name]);
}

function apply() {
  const board = document.getElementById("board");
  const rows = [...board.tBodies[0].rows];
  const { task, track, context } = filters.elements;
  const possible = new Set(rows.filter((row) => matches(row, ["task", "track"])).map((row) => row.dataset.context));
  for (const option of context.options) {
    option.disabled = option.hidden = option.value !== "" && !possible.has(option.value);
  }
  if (context.selectedOptions[0].disabled) {
    const middle = String(JSON.parse(filters.dataset.middles)[task.value]);
    context.value = possible.has(middle) ? middle : "";
  }
  board.classList.toggle("one-task", task.value !== "");
  board.classList.toggle("one-track", track.value !== "");
  for (const row of rows) row.hidden = !matches(row, ["task", "track", "context"]);
  for (const text of document.querySelectorAll(".about li")) {
    text.hidden = [task, track].some((one) => one.value !== "" && one.value !== (text.dataset[one.name] ?? one.value));
  }
  const shown = rows.filter((row) => !row.hidden).length;
  document.getElementById("count").textContent = `${shown} of ${rows.length} rows`;
}

if (filters) {
  filters.hidden = false;
  filters.addEventListener("change", apply);
  filters.addEventListener("submit", (event) => event.preventDefault());
  apply();
}
