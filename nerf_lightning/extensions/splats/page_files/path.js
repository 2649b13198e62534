// ---- A camera path: keyframes as nerf render path=keyframes reads them, in the capture's own frame ---------------

const LEG = 2;  // seconds from a named view to the next
const POINTS = ["position", "look_at", "up"];

// Rotations of keyframes as unit quaternions (w, x, y, z), each with the sign that is nearer to the one before.
function quaternionsOf(keys) {
  let before = [1, 0, 0, 0];
  return keys.map(({ position, look_at, up }) => {
    const back = unit(minus(position, look_at)), right = unit(cross(up, back)), [a, b, c] = [right, cross(back, right), back];
    const [x, y, z] = [b[2] - c[1], c[0] - a[2], a[1] - b[0]], [p, q, r] = [a[1] + b[0], c[0] + a[2], b[2] + c[1]];
    const rows = [
      [1 + a[0] + b[1] + c[2], x, y, z], [x, 1 + a[0] - b[1] - c[2], p, q],
      [y, p, 1 - a[0] + b[1] - c[2], r], [z, q, r, 1 - a[0] - b[1] + c[2]],
    ];
    const found = unit(rows.reduce((best, row) => (length(row) > length(best) ? row : best)));
    return before = dot(found, before) < 0 ? found.map((each) => -each) : found;
  });
}

// The curve through values at increasing times that nerf render takes: cubic, Catmull and Rom's tangents.
function hermite(times, values, at) {
  const leg = Math.max(0, Math.min(times.length - 2, times.findLastIndex((time) => time <= at)));
  const long = (i) => times[i + 1] - times[i], slope = (i) => minus(values[i + 1], values[i]).map((x) => x / long(i));
  const tangent = (i) => {
    if (i === 0 || i === times.length - 1) return slope(Math.min(i, times.length - 2));
    const [a, b] = [long(i - 1), long(i)];
    return plus(slope(i).map((x) => x * a), slope(i - 1), b).map((x) => x / (a + b));
  };
  const h = long(leg), s = (at - times[leg]) / h, terms = [
    [(1 + 2 * s) * (1 - s) ** 2, values[leg]], [s * (1 - s) ** 2 * h, tangent(leg)],
    [s * s * (3 - 2 * s), values[leg + 1]], [s * s * (s - 1) * h, tangent(leg + 1)],
  ];
  return terms.reduce((sum, [share, value]) => plus(sum, value, share), values[0].map(() => 0));
}

class CameraPath {
  constructor(about) {
    Object.assign(this, { given: about.path, marks: about.marks, film: about.film });
    const rows = about.to_user.slice(0, 3).map((row) => row.slice(0, 3));
    this.offset = about.to_user.slice(0, 3).map((row) => row[3]);
    this.scale = length(rows[0]);
    this.rows = rows.map(unit);
    this.columns = [0, 1, 2].map((i) => this.rows.map((row) => row[i]));
  }

  // From one named view to the next, else what came with the page.
  get keyframes() {
    const { views } = this.marks;
    return views.length > 1 ? views.map((view, i) => ({ ...view, time: LEG * i })) : this.given;
  }

  get seconds() { return this.keyframes.length > 1 ? this.keyframes.at(-1).time : 0; }

  toUser(point) { return this.rows.map((row, i) => this.scale * dot(row, point) + this.offset[i]); }
  fromUser(point) { return this.columns.map((column) => dot(column, minus(point, this.offset)) / this.scale); }

  // A camera as a keyframe file has it.
  cameraOf(view) {
    const [width, height] = this.film;
    const tangent = 0.5 * view.lens.height / view.lens.focal[1] * width / height;
    return {
      position: this.toUser(view.eye), look_at: this.toUser(view.target), up: this.rows.map((row) => dot(row, view.axes[1])),
      fov: 2 * Math.atan(tangent) * 180 / Math.PI,
    };
  }

  look(view, { position, look_at, up, fov }) {
    const focal = this.film[0] / 2 / Math.tan(fov * Math.PI / 360);
    const lens = { focal: [focal, focal], center: this.film.map((side) => side / 2), width: this.film[0], height: this.film[1] };
    view.look(this.fromUser(position), this.fromUser(look_at), this.columns.map((column) => dot(column, up)), lens);
  }

  show(view, seconds) {
    const keys = this.keyframes, times = keys.map((key) => key.time);
    const along = (value) => hermite(times, keys.map(value), seconds);
    const [position, look_at] = POINTS.slice(0, 2).map((name) => along((key) => key[name]));
    const [w, x, y, z] = unit(hermite(times, quaternionsOf(keys), seconds));
    const up = [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)];
    const tangent = Math.exp(along((key) => [Math.log(Math.tan(key.fov * Math.PI / 360))])[0]);
    this.look(view, { position, look_at, up, fov: 360 * Math.atan(tangent) / Math.PI });
  }

  yaml() {
    const number = (x) => x.toFixed(9);
    const lines = (key) => [...POINTS.map((name) => `${name}: [${key[name].map(number).join(", ")}]`), `fov: ${number(key.fov)}`, `time: ${number(key.time)}`];
    return `keyframes:\n${this.keyframes.map((key) => `- ${lines(key).join("\n  ")}\n`).join("")}`;
  }
}

class Player {
  constructor(frames) {
    Object.assign(this, { frames, path: new CameraPath(frames.view.about), playing: false, seconds: 0 });
  }

  listen() {
    const on = (id, name, what) => byId(id).addEventListener(name, what);
    on("play", "click", () => this.toggle());
    on("time", "input", () => { this.pause(); this.to(Number(byId("time").value)); });
    on("save", "click", () => save("camera_path.yaml", new Blob([this.path.yaml()], { type: "text/yaml" })));
  }

  // The time line after the views have changed.
  changed() {
    const { seconds } = this.path;
    this.pause();
    this.seconds = 0;
    Object.assign(byId("time"), { max: String(seconds || 1), value: "0" });
    for (const id of ["play", "time", "save"]) byId(id).disabled = !seconds;
    this.tell();
  }

  toggle() {
    this.playing = !this.playing && this.path.seconds > 0;
    if (this.playing) this.frames.turn(false);
    this.began = performance.now() / 1000 - this.seconds;
    byId("play").textContent = this.playing ? "Pause" : "Play";
    this.frames.ask();
  }

  pause() { if (this.playing) this.toggle(); }

  // Round and round, however long a frame takes.
  advance() {
    this.to((performance.now() / 1000 - this.began) % this.path.seconds);
    byId("time").value = String(this.seconds);
  }

  tell() { byId("length").value = `${this.seconds.toFixed(1)} / ${this.path.seconds.toFixed(1)} s`; }

  to(seconds) {
    this.seconds = seconds;
    this.tell();
    this.path.show(this.frames.view, seconds);
    this.frames.ask();
  }
}

function save(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
