"use strict";

// A slider through pictures: one of them is shown.
for (const figure of document.querySelectorAll(".steps")) {
  const pictures = figure.querySelectorAll("img");
  const slider = figure.querySelector("input");
  const label = figure.querySelector("output");
  const show = () => {
    pictures.forEach((picture, number) => { picture.hidden = number !== Number(slider.value); });
    label.value = pictures[slider.value].alt;
  };
  slider.addEventListener("input", show);
  show();
}

// Truth and render on top of each other: what lies left of the line is truth.
for (const figure of document.querySelectorAll(".wipe")) {
  const slider = figure.querySelector("input");
  const move = () => figure.style.setProperty("--at", slider.value + "%");
  slider.addEventListener("input", move);
  move();
}
