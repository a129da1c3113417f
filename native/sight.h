// Where a camera with any projection, at rest or with a rolling shutter, sees Gaussians; sight.cpp has the formulas.
#pragma once

#include "kernels.h"
#include "lanes.h"

namespace gsplat {
namespace GSPLAT_ISA {

GSPLAT_INLINE void rotated(const double *R, const VD *v, VD *out) {
    for (int k = 0; k < 3; ++k) out[k] = splat(R[3 * k]) * v[0] + splat(R[3 * k + 1]) * v[1] + splat(R[3 * k + 2]) * v[2];
}

// Sets `time` to tau - 1/2 at which a rolling shutter sees WIDE points, from their places in camera axes at half time.
void time_of(const Camera &cam, const VD *at_rest, VD &time);

// What `sight` finds of WIDE points.
struct Sight {
    VD p[3], u, v, depth;  // place in camera axes when it is seen; image position, px
    VD t0[3], t1[3];       // rows of J W
    VD blur[2];            // b / sqrt(12), px; set if the camera has an exposure
    MD valid;
};

// Sees points at `offset` = x - eye, world axes; `time` is 0 for a camera at rest.
void sight(const Camera &cam, const VD *offset, const VD &time, double z_near, Sight &out);

// Cotangents of a `Sight` (`blur` is read only if the camera has an exposure), and of the viewing direction x - eye - V t (of an
// orthographic camera: R's last row).
struct SightGradient {
    VD d0[3], d1[3], at[2], depth, direction[3], blur[2];
};

// The adjoint of `sight` in the mean, `dmean`, world axes; and, if not null, in the LENS_CAMERA numbers of the camera, which are
// overwritten.
void sight_adjoint(const Camera &cam, const VD *offset, const VD &time, const SightGradient &in, VD *dmean, VD *camera);

}  // namespace GSPLAT_ISA
}  // namespace gsplat
