// alpha = min(0.99, o exp(-d' Sigma2d^-1 d / 2)), zero below 1/255; blending multiplies the colour by it.

precision highp float;

uniform vec2 size;

flat in vec2 mean2d;
flat in vec3 conic;
flat in vec4 paint;

out vec4 light;

void main() {
    vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) - 0.5;  // integers; rows count downwards
    vec2 d = pixel - mean2d;
    float power = -0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) - conic.y * d.x * d.y;
    float alpha = min(ALPHA_MAX, paint.a * exp(power));
    if (!(alpha >= ALPHA_MIN)) discard;
    light = vec4(alpha * paint.rgb, alpha);
}
