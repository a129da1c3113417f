// The outline of a mask: pixels outside of it that have a pixel inside of it around them.

precision highp float;

uniform highp sampler2D mask;  // its alpha is the opacity of the selected splats
uniform vec2 size;             // of the canvas
uniform float width;           // of the outline, pixels of the canvas
uniform vec3 paint;

out vec4 color;

const float INSIDE = 0.2;  // opacity
const float DIAGONAL = 0.7071;

bool inside(vec2 offset) {
    return textureLod(mask, (gl_FragCoord.xy + width * offset) / size, 0.0).a >= INSIDE;
}

void main() {
    if (inside(vec2(0.0))) discard;
    bool near = inside(vec2(1.0, 0.0)) || inside(vec2(-1.0, 0.0)) || inside(vec2(0.0, 1.0)) || inside(vec2(0.0, -1.0));
    near = near || inside(vec2(DIAGONAL)) || inside(vec2(-DIAGONAL));
    near = near || inside(vec2(DIAGONAL, -DIAGONAL)) || inside(vec2(-DIAGONAL, DIAGONAL));
    if (!near) discard;
    color = vec4(paint, 1.0);
}
