"use strict";

const byId = (id) => document.getElementById(id);

// What is said to a person, in place of the scene.
class Refusal extends Error {}

function tell(text) {
  byId("message").textContent = text;
  byId("message").classList.add("wrong");
  document.body.classList.remove("running");
  document.body.dataset.state = "refused";
}

// ---- The file --------------------------------------------------------------------------------------------------

function readAbout() {
  const element = byId("about");
  if (element === null) throw new Refusal("This file is not whole: it ends before the scene. Fetch it again.");
  return JSON.parse(element.textContent);
}

async function readScene(about) {
  const element = byId("splats");
  const text = element === null ? "" : element.textContent;
  const expected = 4 * Math.ceil(about.bytes / 3);
  if (text.length !== expected) {
    const [there, all] = [text.length, expected].map((length) => (length / 1e6).toFixed(2));
    throw new Refusal(`This file is not whole: ${there} MB of the scene's ${all} MB are there. Fetch it again.`);
  }
  if (!("DecompressionStream" in window)) {
    throw new Refusal("This browser is too old to unpack the scene: use one of 2023 or later.");
  }
  try {
    const raw = atob(text);
    element.remove();
    const packed = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) packed[i] = raw.charCodeAt(i);
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  } catch (error) {
    throw new Refusal("The scene in this file is damaged: it cannot be unpacked. Fetch the file again.");
  }
}

// ---- The lens ----------------------------------------------------------------------------------------------------

// Top, width and height of the part of the window (in pixels of CSS) between the bars, which would hide it.
function shownPart() {
  const [above, below] = ["header", "footer"].map((name) => document.querySelector(name).offsetHeight);
  return { top: above, width: innerWidth, height: Math.max(1, innerHeight - above - below) };
}

const BESIDE = 8;  // pixels on either side of a photograph's frame

// Focal length and principal point of a view's lens, whose picture fits into that part of the window, in `ratio` pixels
// to one of CSS.
function lensIn({ lens }, ratio = 1) {
  const { top, width, height } = shownPart(), middle = [ratio * width / 2, ratio * (top + height / 2)];
  const scale = ratio * Math.min((width - 2 * BESIDE) / lens.width, height / lens.height);
  const center = middle.map((at, i) => at + scale * (lens.center[i] - [lens.width, lens.height][i] / 2));
  return { scale, center, focal: lens.focal.map((pixels) => scale * pixels) };
}

// ---- Where one looks from: an eye, three axes (right, up, back), and what it turns around ------------------------

const plus = (a, b, by = 1) => a.map((x, i) => x + by * b[i]);
const minus = (a, b) => plus(a, b, -1);
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const length = (a) => Math.sqrt(dot(a, a));
const unit = (a) => a.map((x) => x / Math.max(1e-12, length(a)));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

function turned(vector, axis, angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return plus(plus(vector.map((x) => c * x), cross(axis, vector), s), axis, (1 - c) * dot(axis, vector));
}

class View {
  constructor(about) {
    this.about = about;
    this.shown = 0;
    this.jump(about.first);
  }

  jump(number) {
    const camera = this.about.cameras[number];
    this.eye = [...camera.eye];
    this.axes = camera.axes.map((axis) => [...axis]);
    this.lens = camera;
    const ahead = -dot(minus(this.about.middle, this.eye), this.axes[2]);
    this.target = plus(this.eye, this.axes[2], -Math.max(ahead, 0.1 * this.about.radius));
    this.photograph = number;
  }

  orbit(right, up) {
    const pivots = [[this.about.up, -right]];
    // Not over the top, where right and left would change places.
    const steep = dot(turned(this.axes[2], this.axes[0], -up), this.about.up);
    if (Math.abs(steep) < 0.995 || Math.abs(steep) < Math.abs(dot(this.axes[2], this.about.up))) pivots.push([this.axes[0], -up]);
    for (const [axis, angle] of pivots) {
      this.eye = plus(this.target, turned(minus(this.eye, this.target), axis, angle));
      this.axes = this.axes.map((each) => turned(each, axis, angle));
    }
    this.photograph = null;
  }

  move(right, up, back) {
    const by = [right, up, back].reduce((sum, share, i) => plus(sum, this.axes[i], share), [0, 0, 0]);
    this.eye = plus(this.eye, by);
    this.target = plus(this.target, by);
    this.photograph = null;
  }

  // A camera in the middle of whose picture lies what it looks at.
  look(eye, target, up, lens) {
    const back = unit(minus(eye, target)), right = unit(cross(up, back));
    Object.assign(this, { eye, target, lens, axes: [right, cross(back, right), back], photograph: null });
  }

  pan(right, up) {
    const unit = length(minus(this.eye, this.target));
    this.move(-right * unit, -up * unit, 0);
  }

  zoom(factor) {
    const away = minus(this.eye, this.target);
    if (length(away) * factor > 1e-3 * this.about.radius) this.eye = plus(this.target, away, factor);
    this.photograph = null;
  }
}

// ---- Frames: coarse while something moves, as fine as the screen when nothing does -------------------------------

const PAUSE = 180, SLOW = 45, FAST = 22, COARSEST = 0.4;
const TURN = 24;  // seconds for once around, or to and fro

class Frames {
  constructor(picture, view) {
    Object.assign(this, { picture, view, share: 0.6, movedAt: -Infinity, before: 0, waits: false, keys: new Set() });
    Object.assign(this, { turning: false, turned: 0, drawing: false });
    this.player = new Player(this);
    this.marks = new Marks(this);
    this.step = this.step.bind(this);
  }

  // Whoever takes the camera stops the turntable, and what goes along the path.
  stop() {
    this.player.pause();
    this.turn(false);
  }

  moved() {
    this.stop();
    this.movedAt = performance.now();
    this.ask();
  }

  turn(on) {
    if (on) this.player.pause();
    this.turning = on;
    byId("turn").setAttribute("aria-pressed", String(on));
    this.ask();
  }

  // All around, or to and fro where the photographs were taken from one side.
  turntable(seconds) {
    const share = (at) => 2 * Math.PI * at / TURN, { sway } = this.view.about;
    const angle = (at) => (sway === null ? share(at) : sway * Math.sin(share(at)));
    this.view.orbit(angle(this.turned + seconds) - angle(this.turned), 0);
    this.turned += seconds;
  }

  ask() {
    document.body.dataset.state = "moving";
    if (!this.waits) requestAnimationFrame(this.step);
    this.waits = true;
  }

  step(now) {
    this.waits = false;
    const elapsed = now - this.before;
    this.before = now;
    if (this.keys.size && elapsed < 500) fly(this, elapsed / 1000);
    if (this.player.playing) this.player.advance();
    if (this.turning) this.turntable(Math.min(elapsed, 200) / 1000);
    place(this);
    this.marks.place();
    if (this.keys.size || this.player.playing || this.turning || performance.now() - this.movedAt < PAUSE) {
      // Pixels take the time, and the first frame after a pause tells nothing of it.
      if (this.drawing && elapsed > SLOW) this.share = Math.max(COARSEST, this.share * Math.max(0.5, Math.sqrt(SLOW / elapsed)));
      if (elapsed < FAST) this.share = Math.min(1, 1.05 * this.share);
      this.drawing = true;
      this.picture.draw(this.view, this.share);
      tellDepths(this);
      this.ask();
    } else {
      this.drawing = false;
      this.picture.draw(this.view, 1);
      tellDepths(this);
      document.body.dataset.state = "still";
    }
  }
}

const FLIGHT = { w: [0, 0, -1], s: [0, 0, 1], a: [-1, 0, 0], d: [1, 0, 0], e: [0, 1, 0], q: [0, -1, 0] };
const TURNS = { arrowleft: [1, 0], arrowright: [-1, 0], arrowup: [0, 1], arrowdown: [0, -1] };
const ZOOMS = { "+": -1, "=": -1, "-": 1 };

function fly(frames, seconds) {
  const view = frames.view, speed = 0.8 * view.about.radius * seconds;
  for (const key of frames.keys) {
    if (key in FLIGHT) view.move(...FLIGHT[key].map((share) => share * speed));
    if (key in TURNS) view.orbit(...TURNS[key].map((share) => -1.2 * seconds * share));
    if (key in ZOOMS) view.zoom(Math.exp(1.2 * seconds * ZOOMS[key]));
  }
  frames.movedAt = performance.now();
}

// The photograph lies over what its camera shows. Until somebody moves, scenes without bounds, where nothing may be known
// outside of its frame, are dark there; but not their depths, whose colors have a scale.
function place({ view, turning }) {
  const [frame, photograph, around] = ["frame", "photograph", "around"].map(byId), source = sourceOf(view.photograph);
  document.body.classList.toggle("framed", view.about.unbounded && view.shown === 0 && (turning || view.photograph !== null));
  frame.hidden = !source;
  for (const button of document.querySelectorAll("#photographs button")) {
    button.setAttribute("aria-pressed", String(Number(button.dataset.view) === view.photograph));
  }
  const { lens } = view, { scale, center } = lensIn(view), [left, top] = plus(center, lens.center, -scale);
  const box = { width: scale * lens.width, height: scale * lens.height, left, top };
  const edges = { left, top, right: left + box.width, bottom: top + box.height };
  for (const [name, pixels] of Object.entries(edges)) around.style.setProperty(`--${name}`, `${pixels}px`);
  for (const [name, pixels] of Object.entries(box)) frame.style[name] = `${pixels}px`;
  // The middle of the slider's thumb; at its ends there is one picture alone.
  const share = Number(byId("wipe").value) / 100, alone = share === 0 || share === 1;
  const [ofPhotograph, ofRender] = frame.querySelectorAll("span");
  frame.style.setProperty("--at", alone ? `${100 * share}%` : `calc(${14 - 28 * share}px + ${100 * share}%)`);
  byId("seam").hidden = alone;
  ofPhotograph.hidden = share === 0;
  ofRender.hidden = share === 1;
  ofRender.textContent = byId("shown").options[view.shown].text.replace("Color", "Render");
  if (source && photograph.src !== source) photograph.src = source;
}

// The colors of depths, with near and far in the capture's units, or in meters.
function tellDepths({ view, picture, player }) {
  byId("scale").hidden = view.shown !== 1;
  if (view.shown !== 1) return;
  const { metres, depth_colors: colors } = view.about, unit = metres === null ? "" : " m", nearest = [...colors].reverse();
  const color = (shares) => `rgb(${shares.map((share) => Math.round(255 * share)).join(" ")})`;
  document.querySelector("#scale i").style.background = `linear-gradient(to right, ${nearest.map(color).join(", ")})`;
  ["near", "far"].forEach((name, i) => {
    byId(name).value = (picture.depths_shown[i] * player.path.scale * (metres ?? 1)).toPrecision(3) + unit;
  });
}

function sourceOf(number) {
  const picture = number === null ? null : document.querySelector(`#photographs button[data-view="${number}"] img`);
  return picture === null ? "" : picture.src;
}

// ---- Mouse, fingers, keys, buttons -------------------------------------------------------------------------------

const TAP = 5;  // pixels that a pointer moves at most while it taps

function listenToPointers(canvas, frames) {
  const fingers = new Map(), view = frames.view;
  let pressed = null;
  const middle = () => [...fingers.values()].reduce((sum, at) => plus(sum, at, 1 / fingers.size), [0, 0]);
  const apart = () => length(minus(...[...fingers.values()].slice(0, 2)));
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pressed = fingers.size ? null : [event.clientX, event.clientY];
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("pointerup", (event) => {
    const at = [event.clientX, event.clientY];
    if (pressed !== null && length(minus(at, pressed)) < TAP) frames.marks.tap(...at);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const [before, wide] = [middle(), fingers.size > 1 ? apart() : 0];
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const [x, y] = minus(middle(), before).map((pixels) => pixels / canvas.clientHeight);
    if (fingers.size > 1) {
      view.pan(x, -y);
      view.zoom(wide / Math.max(1, apart()));
    } else if (event.shiftKey || event.buttons & 6) view.pan(x, -y);
    else view.orbit(4 * x, 4 * y);
    frames.moved();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    view.zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) / 300));
    frames.moved();
  }, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
}

