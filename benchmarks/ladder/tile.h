// One tile while it is drawn: sixteen rows of pixels that stay in the nearest cache.
#pragma once

#include <cstring>

#include "splats.h"

struct Tile {
    alignas(64) float T[TILE][TILE], red[TILE][TILE], green[TILE][TILE], blue[TILE][TILE];
    int x0, y0, width, height;  // pixels of the image
    int live;                   // of them, those that still let light through

    Tile(const Splats &s, int column, int row) {
        std::memset(this, 0, sizeof *this);  // outside the image T is 0 and keeps no tile alive
        x0 = column * TILE, y0 = row * TILE;
        width = s.W - x0 < TILE ? s.W - x0 : TILE, height = s.H - y0 < TILE ? s.H - y0 : TILE;
        live = width * height;
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x) T[y][x] = 1;
    }

    void blend(int y, int x, float alpha, const float *color) {
        const float w = T[y][x] * alpha;
        red[y][x] += w * color[0], green[y][x] += w * color[1], blue[y][x] += w * color[2];
        live -= T[y][x] >= DARK && T[y][x] - w < DARK;
        T[y][x] -= w;
    }

    void write(const Splats &s, Drawn *out) const {
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x) {
                const int64_t pixel = int64_t(y0 + y) * s.W + x0 + x;
                float *rgb = out->image + 3 * pixel;
                rgb[0] = red[y][x], rgb[1] = green[y][x], rgb[2] = blue[y][x], out->transmittance[pixel] = T[y][x];
            }
    }
};
