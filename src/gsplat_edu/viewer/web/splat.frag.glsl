// alpha = min(0.99, o exp(-d' Sigma2d^-1 d / 2)), zero below 1/255; blending multiplies the colour by it.

precision highp float;

uniform vec2 size;

#ifdef EDITING
uniform float ring_width;  // pixels; above 0, splats are drawn as rings
#endif

flat in vec2 mean2d;
flat in vec3 conic;
flat in vec4 paint;

out vec4 light;

#ifdef EDITING
const float RING = 4.0;    // squared standard deviations at which a ring lies, or closer if less of the splat is drawn
const float WITHIN = 0.9;  // of what is drawn
const float FILL = 0.08;   // of the alpha inside a ring
const float STROKE = 0.8;  // alpha of a ring

// Alpha of a splat as a ring: a line along an ellipse, and a faint inside.
float ringed(float alpha, float power, vec2 d) {
    float level = min(RING, WITHIN * 2.0 * log(paint.a / ALPHA_MIN));
    vec2 slope = vec2(conic.x * d.x + conic.y * d.y, conic.y * d.x + conic.z * d.y);  // half the gradient of -2 power
    float apart = abs(-2.0 * power - level) / max(2.0 * length(slope), 1e-6);
    return apart < 0.5 * ring_width ? STROKE : -2.0 * power < level ? FILL * alpha : 0.0;
}
#endif

void main() {
    vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) - 0.5;  // integers; rows count downwards
    vec2 d = pixel - mean2d;
    float power = -0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) - conic.y * d.x * d.y;
    float alpha = min(ALPHA_MAX, paint.a * exp(power));
    if (!(alpha >= ALPHA_MIN)) discard;
#ifdef EDITING
    if (ring_width > 0.0) alpha = ringed(alpha, power, d);
#endif
    light = vec4(alpha * paint.rgb, alpha);
}
