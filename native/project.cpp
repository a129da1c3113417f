// project: Gaussians to ellipses on the screen, one block of Gaussians at a time.
//
//     Sigma2d = J W Sigma W' J' + 0.3 I,   u = fx x/z + cx,   alpha = o exp(-d' Sigma2d^-1 d / 2)
//
// Half extents of alpha >= 1/255: sqrt(2 ln(255 o) Sigma_xx), sqrt(2 ln(255 o) Sigma_yy).
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

template <class T>
void project(const ProjectArgs<T> &args, int64_t block) {
    const int64_t begin = block * BLOCK, end = vmin(begin + BLOCK, args.scene.n);
    uint32_t *visible = args.visible + begin;
    uint32_t count = 0;
    const T LOG2E = T(1.4426950408889634);
    for (int64_t i = begin; i < end; ++i) {
        Projected<T> g;
        if (!project_shape(args.scene, args.camera, args.settings, i, g)) continue;
        Splat<T> s;
        s.u = T(args.camera.fx) * g.p[0] / g.p[2] + T(args.camera.cx);
        s.v = T(args.camera.fy) * g.p[1] / g.p[2] + T(args.camera.cy);
        const T opacity = g.opacity * g.compensation;
        const T level = 2 * log_(opacity / T(ALPHA_MIN));
        s.extent[0] = sqrt_(level * g.a), s.extent[1] = sqrt_(level * g.c);
        const bool inside = ceil_(s.u - s.extent[0]) <= T(args.camera.W - 1) && floor_(s.u + s.extent[0]) >= 0 &&
                            ceil_(s.v - s.extent[1]) <= T(args.camera.H - 1) && floor_(s.v + s.extent[1]) >= 0;
        if (!inside || !project_color(args.scene, args.settings, i, g)) continue;
        s.a = -g.c / g.det * (LOG2E / 2), s.b = g.b / g.det * LOG2E, s.c = -g.a / g.det * (LOG2E / 2);
        s.log2_o = log_(opacity) * LOG2E;
        for (int k = 0; k < 3; ++k) s.color[k] = args.scene.quats ? vmax(g.color[k], T(0)) : g.color[k];
        s.depth = g.p[2];
        args.splats[i] = s;
        visible[count++] = uint32_t(i);
    }
    args.block_visible[block] = count;
}

template void project<float>(const ProjectArgs<float> &, int64_t);
template void project<double>(const ProjectArgs<double> &, int64_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat
