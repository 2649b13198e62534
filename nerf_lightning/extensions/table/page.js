"use strict";

const body = document.querySelector("tbody");
const heads = [...document.querySelectorAll("th")];

// Numbers by size, texts by letters; what is not known comes last either way.
const compare = (one, other, direction) => {
  if (one === "" || other === "") return (one === "") - (other === "");
  const difference = Number(one) - Number(other);
  return direction * (Number.isNaN(difference) ? one.localeCompare(other) : difference);
};

heads.forEach((head, place) => {
  head.querySelector("button")?.addEventListener("click", () => {
    const order = head.getAttribute("aria-sort") === "descending" ? "ascending" : "descending";
    heads.forEach((each) => each.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", order);
    const by = (row) => row.cells[place].dataset.by;
    const rows = [...body.rows].sort((a, b) => compare(by(a), by(b), order === "ascending" ? 1 : -1));
    body.append(...rows);
  });
});

document.querySelector("input").addEventListener("input", (event) => {
  const words = event.target.value.toLowerCase().split(/\s+/).filter(Boolean);
  for (const row of body.rows) {
    const text = row.textContent.toLowerCase();
    row.hidden = !words.every((word) => text.includes(word));
  }
});
