// Copies the finished image to the canvas, which rounds it to bytes; enlarges a smaller one.

precision highp float;

uniform highp sampler2D image;
uniform bool enlarged;
uniform vec2 corner;  // of the part that is covered
uniform vec2 size;    // of that part

out vec4 color;

void main() {
    vec2 at = gl_FragCoord.xy - corner;
    vec4 light = enlarged ? textureLod(image, at / size, 0.0) : texelFetch(image, ivec2(at), 0);
    color = clamp(light, 0.0, 1.0);
}
