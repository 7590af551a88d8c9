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

// Result lines: a link such as #lines?arm=current&is_success=true lists them.

const { files, rows } = JSON.parse(document.getElementById("lines-data").textContent);
const lines = rows.map(([file, number, arm, trainSeed, seed, isSuccess, isStrict, time, failure, offset, force, clip]) =>
  ({ file, number, arm, trainSeed, seed, isSuccess, isStrict, time, failure, offset, force, clip }));
const dialog = document.getElementById("lines");

function select(query) {
  const arm = query.get("arm");
  const versus = (query.get("versus") ?? "").split(",").filter(Boolean).map(decodeURIComponent);
  const arms = [arm, ...versus];
  const wanted = { isSuccess: query.get("is_success"), isStrict: query.get("is_strict") };
  let found = lines.filter((line) => arms.includes(line.arm));
  for (const [name, value] of Object.entries(wanted)) {
    if (value !== null) found = found.filter((line) => String(line[name]) === value);
  }
  for (const [name, value] of [["failure", query.get("failure")], ["trainSeed", query.get("train_seed")]]) {
    if (value !== null) found = found.filter((line) => String(line[name]) === value);
  }
  if (query.has("within")) {
    found = found.filter((line) => line.isSuccess && line.time <= Number(query.get("within")));
  }
  if (versus.length) {
    const episodes = new Map();
    for (const line of found) {
      const key = `${line.trainSeed} ${line.seed}`;
      episodes.set(key, [...(episodes.get(key) ?? []), line]);
    }
    const differ = query.get("is_different") === "true";
    found = [...episodes.values()].filter((episode) => episode.length === arms.length
      && (!differ || new Set(episode.map((line) => line.isSuccess)).size > 1)).flat();
    found.sort((a, b) => (a.trainSeed ?? -1) - (b.trainSeed ?? -1) || a.seed - b.seed
      || arms.indexOf(a.arm) - arms.indexOf(b.arm));
  }
  return found;
}

function describe(query, count) {
  const parts = [query.get("arm")];
  if (query.has("versus")) parts[0] += ` and ${query.get("versus").split(",").map(decodeURIComponent).join(", ")}, common seeds`;
  if (query.get("is_different") === "true") parts.push("outcomes that differ");
  if (query.has("is_success")) parts.push(query.get("is_success") === "true" ? "successes" : "failures");
  if (query.has("is_strict")) parts.push("strict successes");
  if (query.has("within")) parts.push(`successes within ${Number(query.get("within"))} s`);
  if (query.has("failure")) parts.push(query.get("failure").replaceAll("_", " "));
  if (query.has("train_seed")) parts.push(`training seed ${query.get("train_seed")}`);
  return `${parts.join(", ")}: ${count} line${count === 1 ? "" : "s"}`;
}

function rowOf(line) {
  const file = files[line.file];
  const link = document.createElement("a");
  link.href = `${file.split("/").map(encodeURIComponent).join("/")}#L${line.number}`;
  link.textContent = `${file}:${line.number}`;
  const row = document.createElement("tr");
  const cell = (content, sort = content, isText = false) => {
    const made = row.insertCell();
    made.append(content ?? "–");
    made.dataset.sort = sort ?? "";
    if (isText) made.className = "text";
  };
  cell(link, line.number, true);
  cell(line.arm, line.arm, true);
  cell(line.trainSeed);
  cell(line.seed);
  cell(line.failure.replaceAll("_", " ") || "success", line.failure, true);
  cell(line.isStrict ? "yes" : "no", Number(line.isStrict), true);
  cell(line.time?.toFixed(2), line.time);
  cell(line.offset?.map((part) => part.toFixed(1)).join(", "), line.offset && Math.hypot(...line.offset));
  cell(line.force.toFixed(1), line.force);
  cell(line.clip, line.clip, true);
  return row;
}

function showLines() {
  const [name, query] = location.hash.split(/\?(.*)/s);
  if (name !== "#lines" || !query) {
    if (dialog.open) dialog.close();
    return;
  }
  const chosen = new URLSearchParams(query);
  const found = select(chosen);
  document.getElementById("lines-title").textContent = describe(chosen, found.length);
  const table = dialog.querySelector("table");
  table.querySelectorAll("th[aria-sort]").forEach((head) => head.removeAttribute("aria-sort"));
  table.tBodies[0].replaceChildren(...found.map(rowOf));
  if (!dialog.open) dialog.showModal();
}

// Closing goes back in the page, not up to its top.
dialog.addEventListener("close", () => {
  if (location.hash.startsWith("#lines?")) history.replaceState(null, "", location.pathname + location.search);
});
document.getElementById("lines-close").addEventListener("click", () => dialog.close());
dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
window.addEventListener("hashchange", showLines);
showLines();
