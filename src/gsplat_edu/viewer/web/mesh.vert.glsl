// A vertex of a mesh, seen by the camera of the splats: u = fx x/z + cx, at integer pixel centres. Depths begin at
// `near` and have no end.

precision highp float;

uniform mat3 turn;  // of the mesh, with the scene
uniform vec3 shift;
uniform mat3 R;
uniform vec3 eye;
uniform vec2 focal;
uniform vec2 middle;
uniform vec2 size;
uniform float near;

layout(location = 0) in vec3 position;
layout(location = 1) in vec4 color;
layout(location = 2) in vec2 uv;

out vec3 seen;  // in the camera's axes
out vec3 paint;
out vec2 place;

void main() {
    seen = R * (turn * position + shift - eye);
    vec2 pixel = focal * seen.xy + (middle + 0.5) * seen.z;  // from the top left corner of the image, times depth
    vec2 ndc = 2.0 * pixel / size - seen.z;
    gl_Position = vec4(ndc.x, -ndc.y, seen.z - 2.0 * near, seen.z);
    paint = color.rgb;
    place = uv;
}
