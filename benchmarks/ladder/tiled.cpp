// Tiles: a tile reads only the splats whose 3-sigma box meets it, and stops when it is dark.
#include "lists.h"
#include "tile.h"

struct Box {
    int x0, y0, x1, y1;  // inclusive; x0 > x1 or y0 > y1 where it is off the screen
};

static Box box_of(const Splats &s, int64_t i) {
    const float A = s.conics[3 * i], B = s.conics[3 * i + 1], C = s.conics[3 * i + 2];
    const float det = A * C - B * B, mid = 0.5f * (A + C) / det;  // half the trace of the covariance, the inverse
    const float spread = std::sqrt(std::fmax(LAMBDA_FLOOR, mid * mid - 1 / det));
    const float reach = std::ceil(3 * std::sqrt(mid + spread)), u = s.means2d[2 * i], v = s.means2d[2 * i + 1];
    return {clamped(std::fmax(std::floor(u) - reach, 0), s.W), clamped(std::fmax(std::floor(v) - reach, 0), s.H),
            clamped(std::ceil(u) + reach, s.W - 1), clamped(std::ceil(v) + reach, s.H - 1)};
}

extern "C" void tiled(const Splats *s, Drawn *out) {
    std::vector<Box> boxes(s->count);
    for (int64_t i = 0; i < s->count; ++i) boxes[i] = box_of(*s, i);
    const Lists lists = make_lists(*s, [&](int64_t i, auto visit) {
        const Box &b = boxes[i];
        if (b.x0 > b.x1 || b.y0 > b.y1) return;
        for (int row = b.y0 / TILE; row <= b.y1 / TILE; ++row) visit(row, b.x0 / TILE, b.x1 / TILE);
    });
    out->pairs = int64_t(lists.splat.size());
    for (int64_t index = 0; index < int64_t(lists.begin.size()) - 1; ++index) {
        Tile tile(*s, index % lists.across, index / lists.across);
        for (int64_t k = lists.begin[index]; k < lists.begin[index + 1] && tile.live; ++k) {
            const int64_t i = lists.splat[k];
            const float *q = s->conics + 3 * i;
            const Box &b = boxes[i];
            const int x0 = std::max(b.x0 - tile.x0, 0), x1 = std::min(b.x1 - tile.x0, TILE - 1);
            const int y0 = std::max(b.y0 - tile.y0, 0), y1 = std::min(b.y1 - tile.y0, TILE - 1);
            for (int y = y0; y <= y1; ++y)
                for (int x = x0; x <= x1; ++x) {
                    const float dx = tile.x0 + x - s->means2d[2 * i], dy = tile.y0 + y - s->means2d[2 * i + 1];
                    const float power = -0.5f * (q[0] * dx * dx + q[2] * dy * dy) - q[1] * dx * dy;
                    const float alpha = std::fmin(CEILING, s->opacities[i] * std::exp(power));
                    if (alpha < FLOOR) continue;
                    tile.blend(y, x, alpha, s->colors + 3 * i);
                    ++out->mattered;
                }
            out->evaluated += int64_t(x1 - x0 + 1) * (y1 - y0 + 1);
        }
        tile.write(*s, out);
    }
}
