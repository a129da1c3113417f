// A point of the capture as a square on the screen.

uniform mat3 R;
uniform vec3 eye;
uniform vec2 focal;
uniform vec2 middle;
uniform vec2 size;
uniform float near;
uniform float dense;  // pixels of the canvas per CSS pixel

uniform float side;   // of the square, CSS pixels

layout(location = 0) in vec3 position;
layout(location = 1) in vec3 color;

out vec3 paint;

void main() {
    vec3 seen = R * (position - eye);
    vec2 ndc = 2.0 * (focal * seen.xy + (middle + 0.5) * seen.z) / size - seen.z;
    gl_Position = vec4(ndc.x, -ndc.y, seen.z - 2.0 * near, seen.z);
    gl_PointSize = side * dense;
    paint = color;
}
