// Tight extents: a tile reads the splats whose ellipse alpha >= 1/255 meets it, and a row of it only their columns.
#include "ellipse.h"
#include "tile.h"

extern "C" void tight(const Splats *s, Drawn *out) {
    std::vector<Ellipse> ellipses;
    ellipses.reserve(s->count);
    for (int64_t i = 0; i < s->count; ++i) ellipses.emplace_back(*s, i);
    const Lists lists = tight_lists(*s, ellipses);
    out->pairs = int64_t(lists.splat.size());
    for (int64_t index = 0; index < int64_t(lists.begin.size()) - 1; ++index) {
        Tile tile(*s, index % lists.across, index / lists.across);
        for (int64_t k = lists.begin[index]; k < lists.begin[index + 1] && tile.live; ++k) {
            const int64_t i = lists.splat[k];
            const Ellipse &e = ellipses[i];
            const int y0 = std::max(e.first_row(), tile.y0), y1 = std::min(e.last_row(s->H), tile.y0 + TILE - 1);
            for (int y = y0; y <= y1; ++y) {
                int x0, x1;
                e.columns(y, s->W, x0, x1);
                x0 = std::max(x0, tile.x0), x1 = std::min(x1, tile.x0 + TILE - 1);
                for (int x = x0; x <= x1; ++x) {
                    const float dx = x - e.u, dy = y - e.v;
                    const float power = -0.5f * (e.A * dx * dx + e.C * dy * dy) - e.B * dx * dy;
                    const float alpha = std::fmin(CEILING, s->opacities[i] * std::exp(power));
                    if (alpha < FLOOR) continue;  // within the hair of the rim
                    tile.blend(y - tile.y0, x - tile.x0, alpha, s->colors + 3 * i);
                    ++out->mattered;
                }
                out->evaluated += std::max(x1 - x0 + 1, 0);
            }
        }
        tile.write(*s, out);
    }
}
