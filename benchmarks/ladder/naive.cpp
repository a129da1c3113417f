// The plainest kernel: one pixel reads every splat, near to far.
#include "splats.h"

extern "C" void naive(const Splats *s, Drawn *out) {
    for (int y = 0; y < s->H; ++y)
        for (int x = 0; x < s->W; ++x) {
            float T = 1, r = 0, g = 0, b = 0;
            for (int64_t i = 0; i < s->count; ++i) {
                const float *q = s->conics + 3 * i, *c = s->colors + 3 * i;
                const float dx = x - s->means2d[2 * i], dy = y - s->means2d[2 * i + 1];
                const float power = -0.5f * (q[0] * dx * dx + q[2] * dy * dy) - q[1] * dx * dy;
                const float alpha = std::fmin(CEILING, s->opacities[i] * std::exp(power));
                if (alpha < FLOOR) continue;
                const float w = T * alpha;
                r += w * c[0], g += w * c[1], b += w * c[2];
                T -= w;
                ++out->mattered;
            }
            const int64_t pixel = int64_t(y) * s->W + x;
            float *rgb = out->image + 3 * pixel;
            rgb[0] = r, rgb[1] = g, rgb[2] = b, out->transmittance[pixel] = T;
        }
    out->evaluated = s->count * s->H * s->W;
}