function listenToKeys(frames) {
  const { marks } = frames, held = (key) => key in FLIGHT || key in TURNS || key in ZOOMS;
  const once = {
    1: () => show(frames, 0), 2: () => show(frames, 1), 3: () => show(frames, 2),
    b: () => byId("background").click(), h: () => hideControls(frames), home: () => home(frames),
    i: () => byId("numbers").showModal(), t: () => frames.turn(!frames.turning), f: fullScreen, p: () => savePicture(frames),
    v: () => marks.addView(), n: () => marks.begin("note"), m: () => marks.begin("distance"), escape: () => marks.begin(null),
    enter: () => marks.tapMiddle(), delete: () => marks.remove(), backspace: () => marks.remove(),
    " ": () => frames.player.toggle(), "[": () => next(frames, -1), "]": () => next(frames, 1),
  };
  addEventListener("keydown", (event) => {
    const key = event.key.toLowerCase();
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]") || event.target.matches("input, select")) return;
    if ((key === " " || key === "enter") && event.target.matches("button, summary")) return;  // it is pressed by that
    if (held(key)) {
      event.preventDefault();
      frames.keys.add(key);
      frames.moved();
    } else if (key in once && !event.repeat) once[key]();
  });
  addEventListener("keyup", (event) => frames.keys.delete(event.key.toLowerCase()));
  addEventListener("blur", () => frames.keys.clear());
}

function show(frames, what) {
  frames.view.shown = what;
  byId("shown").value = String(what);
  frames.ask();
}

function hideControls(frames) {
  document.body.classList.toggle("bare");
  frames.ask();
}

function fullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen();
}

function savePicture(frames) {
  frames.picture.draw(frames.view, 1);
  frames.picture.canvas.toBlob((blob) => save("scene.png", blob));
}

function jump(frames, number) {
  frames.stop();
  frames.view.jump(number);
  frames.ask();
}

// The view that it begins with.
function home(frames) {
  const { about } = frames.view, named = about.marks.views[about.first_view];
  if (named) frames.marks.show(named);
  else jump(frames, about.first);
}

function next(frames, by) {
  const count = frames.view.about.cameras.length, now = frames.view.photograph ?? frames.view.about.first;
  jump(frames, (now + by + count) % count);
}

function listenToControls(frames) {
  byId("shown").addEventListener("change", (event) => show(frames, Number(event.target.value)));
  byId("wipe").addEventListener("input", () => place(frames));
  byId("back").addEventListener("click", () => home(frames));
  byId("turn").addEventListener("click", () => frames.turn(!frames.turning));
  byId("picture").addEventListener("click", () => savePicture(frames));
  byId("full").addEventListener("click", fullScreen);
  byId("full").hidden = !document.fullscreenEnabled;
  for (const name of ["pointerdown", "wheel", "keydown"]) addEventListener(name, (event) => {
    if (!event.target.matches("#turn, #play") && ![" ", "t", "T"].includes(event.key)) frames.stop();
  }, { capture: true, passive: true });
  byId("about-run").addEventListener("click", () => byId("numbers").showModal());
  for (const button of document.querySelectorAll("dialog .close")) button.addEventListener("click", () => button.parentElement.close());
  const background = byId("background");
  const behind = () => [1, 3, 5].map((start) => parseInt(background.value.slice(start, start + 2), 16) / 255);
  background.addEventListener("input", () => {
    frames.view.behind = behind();
    frames.ask();
  });
  frames.view.behind = behind();
  for (const button of document.querySelectorAll("#photographs button")) {
    button.addEventListener("click", () => {
      if (byId("wipe").value === "0") byId("wipe").value = "50";  // who asks for a photograph wants to see it
      jump(frames, Number(button.dataset.view));
    });
  }
  addEventListener("resize", () => frames.ask());
}

async function start() {
  try {
    const about = readAbout(), picture = new Picture(about, await readScene(about));
    const frames = new Frames(picture, new View(about));
    picture.canvas.addEventListener("webglcontextlost", () => tell("The graphics of this device gave up. Open the page again."));
    listenToPointers(picture.canvas, frames);
    listenToKeys(frames);
    listenToControls(frames);
    frames.player.listen();
    frames.marks.listen();
    document.body.classList.add("running");
    home(frames);
    const compare = sourceOf(frames.view.photograph) ? "; drag the handle to compare with the photograph" : "";
    byId("told").textContent = `${TOUCH ? "One finger turns, two move and zoom" : "Drag to turn, scroll to zoom"}${compare}.`;
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) frames.turn(true);
  } catch (error) {
    if (!(error instanceof Refusal)) console.error(error);
    tell(error instanceof Refusal ? error.message : "This file is damaged: its scene cannot be read. Fetch it again.");
  }
}

// What follows this script in the file is there only then.
document.addEventListener("DOMContentLoaded", start);
