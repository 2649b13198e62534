// A splat as a quad that ends where it adds less than 1/255.
precision highp float;

uniform vec2 size;

in vec2 spot;
in vec4 arms, shade;
out vec2 place;  // In standard deviations.
flat out vec4 tint;

void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  place = corner * sqrt(2.0 * log(max(255.0 * shade.w, 1.0)));
  tint = shade;
  vec2 at = spot + corner.x * arms.xy + corner.y * arms.zw;
  gl_Position = shade.w == 0.0 ? vec4(0.0, 0.0, 2.0, 1.0) : vec4(2.0 * at / size - 1.0, 0.0, 1.0);
}
