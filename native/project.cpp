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
    constexpr double LOG2E = 1.4426950408889634;
    for (int64_t i = begin; i < end; ++i) {
        Projected g;
        if (!project_shape(args.scene, args.camera, args.settings, i, g)) continue;
        Shade<T> shade;
        Splat<T> s;
        const double u = screen_x(g, args.camera), v = screen_y(g, args.camera);
        const double log2_o = log_(g.opacity * g.compensation) * LOG2E;
        const double level = vmax((log2_o - LOG2_ALPHA_MIN) * (2 / LOG2E), 0.0);
        const double ex = sqrt_(level * g.a), ey = sqrt_(level * g.c);
        const bool inside = ceil_(u - ex) <= args.camera.W - 1 && floor_(u + ex) >= 0 &&
                            ceil_(v - ey) <= args.camera.H - 1 && floor_(v + ey) >= 0;
        if (!inside || !project_color(args.scene, args.settings, i, g, shade)) continue;
        // d' Sigma2d^-1 d = (c / det) (dx - b/c dy)² + dy² / c
        const double sx = sqrt_(LOG2E / 2 * g.c / g.det), sy = -g.b / g.c * sx, ty = sqrt_(LOG2E / 2 / g.c);
        s.u = u, s.v = v, s.extent[0] = T(ex), s.extent[1] = T(ey);
        s.sx = T(sx), s.sy = T(sy), s.ty = T(ty);
        const double dx = double(reference_x(s, args.camera)) - u, dy = double(reference_y(s, args.camera)) - v;
        s.s0 = T(sx * dx + sy * dy), s.t0 = T(ty * dy);
        s.log2_o = T(log2_o);
        for (int k = 0; k < 3; ++k) s.color[k] = args.scene.quats ? vmax(shade.color[k], T(0)) : shade.color[k];
        s.depth = T(g.p[2]);
        args.splats[i] = s;
        visible[count++] = uint32_t(i);
    }
    args.block_visible[block] = count;
}

template void project<float>(const ProjectArgs<float> &, int64_t);
template void project<double>(const ProjectArgs<double> &, int64_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat
