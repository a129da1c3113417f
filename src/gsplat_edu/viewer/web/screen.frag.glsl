// Copies the finished image to the canvas, which rounds it to bytes.

precision highp float;

uniform highp sampler2D image;

out vec4 color;

void main() {
    color = vec4(clamp(texelFetch(image, ivec2(gl_FragCoord.xy), 0).rgb, 0.0, 1.0), 1.0);
}
