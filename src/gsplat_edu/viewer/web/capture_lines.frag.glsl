// A pixel of a line, smoothed at its edges; premultiplied by its opacity.

in vec4 paint;
in float across;
in float half_width;

out vec4 color;

void main() {
    float opacity = paint.a * clamp(half_width + 0.5 - abs(across), 0.0, 1.0);
    color = vec4(paint.rgb * opacity, opacity);
}
