// The colour of a mesh: of its texture, of its vertices, or of one tint that is shaded flat by a light at the camera.
// The back of a face is darker: a hollow surface, seen from behind, would otherwise look like a solid one from the front.

precision highp float;

const int TINT = 0, VERTICES = 1, TEXTURE = 2, LINES = 3;
const float AMBIENT = 0.3;
const float BACK = 0.4;  // brightness of the back of a face

uniform int coloring;
uniform vec4 tint;  // RGB and opacity, of what has no colours
uniform highp sampler2D photo;

in vec3 seen;
in vec3 paint;
in vec2 place;

out vec4 light;

void main() {
    vec3 normal = cross(dFdx(seen), dFdy(seen));
    float facing = abs(dot(normal, seen)) / max(length(normal) * length(seen), 1e-30);
    float side = gl_FrontFacing ? 1.0 : BACK;
    vec3 texel = texture(photo, place).rgb;
    if (coloring == TEXTURE) light = vec4(side * texel, 1.0);
    else if (coloring == VERTICES) light = vec4(side * paint, 1.0);
    else if (coloring == LINES) light = vec4(tint.rgb * tint.a, tint.a);
    else light = vec4(side * (AMBIENT + (1.0 - AMBIENT) * facing) * tint.rgb * tint.a, tint.a);
}
