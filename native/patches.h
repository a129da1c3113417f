// How well patches of a photo agree with a neighbouring photo, seen through the rendered surface; patches.cpp has the formulas.
#pragma once

#include <cstdint>

#include "kernels.h"

namespace gsplat {

constexpr int MOST_RADIUS = 7;                         // of a patch, px

// A photo of one channel, and which of its pixels count; null if all do.
struct Grey {
    const uint8_t *pixels, *counts;                    // H W
    int32_t H, W;
    double fx, fy, cx, cy;
};

template <class T>
struct PatchArgs {
    const T *normals, *depth, *alpha;                  // H W 3 in world axes; H W: sum w z; H W
    Grey photo, other;
    RayImage<T> lens;                                  // if one of the cameras is no pinhole
    const Camera *other_camera;                        // then, too
    double R[9];                                       // world to camera, row by row; through lenses, the unit matrix
    double turn[9], shift[3];                          // from this camera's axes to the other's: turn x + shift; through lenses, both
                               // are the world's, and the other's centre is the origin
    int32_t radius, stride, first_u, first_v;  // px; centres are (first + k stride)
    double scale;  // factor of the loss of a patch
    double most;  // largest loss of a patch that still learns
    double least_alpha, least_cosine, least_spread;  // opacity; |cos| of ray and normal; standard deviation of 255 levels
    T *grad_normals, *grad_depth, *grad_alpha;  // as their primals; rows without a patch stay as they are
    double *sums;  // of each row of patches: the loss, and the number of patches that learn

    int32_t rows() const { return first_v < photo.H ? (photo.H - 1 - first_v) / stride + 1 : 0; }
};

// The patches of one row.
template <class T>
void patch_row(const PatchArgs<T> &args, int64_t row);

}  // namespace gsplat
