"use strict";

// A slider through pictures: one of them is shown.
for (const figure of document.querySelectorAll(".steps:has(input)")) {
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

// Photograph and render on top of each other: left of the line is the photograph.
for (const figure of document.querySelectorAll(".wipe")) {
  const slider = figure.querySelector("input");
  const move = () => figure.style.setProperty("--at", slider.value + "%");
  slider.addEventListener("input", move);
  move();
}

// Films in one row are equally high.
for (const film of document.querySelectorAll(".films video")) {
  const fit = () => film.parentElement.style.setProperty("--aspect", film.videoWidth / film.videoHeight);
  film.addEventListener("loadedmetadata", fit);
  if (film.videoWidth) fit();
}

// Color and depth of the same film play in step.
const [color, depth] = document.querySelectorAll(".paired video");
if (depth) {
  const align = (film, other) => {
    if (Math.abs(other.currentTime - film.currentTime) > 0.1) other.currentTime = film.currentTime;
  };
  for (const [film, other] of [[color, depth], [depth, color]]) {
    film.addEventListener("play", () => other.paused && other.play());
    film.addEventListener("pause", () => other.pause());
    film.addEventListener("seeking", () => align(film, other));
  }
  color.addEventListener("timeupdate", () => align(color, depth));
}

// Charts: each curve, smoothed where it is noisy, and the values at the pointer.
const COLORS = [
  "#2f6db3", "#c2560a", "#1f7f4f", "#8b4fbf", "#c3203f", "#5d6673", "#0a7c8c", "#7a4a1e", "#d01fa8", "#6c7200", "#1b1f8a", "#000000",
];
const HEIGHT = 260, LEFT = 56, RIGHT = 18, TOP = 8, BOTTOM = 34, SMOOTHING = 0.9;

function put(parent, name, attributes, text = "") {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return parent.appendChild(made);
}

// An exponential moving average without the bias of its start.
function smoothed(values) {
  let sum = 0, weight = 0;
  return values.map(value => {
    sum = SMOOTHING * sum + (1 - SMOOTHING) * value;
    weight = SMOOTHING * weight + (1 - SMOOTHING);
    return sum / weight;
  });
}

function ticks(low, high, count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find(factor => factor * power >= rough);
  const found = [];
  const from = Math.ceil(low / step);
  for (let k = 0; k <= 2 * count && (from + k) * step <= high * (1 + 1e-9); ++k) found.push((from + k) * step);
  return found;
}

function logarithmic(low, high) {
  const decades = high - low, found = [];
  for (let power = Math.floor(low); power <= high; ++power)
    for (const factor of decades < 2 ? [1, 2, 5] : [1]) {
      const value = power + Math.log10(factor);
      if (value >= low && value <= high) found.push(value);
    }
  if (found.length < 2) return ticks(10 ** low, 10 ** high, 4).map(Math.log10);
  return found.filter((_, number) => number % Math.ceil(found.length / 6) === 0);
}

// The labels of an axis, all in one notation.
function short(values) {
  const sizes = values.map(Math.abs).filter(size => size > 0), most = Math.max(...sizes);
  const tiny = Math.min(...sizes) < 1e-3;
  const [unit, letter] = tiny || most < 1e4 ? [1, ""] : most < 1e6 ? [1e3, "k"] : [1e6, "M"];
  return values.map(value => {
    const rounded = +(value / unit).toPrecision(3);
    return rounded === 0 ? "0" : tiny ? rounded.toExponential() : rounded + letter;
  });
}

function draw(figure, chart) {
  const place = figure.querySelector("div"), label = figure.querySelector("output");
  const width = place.clientWidth, scaled = chart.is_logarithmic ? Math.log10 : value => value;
  const back = chart.is_logarithmic ? value => 10 ** value : value => value;
  const curves = chart.curves.map(({label, steps, values}) => {
    const raw = values.map(scaled);
    return {label, steps, values, raw, line: chart.is_noisy && raw.length > 20 ? smoothed(raw) : raw};
  });
  const first = Math.min(...curves.map(curve => curve.steps[0]));
  const last = Math.max(...curves.map(curve => curve.steps.at(-1)));
  // One outlier does not flatten all the rest.
  const all = curves.flatMap(curve => curve.raw).sort((a, b) => a - b);
  let low = all[Math.floor(0.005 * all.length)], high = all[Math.ceil(0.995 * all.length) - 1];
  const margin = 0.05 * (high - low) || 0.05 * Math.abs(high) || 1;
  low -= margin; high += margin;
  if (chart.from_zero) { low = 0; high *= 1.05; }
  const x = step => LEFT + (step - first) / (last - first) * (width - LEFT - RIGHT);
  const y = value => TOP + (high - Math.min(high, Math.max(low, value))) / (high - low) * (HEIGHT - TOP - BOTTOM);

  place.replaceChildren();
  const svg = put(place, "svg", {width, height: HEIGHT, role: "img", "aria-label": chart.label});
  put(svg, "rect", {class: "grid", x: LEFT, y: TOP, width: width - LEFT - RIGHT, height: HEIGHT - TOP - BOTTOM});
  const heights = chart.is_logarithmic ? logarithmic(low, high) : ticks(low, high, 5), levels = short(heights.map(back));
  heights.forEach((value, k) => {
    put(svg, "line", {class: "grid", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value)});
    put(svg, "text", {x: LEFT - 6, y: y(value) + 4, "text-anchor": "end"}, levels[k]);
  });
  const marked = ticks(first, last, Math.max(2, width / 75)), steps = short(marked);
  marked.forEach((step, k) =>
    put(svg, "text", {x: x(step), y: HEIGHT - BOTTOM + 16, "text-anchor": "middle"}, steps[k]));
  put(svg, "text", {x: width - RIGHT, y: HEIGHT - 3, "text-anchor": "end"}, "step");
  curves.forEach((curve, number) => {
    const points = line => line.map((value, k) => `${x(curve.steps[k]).toFixed(1)},${y(value).toFixed(1)}`).join(" ");
    const stroke = COLORS[number % COLORS.length];
    if (curve.steps.length <= 12)
      curve.raw.forEach((value, k) => put(svg, "circle", {cx: x(curve.steps[k]), cy: y(value), r: 2.5, fill: stroke}));
    if (curve.line !== curve.raw) put(svg, "polyline", {class: "raw", stroke, points: points(curve.raw)});
    put(svg, "polyline", {stroke, points: points(curve.line)});
  });
  const cursor = put(svg, "line", {class: "cursor", y1: TOP, y2: HEIGHT - BOTTOM, visibility: "hidden"});

  const say = parts => {
    label.replaceChildren(...parts.map(([text, color]) => {
      const span = document.createElement("span");
      span.textContent = text;
      span.style.color = color;
      return span;
    }));
  };
  const legend = () => {
    cursor.setAttribute("visibility", "hidden");
    say(curves.length > 1 ? curves.map(({label}, number) => [label, COLORS[number % COLORS.length]])
      : [[`last: ${short([curves[0].values.at(-1)])[0]}`, ""]]);
  };
  const nearest = (steps, step) => steps.reduce((best, each, k) =>
    Math.abs(each - step) < Math.abs(steps[best] - step) ? k : best, 0);
  svg.addEventListener("pointermove", event => {
    const step = first + (event.offsetX - LEFT) / (width - LEFT - RIGHT) * (last - first);
    const at = curves[0].steps[nearest(curves[0].steps, step)];
    for (const key of ["x1", "x2"]) cursor.setAttribute(key, x(at));
    cursor.setAttribute("visibility", "visible");
    say([[`step ${at}`, ""], ...curves.map((curve, number) => {
      const value = curve.values[nearest(curve.steps, at)];
      return [`${curves.length > 1 ? curve.label + " " : ""}${+value.toPrecision(4)}`, COLORS[number % COLORS.length]];
    })]);
  });
  svg.addEventListener("pointerleave", legend);
  legend();
}

const charts = JSON.parse(document.getElementById("charts")?.textContent || "[]");
const drawAll = () => document.querySelectorAll(".chart").forEach((figure, number) => draw(figure, charts[number]));
let drawnWidth = 0;
new ResizeObserver(() => {
  if (document.body.clientWidth !== drawnWidth) {
    drawnWidth = document.body.clientWidth;
    drawAll();
  }
}).observe(document.body);
