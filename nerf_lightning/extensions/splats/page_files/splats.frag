precision highp float;
in vec2 place;
flat in vec4 shade;
out vec4 pixel;

void main() {
  float alpha = min(shade.w * exp(-0.5 * dot(place, place)), 0.99);
  if (alpha < 1.0 / 255.0) discard;
  pixel = vec4(alpha * shade.xyz, alpha);
}
