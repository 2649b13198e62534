// One splat as a quad, as gaussians.py has it: J W S W^T J^T + dilation, in pixels, and its color from here.
precision highp float;
precision highp int;

uniform highp sampler2D places, bytes;
uniform highp usampler2D order;
uniform int across;  // Splats in a row of the textures.
uniform mat3 turn;   // Right, up, back.
uniform vec3 eye;
uniform vec2 focal, center, size, scales, colors, depths;
uniform float dilation, harmonics;
uniform int shown;
uniform vec3 depth_colors[DEPTH_COLORS];  // From far to near.

out vec2 place;  // In standard deviations.
flat out vec4 shade;

const int TEXELS = 3 + (3 * ((DEGREE + 1) * (DEGREE + 1) - 1) + 3) / 4;

int splat;

vec4 texel(int number) {
  return texelFetch(bytes, ivec2(splat % across * TEXELS + number, splat / across), 0);
}

mat3 rotation(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
              2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
              2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec3 harmonic_color(vec3 look) {
  vec3 color = mix(vec3(colors.x), vec3(colors.y), texel(2).xyz);
#if DEGREE > 0
  float x = look.x, y = look.y, z = look.z, basis[16];
  basis[0] = -0.48860251190291987 * y;
  basis[1] = 0.48860251190291987 * z;
  basis[2] = -0.48860251190291987 * x;
#if DEGREE > 1
  basis[3] = 1.0925484305920792 * x * y;
  basis[4] = -1.0925484305920792 * y * z;
  basis[5] = 0.31539156525252005 * (3.0 * z * z - 1.0);
  basis[6] = -1.0925484305920792 * x * z;
  basis[7] = 0.5462742152960396 * (x * x - y * y);
#endif
#if DEGREE > 2
  basis[8] = 0.5900435899266435 * y * (y * y - 3.0 * x * x);
  basis[9] = 2.890611442640554 * x * y * z;
  basis[10] = 0.4570457994644658 * y * (1.0 - 5.0 * z * z);
  basis[11] = 0.3731763325901154 * z * (5.0 * z * z - 3.0);
  basis[12] = 0.4570457994644658 * x * (1.0 - 5.0 * z * z);
  basis[13] = 1.445305721320277 * z * (x * x - y * y);
  basis[14] = 0.5900435899266435 * x * (3.0 * y * y - x * x);
#endif
  float unit = 255.0 / 124.0 * harmonics;  // LARGEST of quantized.py
  for (int first = 0, at = 3; first < (DEGREE + 1) * (DEGREE + 1) - 1; first += 4, at += 3) {
    vec4 a = unit * (texel(at) - 128.0 / 255.0), b = unit * (texel(at + 1) - 128.0 / 255.0);
    vec4 c = unit * (texel(at + 2) - 128.0 / 255.0);
    color += basis[first] * a.xyz + basis[first + 1] * vec3(a.w, b.xy) + basis[first + 2] * vec3(b.zw, c.x);
    if (first + 3 < (DEGREE + 1) * (DEGREE + 1) - 1) color += basis[first + 3] * c.yzw;
  }
#endif
  return max(color, 0.0);
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  // Not drawn.
  int number = gl_VertexID >> 2;
  splat = int(texelFetch(order, ivec2(number % across, number / across), 0).x);
  vec3 mean = texelFetch(places, ivec2(splat % across, splat / across), 0).xyz;
  vec3 local = (mean - eye) * turn, look = normalize(mean - eye);
  vec4 form = texel(1);
  if (form.w < 1.0 / 255.0) return;

  vec3 deviations = exp(mix(vec3(scales.x), vec3(scales.y), form.xyz));
  mat3 axes = rotation(normalize(texel(0) * 255.0 - 128.0));
  mat3 spread = transpose(turn) * axes * mat3(deviations.x, 0, 0, 0, deviations.y, 0, 0, 0, deviations.z);
  mat3 rows = transpose(spread);
  float away = -local.z;
  vec2 limit = 1.3 * max(center, size - center) / focal, slope = clamp(local.xy / away, -limit, limit);
  vec3 across_x = focal.x / away * (rows[0] + slope.x * rows[2]), across_y = focal.y / away * (rows[1] + slope.y * rows[2]);
  float xx = dot(across_x, across_x) + dilation, xy = dot(across_x, across_y), yy = dot(across_y, across_y) + dilation;

  float middle = 0.5 * (xx + yy), radius = length(vec2(0.5 * (xx - yy), xy));
  vec2 axis = radius > 1e-6 * middle ? vec2(middle + radius - yy, xy) : vec2(1.0, 0.0);
  axis = dot(axis, axis) > 1e-12 * middle * middle ? normalize(axis) : vec2(0.0, 1.0);
  place = (vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2.0 - 1.0) * sqrt(2.0 * log(255.0 * form.w));
  vec2 offset = place.x * sqrt(middle + radius) * axis + place.y * sqrt(max(middle - radius, dilation)) * vec2(-axis.y, axis.x);
  vec2 at = vec2(center.x, size.y - center.y) + focal * local.xy / away + offset;
  gl_Position = vec4(2.0 * at / size - 1.0, 0.0, 1.0);

  vec3 color;
  if (shown == 1) {
    float scaled = float(DEPTH_COLORS - 1) * (1.0 - clamp((length(mean - eye) - depths.x) / (depths.y - depths.x), 0.0, 1.0));
    int below = min(int(scaled), DEPTH_COLORS - 2);
    color = mix(depth_colors[below], depth_colors[below + 1], scaled - float(below));
  } else if (shown == 2) {
    vec3 flattest = deviations.x < min(deviations.y, deviations.z) ? axes[0] : deviations.y < deviations.z ? axes[1] : axes[2];
    color = 0.5 - 0.5 * sign(dot(flattest, look)) * flattest;
  } else {
    color = harmonic_color(look);
  }
  shade = vec4(color, form.w);
}
