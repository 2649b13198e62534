// ---- Named views, notes and distances: the file of what.views, in the capture's own frame ------------------------

const TOUCH = matchMedia("(pointer: coarse)").matches, TAP_ON = TOUCH ? "Tap" : "Click";
const MIDDLE = TOUCH ? "" : ", or press Enter for the center of the window";
const NARROW = matchMedia("(max-width: 700px)"), TOLD = 6000;  // milliseconds that a result stays
const GAP = 4;  // pixels between labels
const ASKS = {
  note: `${TAP_ON} the place that the note is about${MIDDLE}.`,
  distance: `${TAP_ON} the first point${MIDDLE}.`,
  second: `${TAP_ON} the second point${MIDDLE}.`,
};

class Marks {
  constructor(frames) {
    const { marks, metres } = frames.view.about;
    Object.assign(this, { frames, lists: marks, metres, path: frames.player.path, asks: null, first: null, chosen: null, drawn: [] });
  }

  listen() {
    const on = (id, what) => byId(id).addEventListener("click", what);
    on("add-view", () => this.addView());
    on("add-note", () => this.begin("note"));
    on("measure", () => this.begin("distance"));
    on("remove-mark", () => this.remove());
    for (const name of ["pointerdown", "wheel", "keydown"]) addEventListener(name, () => this.forget(), { capture: true, passive: true });
    on("save-marks", () => save("views.json", new Blob([JSON.stringify(this.lists, null, 1)], { type: "application/json" })));
    this.changed();
  }

  async addView() {
    const picture = document.querySelector("#photographs button[aria-pressed=true]");
    const camera = this.path.cameraOf(this.frames.view);
    const name = await asked("Name of this view", picture === null ? `view ${this.lists.views.length + 1}` : picture.title);
    if (name) this.add("views", { name: this.unique("views", "name", name), ...camera });
  }

  show(view) {
    this.frames.stop();
    this.path.look(this.frames.view, view);
    this.frames.ask();
  }

  // A note or a distance: its points are tapped next.
  begin(asks) {
    this.asks = asks;
    byId("told").textContent = ASKS[asks] ?? "";
    document.body.classList.toggle("asking", asks !== null);
    byId("add-note").setAttribute("aria-pressed", String(asks === "note"));
    byId("measure").setAttribute("aria-pressed", String(["distance", "second"].includes(asks)));
    if (asks !== null && NARROW.matches) byId("tools").open = false;  // the drawer lies over what is to be tapped
    byId("scene").focus();  // where Enter stands for the middle
  }

  // The middle of what is shown between the bars.
  tapMiddle() {
    const { top, width, height } = shownPart();
    this.tap(width / 2, top + height / 2);
  }

  async tap(x, y) {
    if (this.asks === null) return;
    const { view, picture } = this.frames, away = picture.depth(view, x, y);
    picture.draw(view, 1);
    if (!away) {
      byId("told").textContent = `There is nothing here. ${TAP_ON} a surface.`;
      return;
    }
    const { focal, center } = lensIn(view);
    const ray = unit([(x - center[0]) / focal[0], (center[1] - y) / focal[1], -1]);
    const point = this.path.toUser(view.axes.reduce((sum, axis, i) => plus(sum, axis, away * ray[i]), view.eye));
    if (this.asks === "note") {
      this.begin(null);
      const text = await asked("Note", "");
      if (text) this.add("notes", { text: this.unique("notes", "text", text), position: point });
    } else if (this.asks === "distance") {
      this.first = point;
      this.begin("second");
    } else {
      this.begin(null);
      this.add("distances", { from: this.first, to: point });
      const said = this.metres === null ? " in the capture's units (its scale is unknown)" : "";
      byId("told").textContent = this.told(this.lists.distances.at(-1)) + said;
      clearTimeout(this.passing);
      this.passing = setTimeout(() => this.forget(), TOLD);
    }
  }

  // A result stays until the next action; what is asked for, until it is done.
  forget() { if (this.asks === null) byId("told").textContent = ""; }

