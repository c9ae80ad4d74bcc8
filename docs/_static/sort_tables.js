// Sort the tables of the results page by a click on the head of a column, or Enter on it: first the highest number or
// the first word, then the reverse. Empty cells stay at the end.
const value = (row, column) => row.cells[column].textContent.trim();
const number = (text) => parseFloat(text.replaceAll(",", ""));

function sort(table, head, column) {
  const texts = [...table.tBodies[0].rows].map((row) => value(row, column));
  const numeric = texts.every((text) => text === "" || !isNaN(number(text)));
  const first = numeric ? "descending" : "ascending";
  const order = head.ariaSort !== first ? first : numeric ? "ascending" : "descending";
  const compare = (a, b) => (numeric ? number(a) - number(b) : a.localeCompare(b)) * (order === "ascending" ? 1 : -1);
  const rows = [...table.tBodies[0].rows].sort((one, other) => {
    const [a, b] = [value(one, column), value(other, column)];
    return a === "" || b === "" ? (a === "") - (b === "") : compare(a, b);
  });
  for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
  head.ariaSort = order;
  table.tBodies[0].append(...rows);
}

document.addEventListener("DOMContentLoaded", () => {
  for (const table of document.querySelectorAll("section#results table")) {
    [...table.tHead.rows[0].cells].forEach((head, column) => {
      const button = document.createElement("button");
      button.append(...head.childNodes);
      button.addEventListener("click", () => sort(table, head, column));
      head.append(button);
    });
  }
});
