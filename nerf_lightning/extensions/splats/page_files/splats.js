// ---- The scene as 3D Gaussian splats (Kerbl et al. 2023), drawn from the farthest to the nearest ----------------

const BUCKETS = 1 << 16;  // Of distances, by their logarithms.
const CORNERS = [0, 1, 2, 2, 1, 3];  // Of a quad, as two triangles.

// The planes of bytes of quantized.py: places, and for each splat texels of quaternion, sizes and opacity, color, harmonics.
function splatsOf(about, content) {
  const count = about.splats, rest = 3 * ((about.degree + 1) ** 2 - 1), texels = 3 + Math.ceil(rest / 4);
  if (content.length !== count * (20 + rest)) {
    throw new Refusal("The scene in this file is damaged: it does not have the size that it says. Fetch it again.");
  }
  const plane = (number) => content.subarray(number * count, (number + 1) * count);
  const words = new Uint32Array(3 * count), bytes = new Uint8Array(4 * texels * count);
  for (let axis = 0; axis < 3; axis++) {
    const [low, middle, high] = [0, 3, 6].map((first) => plane(first + axis));
    for (let i = 0; i < count; i++) words[3 * i + axis] = low[i] << 8 | middle[i] << 16 | high[i] << 24;
  }
  const planes = [16, 17, 18, 19, 9, 10, 11, 12, 13, 14, 15, null, ...Array.from({ length: rest }, (_, k) => 20 + k)];
  planes.forEach((number, into) => {
    if (number === null) return;
    const values = plane(number);
    for (let i = 0; i < count; i++) bytes[4 * texels * i + into] = values[i];
  });
  return { count, texels, places: new Float32Array(words.buffer), bytes };
}

class Picture {
  constructor(about, content) {
    this.about = about;
    this.canvas = byId("scene");
    const options = { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" };
    const gl = this.gl = this.canvas.getContext("webgl2", options);
    if (gl === null) {
      throw new Refusal("This browser does not have WebGL2, so the scene cannot be turned: here is a still picture of it. Current versions of Chrome, Firefox and Safari have it.");
    }
    this.splats = splatsOf(about, content);
    const { count } = this.splats;
    Object.assign(this, { depths: new Float32Array(count), depths_shown: [0, 1], starts: new Uint32Array(BUCKETS + 1) });
    this.program = this.linked();
    gl.useProgram(this.program);
    gl.disable(gl.DITHER);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.upload();
  }

  linked() {
    const gl = this.gl, program = gl.createProgram(), { degree, depth_colors: colors } = this.about;
    const head = `#version 300 es\n#define DEGREE ${degree}\n#define DEPTH_COLORS ${colors.length}\n`;
    for (const [kind, id] of [[gl.VERTEX_SHADER, "vertices"], [gl.FRAGMENT_SHADER, "pixels"]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, head + byId(id).textContent);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Refusal(`This browser's graphics refuse the scene: ${gl.getShaderInfoLog(shader)}`);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Refusal(`This browser's graphics refuse the scene: ${gl.getProgramInfoLog(program)}`);
    return program;
  }

  at(name) { return this.gl.getUniformLocation(this.program, name); }

  upload() {
    const gl = this.gl, { count, texels, places, bytes } = this.splats, { about } = this;
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE), across = Math.floor(most / texels), down = Math.ceil(count / across);
    if (down > most) throw new Refusal("This device cannot hold so many splats. Ask for a file with fewer (what.num_splats=100000).");
    const wide = new Float32Array(4 * across * down), padded = new Uint8Array(4 * texels * across * down);
    for (let i = 0; i < count; i++) wide.set(places.subarray(3 * i, 3 * i + 3), 4 * i);
    padded.set(bytes);
    this.texture(0, "places", gl.RGBA32F, across, down, gl.RGBA, gl.FLOAT, wide);
    this.texture(1, "bytes", gl.RGBA8, across * texels, down, gl.RGBA, gl.UNSIGNED_BYTE, padded);
    this.order = new Uint32Array(across * down);
    this.texture(2, "order", gl.R32UI, across, down, gl.RED_INTEGER, gl.UNSIGNED_INT, this.order);
    Object.assign(this, { across, down });
    // Two triangles each, not an instance each: a processor that stands in for graphics draws instances one by one.
    const corners = new Uint32Array(6 * count);
    for (let i = 0; i < corners.length; i++) corners[i] = 4 * Math.floor(i / 6) + CORNERS[i % 6];
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.uniform1i(this.at("across"), across);
    gl.uniform2fv(this.at("scales"), about.scales);
    gl.uniform2fv(this.at("colors"), about.colors);
    gl.uniform1f(this.at("harmonics"), about.harmonics);
    gl.uniform3fv(this.at("depth_colors"), about.depth_colors.flat());
    if (gl.getError() !== gl.NO_ERROR) throw new Refusal("This device has too little graphics memory for the scene. Ask for a file with fewer splats (what.num_splats=100000).");
  }

  texture(number, name, format, width, height, channels, type, values) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0 + number);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, channels, type, values);
    gl.uniform1i(this.at(name), number);
  }

  // The numbers of the splats before the eye, the farthest first: how many. Distances are along the axis.
  sort({ eye, axes }) {
    const { depths, order, starts } = this, { count, places } = this.splats, [x, y, z] = axes[2], from = dot(eye, axes[2]);
    let least = Infinity, most = -Infinity;
    for (let i = 0; i < count; i++) {
      const away = from - x * places[3 * i] - y * places[3 * i + 1] - z * places[3 * i + 2];
      const depth = depths[i] = away > this.about.near ? Math.log(away) : NaN;
      if (depth < least) least = depth;
      if (depth > most) most = depth;
    }
    const step = (BUCKETS - 1) / Math.max(most - least, 1e-6);
    starts.fill(0);
    for (let i = 0; i < count; i++) if (depths[i] === depths[i]) starts[((most - depths[i]) * step | 0) + 1]++;
    for (let bucket = 0; bucket < BUCKETS; bucket++) starts[bucket + 1] += starts[bucket];
    const drawn = starts[BUCKETS];
    for (let i = 0; i < count; i++) if (depths[i] === depths[i]) order[starts[(most - depths[i]) * step | 0]++] = i;
    return drawn;
  }

  // `share` of the window's pixels along each side.
  draw(view, share) {
    const gl = this.gl, ratio = share * window.devicePixelRatio;
    const [width, height] = ["clientWidth", "clientHeight"].map((side) => Math.max(1, Math.round(this.canvas[side] * ratio)));
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    const { focal, center } = lensIn(view, ratio);
    if (view.shown === 1) this.depths_shown = this.visibleDepths(view);
    gl.viewport(0, 0, width, height);
    gl.uniform2f(this.at("size"), width, height);
    gl.uniform2fv(this.at("focal"), focal);
    gl.uniform2fv(this.at("center"), center);
    gl.uniform3fv(this.at("eye"), view.eye);
    gl.uniformMatrix3fv(this.at("turn"), false, view.axes.flat());
    gl.uniform1f(this.at("dilation"), this.dilation(focal));
    gl.uniform1i(this.at("shown"), view.shown);
    gl.uniform2fv(this.at("depths"), this.depths_shown);
    const drawn = this.sort(view);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, this.across, this.down, gl.RED_INTEGER, gl.UNSIGNED_INT, this.order);
    gl.clearColor(...view.behind, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.drawElements(gl.TRIANGLES, 6 * drawn, gl.UNSIGNED_INT, 0);
  }

  // In a finer picture than the photographs' splats are wider by as much: they touch as they did in the fitting.
  dilation(focal) { return this.about.dilation * Math.max(1, focal[0] / this.about.focal) ** 2; }

  // The nearest and the farthest of the opaque splats in the window, without the outer 2 %, as the viewer has it.
  visibleDepths(view) {
    const { focal, center } = lensIn(view), { count, places, bytes, texels } = this.splats, found = [];
    for (let i = 0; i < count; i++) {
      if (bytes[4 * texels * i + 7] < 128) continue;
      const from = minus(places.subarray(3 * i, 3 * i + 3), view.eye);
      const [x, y, z] = view.axes.map((axis) => dot(axis, from));
      const [left, top] = [center[0] - focal[0] * x / z, center[1] + focal[1] * y / z];
      if (-z > this.about.near && left >= 0 && left < innerWidth && top >= 0 && top < innerHeight) found.push(length(from));
    }
    if (!found.length) return [0, 1];
    const sorted = Float32Array.from(found).sort(), at = (share) => sorted[Math.round(share * (found.length - 1))];
    return [at(0.02), Math.max(at(0.98), at(0.02) + 1e-6)];
  }

  // How far away the surface is along the ray through a place of the window (in pixels of CSS): where half of the light
  // is stopped; 0: nowhere.
  depth(view, x, y) {
    const { focal, center } = lensIn(view), { places, bytes, texels } = this.splats;
    const ray = unit([(x - center[0]) / focal[0], (center[1] - y) / focal[1], -1]);
    const look = view.axes.reduce((sum, axis, i) => plus(sum, axis, ray[i]), [0, 0, 0]);
    const pixel = this.dilation(focal) / focal[0] ** 2, [low, high] = this.about.scales, met = [];
    for (let i = 0; i < this.splats.count; i++) {
      const [w, qx, qy, qz, a, b, c, opacity] = bytes.subarray(4 * texels * i, 4 * texels * i + 8);
      const from = minus(view.eye, places.subarray(3 * i, 3 * i + 3)), along = -dot(from, look);
      const sizes = [a, b, c].map((byte) => Math.exp(2 * (low + (high - low) / 255 * byte)) + pixel * along * along);
      if (along <= this.about.near || dot(from, from) - along * along > 9 * Math.max(...sizes)) continue;
      const q = unit([w, qx, qy, qz].map((byte) => byte - 128));
      // The ray in the splat's own axes, in standard deviations: the densest point is the one nearest to its mean.
      const [o, d] = [from, look].map((vector) => inAxes(q, vector).map((each, k) => each / Math.sqrt(sizes[k])));
      const at = -dot(o, d) / dot(d, d), alpha = opacity / 255 * Math.exp(-0.5 * (dot(o, o) - at * at * dot(d, d)));
      if (alpha > 1 / 255) met.push([at, Math.min(alpha, 0.99)]);
    }
    let through = 1;
    for (const [at, alpha] of met.sort((one, other) => one[0] - other[0])) {
      through *= 1 - alpha;
      if (through <= 0.5) return at;
    }
    return 0;
  }
}

// A vector by the inverse of the rotation of a unit quaternion (w, x, y, z).
function inAxes([w, ...axis], vector) {
  const twice = cross(axis, vector).map((each) => 2 * each);
  return plus(plus(vector, twice, -w), cross(axis, twice));
}
