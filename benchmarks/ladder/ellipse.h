// Where a splat is at least 1/255: the ellipse A dx² + 2 B dx dy + C dy² <= L with L = 2 ln(255 o).
#pragma once

#include "lists.h"

struct Ellipse {
    float u, v, A, B, C;
    float level;   // L; negative where the splat is nowhere above the floor
    float height;  // half its extent along y, px
    float det;

    Ellipse(const Splats &s, int64_t i)
        : u(s.means2d[2 * i]), v(s.means2d[2 * i + 1]), A(s.conics[3 * i]), B(s.conics[3 * i + 1]), C(s.conics[3 * i + 2]) {
        level = 2 * std::log(s.opacities[i] / FLOOR);
        det = A * C - B * B;
        height = std::sqrt(std::fmax(level * A / det, 0.0f));
    }

    // Rows of pixels that it meets, a hair more: rounding must not lose one on the rim.
    int first_row() const { return clamped(std::ceil(std::fmax(v - height - SLACK, 0.0f)), 1 << 24); }
    int last_row(int H) const { return clamped(std::floor(v + height + SLACK), H - 1); }

    // Its columns in one row of pixels: the roots of a quadratic in dx.
    void columns(int y, int W, int &first, int &last) const {
        const float dy = y - v, half = std::sqrt(std::fmax(A * level - det * dy * dy, 0.0f)) / A, middle = u - B / A * dy;
        first = clamped(std::ceil(std::fmax(middle - half - SLACK, 0.0f)), W);
        last = clamped(std::floor(middle + half + SLACK), W - 1);
    }

    static constexpr float SLACK = gsplat::RIM_SLACK;
};

// Tiles that contain a pixel of each splat's ellipse.
inline Lists tight_lists(const Splats &s, const std::vector<Ellipse> &ellipses) {
    return make_lists(s, [&](int64_t i, auto visit) {
        const Ellipse &e = ellipses[i];
        if (!(e.level >= 0)) return;
        const int last_row = e.last_row(s.H);
        for (int y = e.first_row(); y <= last_row;) {
            const int row = y / TILE;
            int left = s.W, right = -1;
            for (; y <= last_row && y / TILE == row; ++y) {
                int first, last;
                e.columns(y, s.W, first, last);
                if (first <= last) left = std::min(left, first), right = std::max(right, last);
            }
            if (left <= right) visit(row, left / TILE, right / TILE);
        }
    });
}
