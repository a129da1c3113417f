// project: project Gaussians to ellipses on the screen, one block at a time.
//
//     Sigma2d = J W Sigma W' J' + d I, d: dilation,   u = fx x/z + cx,   alpha = o exp(-d' Sigma2d^-1 d / 2)
//
// Half extents of alpha >= 1/255: sqrt(2 ln(255 o) Sigma_xx), sqrt(2 ln(255 o) Sigma_yy).
//
// Lanes are Gaussians. Those behind the camera are left out first, those outside the image before their colour.
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

constexpr double LOG2E = 1.4426950408889634;

// Splats of a chunk, an array for each number.
template <class T>
struct Records {
    alignas(64) T u[CHUNK], v[CHUNK], x[CHUNK], y[CHUNK], sx[CHUNK], sy[CHUNK], ty[CHUNK], s0[CHUNK], t0[CHUNK];
    T log2_o[CHUNK], depth[CHUNK], extent[2][CHUNK];
    T opacity[CHUNK], a[CHUNK], c[CHUNK];        // with compensation, 0 where the Gaussian is not drawn; variances
    typename Vector<T>::M drawn[CHUNK / Vector<T>::LANES];
};

// Lists the Gaussians in [begin, end) before the camera; returns their number.
template <class T>
GSPLAT_INLINE int list_before(const ProjectArgs<T> &args, int64_t begin, int64_t end, uint32_t *ids) {
    const Camera &cam = args.camera;
    const double *R = cam.R + 6;
    int count = 0;
    if (cam.along_ray || cam.moving) {  // decided where they are seen
        for (int64_t i = begin; i < end; ++i) ids[count++] = uint32_t(i);
        return count;
    }
    for (int64_t i = begin; i < end; ++i) {
        const T *mean = args.scene.means + 3 * i;
        const double z =
            R[0] * (double(mean[0]) - cam.eye[0]) + R[1] * (double(mean[1]) - cam.eye[1]) + R[2] * (double(mean[2]) - cam.eye[2]);
        ids[count] = uint32_t(i);
        count += z > args.settings.z_near;
    }
    return count;
}

// The ellipses of WIDE Gaussians.
template <class T>
GSPLAT_INLINE void ellipses(const ProjectArgs<T> &args, const Chunk<T> &in, int l, Records<T> &out) {
    Projected g;
    project_shape(in, l, args.scene.quats != nullptr, args.camera, args.settings, g);
    const Position at = position<T>(g, args.camera);
    // d' Sigma2d^-1 d = (c / det) (dx - b/c dy)² + dy² / c
    const VD half = splat(LOG2E / 2), sx = sqrt_(half * g.c * g.inverse_det), ty = sqrt_(half * g.inverse_c), sy = -g.b * g.inverse_c * sx;
    const VD dx = at.x - at.u, dy = at.y - at.v;
    narrowed(out.u + l, at.u), narrowed(out.v + l, at.v), narrowed(out.x + l, at.x), narrowed(out.y + l, at.y);
    narrowed(out.sx + l, sx), narrowed(out.sy + l, sy), narrowed(out.ty + l, ty);
    narrowed(out.s0 + l, sx * dx + sy * dy), narrowed(out.t0 + l, ty * dy);
    narrowed(out.depth + l, g.depth), narrowed(out.a + l, g.a), narrowed(out.c + l, g.c);
    narrowed(out.opacity + l, g.valid ? g.opacity * g.compensation : VD{});
}

