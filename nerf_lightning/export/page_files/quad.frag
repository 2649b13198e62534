precision highp float;
in vec2 place;
flat in vec4 tint;
out vec4 pixel;

void main() {
  float alpha = min(tint.w * exp(-0.5 * dot(place, place)), 0.99);
  if (alpha < 1.0 / 255.0) discard;
  pixel = vec4(alpha * tint.xyz, alpha);
}
