// A line between two points, as a rectangle of a given width on the screen: vertices 0 and 1 are at its beginning.

uniform mat3 R;
uniform vec3 eye;
uniform vec2 focal;
uniform vec2 middle;
uniform vec2 size;
uniform float near;
uniform float scale;  // of the cameras' outlines
uniform float dense;  // pixels of the canvas per CSS pixel

layout(location = 0) in vec3 origin;
layout(location = 1) in vec3 begin;
layout(location = 2) in vec3 end;
layout(location = 3) in vec4 color;
layout(location = 4) in vec2 style;  // width, quarters of a CSS px; whether the line grows with the outlines

out vec4 paint;
out float across;  // px from the middle of the line
out float half_width;

vec3 seen_at(vec3 offset) {
    return R * (origin + (style.y > 0.5 ? scale : 1.0) * offset - eye);
}

vec2 pixel_of(vec3 seen) {
    return focal * seen.xy / seen.z + middle + 0.5;
}

void main() {
    vec3 a = seen_at(begin);
    vec3 b = seen_at(end);
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // not visible
    half_width = 0.125 * style.x * dense;
    paint = color;
    across = 0.0;
    if (max(a.z, b.z) <= near || color.a == 0.0) return;
    // the part before the near plane
    if (a.z < near) a = mix(a, b, (near - a.z) / (b.z - a.z));
    if (b.z < near) b = mix(b, a, (near - b.z) / (a.z - b.z));
    vec2 along = pixel_of(b) - pixel_of(a);
    float apart = max(length(along), 1e-6);
    vec2 normal = vec2(-along.y, along.x) / apart;
    int corner = gl_VertexID % 4;
    vec3 seen = corner < 2 ? a : b;
    across = (corner % 2 == 0 ? -1.0 : 1.0) * (half_width + 1.0);
    vec2 ndc = 2.0 * (pixel_of(seen) + across * normal) / size - 1.0;
    gl_Position = vec4(ndc.x * seen.z, -ndc.y * seen.z, seen.z - 2.0 * near, seen.z);
}