  // A name that no other mark of its kind has.
  unique(kind, key, name) {
    const taken = this.lists[kind].map((mark) => mark[key]), named = (count) => (count === 1 ? name : `${name} (${count})`);
    let count = 1;
    while (taken.includes(named(count))) count++;
    return named(count);
  }

  add(kind, mark) {
    this.lists[kind].push(mark);
    this.chosen = mark;
    this.changed();
  }

  remove() {
    for (const [kind, list] of Object.entries(this.lists)) this.lists[kind] = list.filter((mark) => mark !== this.chosen);
    this.chosen = null;
    this.changed();
  }

  told({ from, to }) {
    const units = length(minus(to, from));
    return this.metres === null ? units.toPrecision(3) : `${(units * this.metres).toPrecision(3)} m`;
  }

  changed() {
    const button = (mark, text, className, what) => {
      const made = document.createElement("button");
      Object.assign(made, { type: "button", textContent: text, className });
      made.setAttribute("aria-pressed", String(mark === this.chosen));
      made.addEventListener("click", () => {
        this.chosen = mark;
        this.changed();
        what();
      });
      return made;
    };
    const { views, notes, distances } = this.lists;
    byId("views").replaceChildren(...views.map((view) => button(view, view.name, "", () => this.show(view))));
    const pins = [
      ...distances.map((distance) => [distance, this.told(distance), "distance", [distance.from, distance.to]]),
      ...notes.map((note) => [note, note.text, "note", [note.position]]),
    ];
    this.drawn = pins.map(([mark, text, name, points]) => {
      const line = document.createElementNS("http://www.w3.org/2000/svg", "path");
      return { made: button(mark, text, name, () => {}), line, points: points.map((point) => this.path.fromUser(point)) };
    });
    byId("pins").replaceChildren(...this.drawn.map(({ made }) => made));
    byId("lines").replaceChildren(...this.drawn.map(({ line }) => line));
    byId("remove-mark").disabled = this.chosen === null;
    byId("save-marks").disabled = !Object.values(this.lists).some((list) => list.length);
    this.frames.player.changed();
    this.frames.ask();
  }

  // Labels stand at their points, or below other labels; those of points behind a surface are pale, those behind the camera
  // hidden.
  place() {
    const { view, picture } = this.frames, { focal, center } = lensIn(view), boxes = [];
    for (const { made, line, points } of this.drawn) {
      const seen = points.map((point) => {
        const [x, y, z] = view.axes.map((axis) => dot(axis, minus(point, view.eye)));
        return z < 0 ? [center[0] - focal[0] * x / z, center[1] + focal[1] * y / z] : null;
      });
      made.hidden = seen.includes(null);
      line.style.visibility = made.hidden ? "hidden" : "visible";
      if (made.hidden) continue;
      const [from, to] = [seen[0], seen.at(-1)], [x, y] = plus(from, to).map((each) => each / 2);
      const box = { x, top: y, width: made.offsetWidth, height: made.offsetHeight + GAP };
      for (const other of boxes.sort((a, b) => a.top - b.top)) {
        const beside = x >= other.x + other.width || other.x >= x + box.width;
        if (!beside && box.top < other.top + other.height && other.top < box.top + box.height) box.top = other.top + other.height;
      }
      boxes.push(box);
      const down = box.top - y;
      made.style.transform = `translate(${x}px, ${box.top}px)`;
      made.style.setProperty("--down", `${down}px`);
      line.setAttribute("d", `M ${from} L ${to} M ${x} ${y} v ${down}`);  // and down to a label that had to give way
      if (points.length > 1) continue;
      const away = picture.depth(view, x, y);
      const behind = away > 0 && away < 0.95 * length(minus(points[0], view.eye));
      for (const drawn of [made, line]) drawn.classList.toggle("behind", behind);
    }
  }
}

// What a person types into the page's own form; null: nothing.
function asked(question, value) {
  const [dialog, name] = ["naming", "name"].map(byId);
  byId("asked").textContent = question;
  name.value = value;
  dialog.showModal();
  name.select();
  return new Promise((found) => {
    name.form.onsubmit = () => found(name.value);
    dialog.onclose = () => { if (!dialog.open) found(null); };  // open: it asks the next question
  });
}
