// What every rung is given, as splats.py has it: N splats near to far, and a screen.
#pragma once

#include <cmath>
#include <cstdint>

#include "constants.h"

struct Splats {
    const float *means2d, *conics, *colors, *opacities;  // (N, 2) px, (N, 3) px^-2, (N, 3), (N,)
    int64_t count;
    int32_t H, W;
};

// What a rung gives back: image (H, W, 3), transmittance (H, W), and what it did.
struct Drawn {
    float *image, *transmittance;
    int64_t pairs = 0;      // entries in the lists of the tiles
    int64_t evaluated = 0;  // a pixel worked out the alpha of a splat
    int64_t mattered = 0;   // and it was not below the floor
};

constexpr float FLOOR = gsplat::ALPHA_MIN, CEILING = gsplat::ALPHA_MAX, DARK = gsplat::T_STOP;
constexpr int TILE = gsplat::TILE;
