/* Tables: where long code may break, and which ones do not fit into the page (site.css stacks their rows on phones). */
const LONG = 24; // Shorter words of code (characters) stay whole.
const LABELED = 4; // Rows of fewer columns need no names of columns.
const tables = [...document.querySelectorAll("table.docutils")];
const columns = table => [...table.querySelectorAll("thead th")].map(cell => cell.textContent.trim());
const tooWide = table => table.scrollWidth > table.parentElement.clientWidth;

function mayBreak(text) {
  const parts = text.data.split(/(?<=[/._=,:])(?=\w{3})/);
  text.replaceWith(...parts.flatMap((part, number) => (number ? [document.createElement("wbr"), part] : [part])));
}

function markWide() {
  for (const table of tables) table.classList.remove("wide");
  // Tables with the same columns look alike.
  const wide = new Set(tables.filter(tooWide).map(table => String(columns(table))));
  for (const table of tables) table.classList.toggle("wide", wide.has(String(columns(table))));
}

for (const code of document.querySelectorAll("td code")) {
  const walk = document.createTreeWalker(code, NodeFilter.SHOW_TEXT), texts = [];
  while (walk.nextNode()) texts.push(walk.currentNode);
  texts.filter(text => text.length > LONG).forEach(mayBreak); // Each word has a text of its own.
}
for (const table of tables) {
  const names = columns(table);
  for (const row of table.querySelectorAll("tbody tr"))
    [...row.cells].forEach((cell, column) => {
      cell.classList.toggle("blank", !cell.textContent.trim() && !cell.querySelector("img"));
      if (column && names.length >= LABELED && names[column]) cell.dataset.column = names[column];
    });
}
addEventListener("resize", markWide);
markWide();
