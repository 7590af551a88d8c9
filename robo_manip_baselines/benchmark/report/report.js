"use strict";

// Sorting: ascending, descending, as it was.

function sortTable(head) {
  const table = head.closest("table");
  const body = table.tBodies[0];
  const column = head.cellIndex;
  const rows = [...body.rows];
  rows.forEach((row, place) => { row.dataset.place ??= place; });
  const before = head.getAttribute("aria-sort");
  const now = { ascending: "descending", descending: null }[before];
  const order = before === null ? "ascending" : now;
  table.querySelectorAll("th[aria-sort]").forEach((other) => other.removeAttribute("aria-sort"));
  table.classList.toggle("sorted", order !== null);
  if (order === null) {
    rows.sort((a, b) => a.dataset.place - b.dataset.place);
  } else {
    head.setAttribute("aria-sort", order);
    const sign = order === "ascending" ? 1 : -1;
    rows.sort((a, b) => compare(a.cells[column].dataset.sort, b.cells[column].dataset.sort, sign));
  }
  body.append(...rows);
}

function compare(a, b, sign) {
  if (a === "" || b === "") return (a === "") - (b === ""); // what is missing comes last
  const numbers = [Number(a), Number(b)];
  if (!numbers.some(Number.isNaN)) return sign * (numbers[0] - numbers[1]);
  return sign * a.localeCompare(b, "en");
}

for (const button of document.querySelectorAll("table.sortable thead button")) {
  button.addEventListener("click", () => sortTable(button.closest("th")));
}

// Result rows: a link such as #rows?condition=current&is_success=true lists them.

const data = JSON.parse(document.getElementById("rows-data").textContent);
const rows = data.rows.map(([file, number, condition, trainSeed, seed, isSuccess, isStrict, time, failure, clip, ...columns]) =>
  ({ file: data.files[file], number, condition, trainSeed, seed, isSuccess, isStrict, time, failure, clip, columns }));
const dialog = document.getElementById("rows");

// Parameter of a link -> property of a row.
const properties = { is_success: "isSuccess", is_strict: "isStrict", failure: "failure", train_seed: "trainSeed" };

function otherConditions(query) {
  return (query.get("versus") ?? "").split(",").filter(Boolean).map(decodeURIComponent);
}

function select(query) {
  const conditions = [query.get("condition"), ...otherConditions(query)];
  let found = rows.filter((row) => conditions.includes(row.condition));
  for (const [parameter, property] of Object.entries(properties)) {
    const value = query.get(parameter);
    if (value !== null) found = found.filter((row) => String(row[property]) === value);
  }
  if (query.has("within")) {
    found = found.filter((row) => row.isSuccess && row.time <= Number(query.get("within")));
  }
  if (conditions.length > 1) {
    const episodes = new Map();
    for (const row of found) {
      const key = `${row.trainSeed} ${row.seed}`;
      episodes.set(key, [...(episodes.get(key) ?? []), row]);
    }
    const differ = query.get("is_different") === "true" ? "isSuccess"
      : query.get("is_strictly_different") === "true" ? "isStrict" : null;
    found = [...episodes.values()].filter((episode) => episode.length === conditions.length
      && (!differ || new Set(episode.map((row) => row[differ])).size > 1)).flat();
    found.sort((a, b) => (a.trainSeed ?? -1) - (b.trainSeed ?? -1) || a.seed - b.seed
      || conditions.indexOf(a.condition) - conditions.indexOf(b.condition));
  }
  return found;
}

function describe(query, count) {
  const parts = [query.get("condition")];
  if (query.has("versus")) parts[0] += ` and ${otherConditions(query).join(", ")}, common seeds`;
  if (query.get("is_different") === "true") parts.push("outcomes that differ");
  if (query.get("is_strictly_different") === "true") parts.push("strict outcomes that differ");
  if (query.has("is_success")) parts.push(query.get("is_success") === "true" ? "successes" : "failures");
  if (query.has("is_strict")) parts.push("strict successes");
  if (query.has("within")) parts.push(`successes within ${Number(query.get("within"))} s`);
  if (query.has("failure")) parts.push(query.get("failure").replaceAll("_", " "));
  if (query.has("train_seed")) parts.push(`training seed ${query.get("train_seed")}`);
  return `${parts.join(", ")}: ${count} row${count === 1 ? "" : "s"}`;
}

function tableRow(row) {
  const link = document.createElement("a");
  link.href = `${row.file.split("/").map(encodeURIComponent).join("/")}#L${row.number}`;
  link.textContent = `${row.file}:${row.number}`;
  const made = document.createElement("tr");
  const cell = (content, sort = content, isText = false) => {
    const cell = made.insertCell();
    cell.append(content ?? "–");
    cell.dataset.sort = sort ?? "";
    if (isText) cell.className = "text";
  };
  cell(link, row.number, true);
  cell(row.condition, row.condition, true);
  cell(row.trainSeed);
  cell(row.seed);
  cell(row.failure.replaceAll("_", " ") || "success", row.failure, true);
  cell(row.isStrict ? "yes" : "no", Number(row.isStrict), true);
  cell(row.time?.toFixed(2), row.time);
  for (const value of row.columns) { // a number, a vector, or null
    const isVector = Array.isArray(value);
    const text = isVector ? value.map((part) => part.toFixed(1)).join(", ") : value?.toFixed(1);
    cell(text, isVector ? Math.hypot(...value) : value);
  }
  cell(row.clip, row.clip, true);
  return made;
}

function showRows() {
  const [name, query] = location.hash.split(/\?(.*)/s);
  if (name !== "#rows" || !query) {
    if (dialog.open) dialog.close();
    return;
  }
  const chosen = new URLSearchParams(query);
  const found = select(chosen);
  document.getElementById("rows-title").textContent = describe(chosen, found.length);
  const table = dialog.querySelector("table");
  table.querySelectorAll("th[aria-sort]").forEach((head) => head.removeAttribute("aria-sort"));
  table.tBodies[0].replaceChildren(...found.map(tableRow));
  if (!dialog.open) dialog.showModal();
}

// Closing goes back in the page, not up to its top.
dialog.addEventListener("close", () => {
  if (location.hash.startsWith("#rows?")) history.replaceState(null, "", location.pathname + location.search);
});
document.getElementById("rows-close").addEventListener("click", () => dialog.close());
dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
window.addEventListener("hashchange", showRows);
showRows();