// Extents of the ellipses, and which of them meet the image.
template <class T>
GSPLAT_INLINE void extents(const Camera &cam, int padded, Records<T> &out) {
    using V = typename Vector<T>::V;
    const V zero = V{}, right = splat(T(cam.W - 1)), bottom = splat(T(cam.H - 1));
    for (int l = 0; l < padded; l += Vector<T>::LANES) {
        const V u = load<V>(out.u + l), v = load<V>(out.v + l), opacity = load<V>(out.opacity + l), log2_o = log2_(opacity);
        const V level = vmax((log2_o - splat(T(LOG2_ALPHA_MIN))) * splat(T(2 / LOG2E)), zero);
        const V ex = sqrt_(level * load<V>(out.a + l)), ey = sqrt_(level * load<V>(out.c + l));
        const V rim_x = ex + rim_slack(abs_(u) + ex), rim_y = ey + rim_slack(abs_(v) + ey);
        store(out.log2_o + l, log2_o), store(out.extent[0] + l, ex), store(out.extent[1] + l, ey);
        out.drawn[l / Vector<T>::LANES] =
            (u - rim_x <= right) & (u + rim_x >= zero) & (v - rim_y <= bottom) & (v + rim_y >= zero) & (opacity > zero);
    }
}

template <class T>
GSPLAT_INLINE void write(const Records<T> &in, int l, const T *color, Splat<T> &s) {
    s.u = in.u[l], s.v = in.v[l], s.x = in.x[l], s.y = in.y[l];
    s.sx = in.sx[l], s.sy = in.sy[l], s.ty = in.ty[l], s.s0 = in.s0[l], s.t0 = in.t0[l];
    s.log2_o = in.log2_o[l], s.depth = in.depth[l];
    s.extent[0] = in.extent[0][l], s.extent[1] = in.extent[1][l];
    for (int k = 0; k < 3; ++k) s.color[k] = color[k];
}

// Writes the splats of the chunk that meet the image and have a colour; returns their number.
template <class T, class F>
GSPLAT_INLINE uint32_t finish(const ProjectArgs<T> &args, const uint32_t *ids, int count, const Records<T> &records, uint32_t *visible,
                              F color_in_lane) {
    uint32_t found = 0;
    for (int l = 0; l < count; ++l) {
        if (!records.drawn[l / Vector<T>::LANES][l % Vector<T>::LANES]) continue;
        T color[4];
        store(color, color_in_lane(l, ids[l]));
        if (!is_color(color)) continue;
        if (args.scene.quats)
            for (int k = 0; k < 3; ++k) color[k] = vmax(color[k], T(0));
        write(records, l, color, args.splats[ids[l]]);
        visible[found++] = ids[l];
    }
    return found;
}

// Projects the chunk and lists the visible ones; returns their number.
template <class T>
uint32_t project_chunk(const ProjectArgs<T> &args, const uint32_t *ids, int count, uint32_t *visible) {
    const Scene<T> &scene = args.scene;
    Chunk<T> in;
    Records<T> records;
    gather(scene, ids, count, in);
    read_times(args.camera, in);
    for (int l = 0; l < in.padded; l += WIDE) {
        for (int k = l; k < vmin(l + WIDE, count); ++k) {
            fetch<0>(scene.sh_rest + 3 * int64_t(scene.rest) * ids[k], 3 * scene.rest);
            fetch<1>(&args.splats[ids[k]].u, sizeof(Splat<T>) / sizeof(T));
        }
        ellipses(args, in, l, records);
    }
    extents(args.camera, in.padded, records);
    if (!scene.quats) return finish(args, ids, count, records, visible, [&](int, int64_t i) { return channels(scene.colors + 3 * i); });
    Shade<T> shades;
    shade(in, args.camera, args.settings.sh_degree, shades);
    uint32_t found = 0;
    with_degree(args.settings.sh_degree, [&]<int DEGREE>() {
        found = finish(args, ids, count, records, visible, [&](int l, int64_t i) { return color_of<DEGREE>(scene, shades, l, i); });
    });
    return found;
}

template <class T>
void project(const ProjectArgs<T> &args, int64_t block) {
    const int64_t begin = block * BLOCK, end = vmin(begin + BLOCK, args.scene.n);
    uint32_t ids[BLOCK], found = 0;
    const int count = list_before(args, begin, end, ids);
    for (int first = 0; first < count; first += CHUNK)
        found += project_chunk(args, ids + first, vmin(CHUNK, count - first), args.visible + begin + found);
    args.block_visible[block] = found;
}

template void project<float>(const ProjectArgs<float> &, int64_t);
template void project<double>(const ProjectArgs<double> &, int64_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat
