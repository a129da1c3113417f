// Copies the finished image to the canvas, which rounds it to bytes; enlarges a smaller one.

precision highp float;

uniform highp sampler2D image;
uniform bool enlarged;
uniform vec2 size;  // of the canvas

out vec4 color;

void main() {
    vec4 light = enlarged ? textureLod(image, gl_FragCoord.xy / size, 0.0) : texelFetch(image, ivec2(gl_FragCoord.xy), 0);
    color = clamp(light, 0.0, 1.0);
}
