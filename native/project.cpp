// project: project Gaussians to ellipses on the screen, one block at a time.
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
        const Position<T> at = position<T>(g, args.camera);
        s.u = T(at.u), s.v = T(at.v), s.x = at.x, s.y = at.y;
        s.log2_o = log_(T(g.opacity * g.compensation)) * T(LOG2E);
        const T level = vmax((s.log2_o - T(LOG2_ALPHA_MIN)) * T(2 / LOG2E), T(0));
        s.extent[0] = sqrt_(level * T(g.a)), s.extent[1] = sqrt_(level * T(g.c));
        const T rim_x = s.extent[0] + rim_slack(abs_(s.u) + s.extent[0]), rim_y = s.extent[1] + rim_slack(abs_(s.v) + s.extent[1]);
        const bool inside = ceil_(s.u - rim_x) <= T(args.camera.W - 1) && floor_(s.u + rim_x) >= 0 &&
                            ceil_(s.v - rim_y) <= T(args.camera.H - 1) && floor_(s.v + rim_y) >= 0;
        if (!inside || !project_color(args.scene, args.settings, i, g, shade)) continue;
        // d' Sigma2d^-1 d = (c / det) (dx - b/c dy)² + dy² / c
        const double inverse_c = 1 / g.c;
        const double sx = sqrt_(LOG2E / 2 * g.c * g.inverse_det), sy = -g.b * inverse_c * sx, ty = sqrt_(LOG2E / 2 * inverse_c);
        s.sx = T(sx), s.sy = T(sy), s.ty = T(ty);
        const double dx = double(at.x) - at.u, dy = double(at.y) - at.v;
        s.s0 = T(sx * dx + sy * dy), s.t0 = T(ty * dy);
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
