// Steps through blocks of density and colour (baked_field.py); marcher.py takes the same ones.
// Places are in voxels; a tile of 9 x 9 x 9 values is a block of 8 with the first values of the next ones.
precision highp float;
precision highp int;
precision highp sampler3D;
precision highp isampler3D;

const float SIDE = 8.0;
const float LEAST_ALPHA = 0.002, LEAST_TRANSMITTANCE = 0.004, LEAST_MET = 0.3;

uniform isampler3D index;
uniform sampler3D base;
#if HARMONICS > 1
uniform sampler3D more0, more1, more2;
#endif
#if HARMONICS > 4
uniform sampler3D more3, more4, more5;
#endif
uniform ivec3 shape;
uniform ivec3 atlas;
uniform vec3 lower, spacing, eye, behind;
uniform float voxel, step_length, height;
uniform mat3 turn;
uniform vec2 focal, center, exponents, ranges, depths;
uniform int shown;
#ifdef NDC
uniform vec2 ndc;
vec2 start_z;  // of a ray in normalised device coordinates, and how it grows
#endif
#ifdef CONTRACTED
uniform vec3 middle;
uniform float half_side, nearest;
#endif
out vec4 pixel;

float way_out(vec3 at, vec3 along) {
  vec3 low = floor(at / SIDE) * SIDE;
  vec3 to = mix(low - at, low + SIDE - at, greaterThan(along, vec3(0.0)));
  vec3 way = mix(vec3(1e9), to / along, greaterThan(abs(along), vec3(1e-9)));
  return min(way.x, min(way.y, way.z));
}

vec3 harmonic_color(vec3 coordinate, vec3 first, vec3 look) {
  vec3 color = first;
#if HARMONICS > 1
  float n = 128.0 / 255.0, one = ranges.x * 255.0 / 127.0;
  vec4 a = texture(more0, coordinate) - n, b = texture(more1, coordinate) - n, c = texture(more2, coordinate) - n;
  color += one * 0.4886025119 * (-look.y * a.xyz + look.z * vec3(a.w, b.xy) - look.x * vec3(b.zw, c.x));
#endif
#if HARMONICS > 4
  float two = ranges.y * 255.0 / 127.0;
  vec4 d = texture(more3, coordinate) - n, e = texture(more4, coordinate) - n, f = texture(more5, coordinate) - n;
  color += two * (1.0925484306 * (look.x * look.y * c.yzw - look.y * look.z * d.xyz - look.x * look.z * vec3(e.zw, f.x))
    + 0.3153915653 * (3.0 * look.z * look.z - 1.0) * vec3(d.w, e.xy)
    + 0.5462742153 * (look.x * look.x - look.y * look.y) * f.yzw);
#endif
  return clamp(color, 0.0, 1.0);
}

vec3 slope(vec3 start, vec3 within) {
  // Densities along the axes, without leaving the tile.
  vec3 size = vec3(atlas * 9), up = min(within + 1.0, SIDE), down = max(within - 1.0, 0.0);
  vec3 found;
  for (int axis = 0; axis < 3; axis++) {
    vec3 a = within, b = within;
    a[axis] = up[axis];
    b[axis] = down[axis];
    found[axis] = texture(base, (start + a.zyx + 0.5) / size).w - texture(base, (start + b.zyx + 0.5) / size).w;
  }
  return found;
}

// `hit` is where half of the light is stopped.
float through = 1.0, depth = 0.0, hit = 0.0;
vec3 color = vec3(0.0), normal = vec3(0.0);

// What a step of a share of a voxel's length stops at a place of a block, at a distance in the scene.
void stop(int tile, vec3 within, float share, float away, vec3 look) {
  vec3 start = 9.0 * vec3(tile % atlas.x, tile / atlas.x % atlas.y, tile / (atlas.x * atlas.y));
  vec3 coordinate = (start + within.zyx + 0.5) / vec3(atlas * 9);
  vec4 value = texture(base, coordinate);
  float alpha = 1.0 - exp(-(exp2(exponents.x + exponents.y * 255.0 * value.w) - exp2(exponents.x)) * share);
  if (alpha < LEAST_ALPHA) return;
  float weight = through * alpha;
  if (shown == 2) {
    vec3 uphill = slope(start, within);
    normal -= weight * uphill / max(length(uphill), 1e-6);
  } else if (shown == 0) {
    color += weight * harmonic_color(coordinate, value.xyz, look);
  }
  depth += weight * away;
  if (through > 0.5 && through * (1.0 - alpha) <= 0.5) hit = away;
  through *= 1.0 - alpha;
}

#ifdef CONTRACTED
// As voxel_kernels/contracted.py: rays are straight in each part of the contracted cube.
float largest(vec3 each) { return max(each.x, max(each.y, each.z)); }

float ahead(float way, float speed, float r, float v) {
  float left = speed * r - way * v;
  return left > 1e-9 ? way * r / left : -1.0;
}

void march(vec3 eye_place, vec3 look) {
  float t = nearest / half_side, cell = 4.0 / (SIDE * float(shape.x));
  vec3 origin = (eye_place - middle) / half_side;
  for (int turns = 0; turns < 4096 && through > LEAST_TRANSMITTANCE; turns++) {
    vec3 place = origin + t * look, along = look, size = abs(place);
    float r = largest(size), v = 0.0;
    if (r > 1e4) return;
    if (r > 1.0) {
      int axis = size.x == r ? 0 : size.y == r ? 1 : 2;
      float f = 1.0 / r, outward = look[axis];
      v = outward * place[axis] * f;
      place *= f;
      along = (look - place * v) * f;
      place[axis] *= 2.0 - f;
      along[axis] = outward * f * f;
    } else r = 1.0;
    float speed = length(along);
    along /= speed;
    vec3 at = (place + 2.0) / cell;
    ivec3 block = clamp(ivec3(at) / 8, ivec3(0), shape - 1);
    int tile = texelFetch(index, block.zyx, 0).x;
    float way = ahead(cell * (tile >= 0 ? step_length : max(way_out(at, along), 0.0) + 0.01), speed, r, v);
    if (way < 0.0) return;
    if (tile >= 0) {
      at += 0.5 * step_length * along;
      float shrunk = min(1.0, 2.0 - largest(abs(at * cell - 2.0)));
      vec3 within = clamp(at - SIDE * vec3(block), 0.0, SIDE);
      stop(tile, within, way * shrunk * shrunk / cell, half_side * (t + 0.5 * way), look);
    }
    t += way;
  }
}
#else
void march(vec3 origin, vec3 look) {
  vec3 along = look;
#ifdef NDC
  if (look.z > -1e-3) return;
  origin += max(0.0, -(1.0 + eye.z) / look.z) * look;
  vec3 start_point = vec3(-ndc * origin.xy / origin.z, 1.0 + 2.0 / origin.z);
  along = normalize(vec3(-ndc * look.xy / look.z, 1.0) - start_point);
  origin = start_point;
  start_z = vec2(origin.z, along.z);
#endif
  origin = (origin - lower) / spacing;
  along /= spacing;
  // How far one goes in the scene while going one in the grid.
  float far = 1.0 / length(along);
  along *= far;
  vec3 speed = mix(vec3(1e-9), along, greaterThan(abs(along), vec3(1e-9)));
  vec3 a = -origin / speed, b = (vec3(shape) * SIDE - origin) / speed;
  vec3 first = min(a, b), last = max(a, b);
  float enter = max(0.0, max(first.x, max(first.y, first.z))), leave = min(last.x, min(last.y, last.z));
  float number = 0.0;
  for (int turns = 0; turns < 8192 && through > LEAST_TRANSMITTANCE; turns++) {
    float t = enter + (number + 0.5) * step_length;
    if (t >= leave) return;
    vec3 at = origin + t * along;
    ivec3 block = clamp(ivec3(at) / 8, ivec3(0), shape - 1);
    int tile = texelFetch(index, block.zyx, 0).x;
    if (tile < 0) {
      float beyond = t + way_out(at, along);
      number = max(number + 1.0, ceil((beyond - enter) / step_length - 0.5));
      continue;
    }
    number += 1.0;
    stop(tile, clamp(at - SIDE * vec3(block), 0.0, SIDE), step_length * far / voxel, t * far, look);
  }
}
#endif

void main() {
  vec2 plane = (vec2(gl_FragCoord.x, height - gl_FragCoord.y) - center) / focal;
  vec3 look = normalize(turn * vec3(plane.x, -plane.y, -1.0));
  march(eye, look);
  float opacity = 1.0 - through;
#ifdef CLOSED
  float met = max(opacity, LEAST_MET);
  color /= met;
  opacity /= met;
#endif
  if (shown == 1) {
    float near = 1.0 - clamp((depth / max(1.0 - through, 1e-6) - depths.x) / (depths.y - depths.x), 0.0, 1.0);
    color = opacity * vec3(near);
  } else if (shown == 2) {
    color = opacity * (0.5 + 0.5 * normal / max(length(normal), 1e-6));
  }
  pixel = vec4(color + (1.0 - opacity) * behind, 1.0);
#ifdef NDC
  if (hit > 0.0) hit = (2.0 / (start_z.x + hit * start_z.y - 1.0) - eye.z) / look.z;
#endif
  if (shown == 3) pixel = vec4(vec3(uvec3(floatBitsToUint(hit)) >> uvec3(8, 16, 24) & 255u) / 255.0, 1.0);
}
