/* Where long code may break, which tables do not fit into the page (site.css stacks their rows on phones), captions. */
const LONG = 36; // Shorter words of code (characters) stay whole: a line of a phone.
const LONG_IN_FULL_TABLES = 24; // The same in tables that do not fit into the page otherwise.
const SHORT = 12; // Characters of cells that share a line where rows are stacked.
const NUMBER = /^([-+~]?[\d.,]*\d(\s?(%|[a-zA-Z/]{1,6}))?(, | to |$))+$/; // also several
const LINES = 120; // Pixels: a cell of five lines.
const PHONE = matchMedia("(max-width: 700px)"); // as in site.css
const LABELED = 3; // Rows of fewer columns need no names of columns: site.css shows them once, above.
const tables = [...document.querySelectorAll("table.docutils")];
const columns = table => [...table.querySelectorAll("thead th")].map(cell => cell.textContent.trim());
const squeezed = cell => cell.offsetHeight > LINES && cell.offsetWidth < cell.closest("table").offsetWidth / 2;
const tooWide = table => table.scrollWidth > table.parentElement.clientWidth || (PHONE.matches && [...table.querySelectorAll("td")].some(squeezed));

function mayBreak(text) {
  text.replaceWith(...text.data.split(/(?<=\s)(?=\S)/).flatMap(word => {
    const parts = word.length > LONG_IN_FULL_TABLES ? word.split(/(?<=[/._=,:@])(?=\w{3})/) : [word];
    const chance = () => Object.assign(document.createElement("wbr"), {className: word.length > LONG ? "" : "if-wide"});
    return parts.flatMap((part, number) => (number ? [chance(), whole(part)] : [whole(part)]));
  }));
}

// Browsers break after hyphens and before brackets.
function whole(part) {
  if (part.length > LONG || !/[-[({]/.test(part)) return part;
  return Object.assign(document.createElement("span"), {className: "short", textContent: part});
}

function markWide() {
  for (const table of tables) table.classList.remove("wide");
  // Tables with the same columns look alike.
  const wide = new Set(tables.filter(tooWide).map(table => String(columns(table))));
  for (const table of tables) table.classList.toggle("wide", wide.has(String(columns(table))));
}

// A number and its unit stay on one line.
const UNIT = /(\d) (?=(dB|s|ms|min|h|GB|MB|kB|%)(?!\w))/g;
const words = document.createTreeWalker(document.querySelector("article"), NodeFilter.SHOW_TEXT);
while (words.nextNode()) if (!words.currentNode.parentElement.closest("pre, code")) words.currentNode.data = words.currentNode.data.replace(UNIT, "$1\u00a0");

// Each line of code is an element of its own, and what wraps of it is indented further; parts that span lines are split.
for (const pre of document.querySelectorAll(".highlight pre")) {
  const open = [];
  const split = pre.innerHTML.replace(/<span[^>]*>|<\/span>|\n/g, tag => {
    if (tag === "\n") return "</span>".repeat(open.length) + "\n" + open.join("");
    if (tag === "</span>") open.pop();
    else open.push(tag);
    return tag;
  });
  pre.innerHTML = split.replace(/\n$/, "").split("\n").map(line => `<span class="of-code">${line}\n</span>`).join("");
  for (const line of pre.children) line.style.setProperty("--indent", `${line.textContent.match(/^ */)[0].length}ch`);
}

for (const code of document.querySelectorAll("code.literal, .highlight pre")) {
  code.classList.toggle("short", code.matches(".literal") && code.textContent.length <= LONG_IN_FULL_TABLES);
  const walk = document.createTreeWalker(code, NodeFilter.SHOW_TEXT), texts = [];
  while (walk.nextNode()) texts.push(walk.currentNode);
  texts.filter(text => text.length > LONG_IN_FULL_TABLES).forEach(mayBreak);
}
for (const table of tables) {
  const names = columns(table);
  names.forEach((_, column) => {
    const cells = [...table.rows].map(row => row.cells[column]), texts = cells.slice(1).map(cell => cell.textContent.trim()).filter(Boolean);
    if (column && texts.length && texts.every(text => NUMBER.test(text))) cells.forEach(cell => cell.classList.add("number"));
  });
  let above = "";
  for (const row of table.querySelectorAll("tbody tr")) {
    if (row.cells[0].textContent.trim()) above = row.cells[0].innerHTML;
    [...row.cells].forEach((cell, column) => {
      const blank = !cell.textContent.trim() && !cell.querySelector("img");
      cell.classList.toggle("blank", blank);
      if (blank && column) cell.innerHTML = "<p>\u2013</p>";
      if (blank && !column && above) {
        cell.innerHTML = above;
        cell.classList.replace("blank", "above");
      }
      if ((!column && !NUMBER.test(cell.textContent.trim())) || names.length < LABELED || !names[column]) return;
      cell.dataset.column = names[column];
      cell.classList.toggle("short", cell.textContent.trim().length <= SHORT);
    });
  }
}
// What a picture shows, below it; figures of notebooks have titles.
for (const image of document.querySelectorAll("article p > img:only-child")) {
  const caption = document.createElement("figcaption");
  caption.textContent = image.alt;
  image.parentElement.after(caption);
}
addEventListener("resize", markWide);
markWide();
