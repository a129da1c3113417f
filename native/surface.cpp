// surface: how far rendered normals are from the normals of the rendered depth, and the gradient; and normals of Gaussians.
//
// With the composited normals N = sum w n of a pixel, its mean depth z = D / a (D = sum w z_i, alpha a) and its ray r of depth 1:
//
//     P = z r,   m = ty x tx,   tx = P(u + 1) - P(u - 1),   ty = P(v + 1) - P(v - 1)
//     loss = sum a (a - N . m / |m|),   where the factors a are constants
//
// Back, with g = -a N and the unit normal e = m / |m|:
//
//     dN = -a e,   dm = (g - e (e . g)) / |m|,   dtx = dm x ty,   dty = tx x dm
//     dz = r . (dtx(u - 1) - dtx(u + 1) + dty(v - 1) - dty(v + 1)),   dD = dz / a,   da = -dz z / a
//
// A pixel takes part if its four neighbours have a depth, and these differ by less than `jump` of the nearest. Through a lens, P = o + z r
// with the centre o when the pixel is read, and a pixel without a ray has no depth. The first and
// the last column of a panorama are neighbours.
// Three passes over rows, each into planes of its own: depths, tangents' gradients, sums at each pixel.
#include "isa.h"
#include "simd.h"

namespace gsplat {
namespace GSPLAT_ISA {

// The world ray of column u in a row whose part that does not depend on u is `base`: base + (u - cx) / fx right.
template <class T>
struct RowRay {
    T base[3], right[3], cx, inverse;
    GSPLAT_METHOD RowRay(const SurfaceArgs<T> &args, int64_t row) : cx(T(args.cx)), inverse(T(1 / args.fx)) {
        const double y = (double(row) - args.cy) / args.fy;
        for (int k = 0; k < 3; ++k) base[k] = T(y * args.R[3 + k] + args.R[6 + k]), right[k] = T(args.R[k]);
    }
    GSPLAT_METHOD void at(int64_t u, T *r) const {
        const T x = (T(u) - cx) * inverse;
        for (int k = 0; k < 3; ++k) r[k] = base[k] + x * right[k];
    }
    // Adds the way from the centre of one pixel to that of another; a pinhole has one centre.
    GSPLAT_METHOD static void between(const RowRay &, int64_t, const RowRay &, int64_t, T *) {}
};

// The same through a lens or a rolling shutter.
template <class T>
struct RowLensRay {
    const SurfaceArgs<T> &args;
    int64_t row;
    GSPLAT_METHOD RowLensRay(const SurfaceArgs<T> &given, int64_t which) : args(given), row(which) {}
    GSPLAT_METHOD void at(int64_t u, T *r) const {
        const T *own = args.lens.rays + 3 * (row * args.W + u);
        const double *frame = args.lens.frame(row, u);
        for (int k = 0; k < 3; ++k) r[k] = T(frame[3 * k]) * own[0] + T(frame[3 * k + 1]) * own[1] + T(frame[3 * k + 2]) * own[2];
    }
    GSPLAT_METHOD static void between(const RowLensRay &from, int64_t u, const RowLensRay &to, int64_t v, T *tangent) {
        const double *first = from.args.lens.frame(from.row, u) + 9, *last = to.args.lens.frame(to.row, v) + 9;
        for (int k = 0; k < 3; ++k) tangent[k] += T(last[k] - first[k]);
    }
};

template <class T>
void surface_depths(const SurfaceArgs<T> &args, int64_t row) {
    const T *alphas = args.alpha + row * args.W, *sums = args.depth + row * args.W;
    T *depths = args.depths + row * args.W;
    for (int64_t u = 0; u < args.W; ++u) depths[u] = alphas[u] > 0 ? sums[u] / alphas[u] : T(0);
    if (!args.lens.rays) return;
    const T *rays = args.lens.rays + 3 * row * args.W;
    for (int64_t u = 0; u < args.W; ++u, rays += 3)
        if (rays[0] == 0 && rays[1] == 0 && rays[2] == 0) depths[u] = 0;
}

template <class T, class Ray>
GSPLAT_INLINE void tangents_of(const SurfaceArgs<T> &args, int64_t row) {
    const int64_t W = args.W;
    T *out = args.tangents + 6 * row * W;
    memset(out, 0, size_t(6 * W) * sizeof(T));
    memset(args.grad_normals + 3 * row * W, 0, size_t(3 * W) * sizeof(T));
    args.sums[row] = 0;
    if (row == 0 || row + 1 == args.H) return;
    const Ray ray(args, row), above(args, row - 1), below(args, row + 1);
    const T *z = args.depths + row * W, *up = z - W, *down = z + W;
    const T *normals = args.normals + 3 * row * W, *alphas = args.alpha + row * W;
    T *grads = args.grad_normals + 3 * row * W;
    const T jump = T(1 + args.jump), scale = T(args.scale);
    double total = 0;
    const bool wraps = args.lens.wraps;
    for (int64_t u = wraps ? 0 : 1; u + (wraps ? 0 : 1) < W; ++u) {
        const int64_t prior = wraps && u == 0 ? W - 1 : u - 1, next = wraps && u + 1 == W ? 0 : u + 1;
        const T left = z[prior], right = z[next], high = up[u], low = down[u];
        const T least = vmin(vmin(left, right), vmin(high, low)), most = vmax(vmax(left, right), vmax(high, low));
        if (!(least > 0 && most < jump * least)) continue;
        T tx[3], ty[3], m[3], before[3], after[3], over[3], under[3];
        ray.at(prior, before), ray.at(next, after), above.at(u, over), below.at(u, under);
        for (int k = 0; k < 3; ++k) {
            tx[k] = right * after[k] - left * before[k];
            ty[k] = low * under[k] - high * over[k];
        }
        Ray::between(ray, prior, ray, next, tx), Ray::between(above, u, below, u, ty);
        m[0] = ty[1] * tx[2] - ty[2] * tx[1], m[1] = ty[2] * tx[0] - ty[0] * tx[2], m[2] = ty[0] * tx[1] - ty[1] * tx[0];
        const T squared = m[0] * m[0] + m[1] * m[1] + m[2] * m[2];
        if (!(squared > 0)) continue;
        const T inverse = 1 / T(sqrt(squared)), a = alphas[u];
        T e[3], g[3], along = 0;
        for (int k = 0; k < 3; ++k) {
            e[k] = m[k] * inverse, g[k] = -scale * a * normals[3 * u + k], along += e[k] * g[k];
            grads[3 * u + k] = -scale * a * e[k];
        }
        total += double(scale * a * a + along);
        for (int k = 0; k < 3; ++k) g[k] = (g[k] - e[k] * along) * inverse;
        T *of_tx = out + 6 * u, *of_ty = of_tx + 3;
        of_tx[0] = g[1] * ty[2] - g[2] * ty[1], of_tx[1] = g[2] * ty[0] - g[0] * ty[2], of_tx[2] = g[0] * ty[1] - g[1] * ty[0];
        of_ty[0] = tx[1] * g[2] - tx[2] * g[1], of_ty[1] = tx[2] * g[0] - tx[0] * g[2], of_ty[2] = tx[0] * g[1] - tx[1] * g[0];
    }
    args.sums[row] = total;
}

template <class T>
void surface_tangents(const SurfaceArgs<T> &args, int64_t row) {
    args.lens.rays ? tangents_of<T, RowLensRay<T>>(args, row) : tangents_of<T, RowRay<T>>(args, row);
}

template <class T, class Ray>
GSPLAT_INLINE void gradient_of(const SurfaceArgs<T> &args, int64_t row) {
    const Ray ray(args, row);
    const int64_t W = args.W, H = args.H;
    const T *z = args.depths + row * W, *tangents = args.tangents + 6 * row * W, *alphas = args.alpha + row * W;
    T *of_depth = args.grad_depth + row * W, *of_alpha = args.grad_alpha + row * W;
    const bool wraps = args.lens.wraps;
    for (int64_t u = 0; u < W; ++u) {
        const int64_t prior = wraps && u == 0 ? W - 1 : u - 1, next = wraps && u + 1 == W ? 0 : u + 1;
        T dz = 0, r[3];
        ray.at(u, r);
        for (int k = 0; k < 3; ++k) {
            T of_point = 0;
            if (prior >= 0) of_point += tangents[6 * prior + k];
            if (next < W) of_point -= tangents[6 * next + k];
            if (row > 0) of_point += tangents[6 * (u - W) + 3 + k];
            if (row + 1 < H) of_point -= tangents[6 * (u + W) + 3 + k];
            dz += of_point * r[k];
        }
        of_depth[u] = alphas[u] > 0 ? dz / alphas[u] : T(0);
        of_alpha[u] = -of_depth[u] * z[u];
    }
}

template <class T>
void surface_gradient(const SurfaceArgs<T> &args, int64_t row) {
    args.lens.rays ? gradient_of<T, RowLensRay<T>>(args, row) : gradient_of<T, RowRay<T>>(args, row);
}

// The axis k of a rotation by the unit quaternion (w, x, y, z): the column k of its matrix.
template <class T>
GSPLAT_INLINE void axis_of(int k, const T *q, T *n) {
    const T w = q[0], x = q[1], y = q[2], z = q[3];
    if (k == 0) n[0] = 1 - 2 * (y * y + z * z), n[1] = 2 * (x * y + w * z), n[2] = 2 * (x * z - w * y);
    if (k == 1) n[0] = 2 * (x * y - w * z), n[1] = 1 - 2 * (x * x + z * z), n[2] = 2 * (y * z + w * x);
    if (k == 2) n[0] = 2 * (x * z + w * y), n[1] = 2 * (y * z - w * x), n[2] = 1 - 2 * (x * x + y * y);
}

// The gradient of the unit quaternion for the gradient g of that column.
template <class T>
GSPLAT_INLINE void axis_backward(int k, const T *q, const T *g, T *out) {
    const T w = q[0], x = q[1], y = q[2], z = q[3];
    if (k == 0) {
        out[0] = 2 * (z * g[1] - y * g[2]), out[1] = 2 * (y * g[1] + z * g[2]);
        out[2] = 2 * (x * g[1] - w * g[2]) - 4 * y * g[0], out[3] = 2 * (w * g[1] + x * g[2]) - 4 * z * g[0];
    } else if (k == 1) {
        out[0] = 2 * (x * g[2] - z * g[0]), out[1] = 2 * (y * g[0] + w * g[2]) - 4 * x * g[1];
        out[2] = 2 * (x * g[0] + z * g[2]), out[3] = 2 * (y * g[2] - w * g[0]) - 4 * z * g[1];
    } else {
        out[0] = 2 * (y * g[0] - x * g[1]), out[1] = 2 * (z * g[0] - w * g[1]) - 4 * x * g[2];
        out[2] = 2 * (w * g[0] + z * g[1]) - 4 * y * g[2], out[3] = 2 * (x * g[0] + y * g[1]);
    }
}

// A Gaussian's shortest axis, turned towards the eye; zero where the rotation is undefined.
template <class T>
struct NormalOf {
    T q[4], inverse, n[3], sign;
    int axis;
    bool held;
    GSPLAT_METHOD NormalOf(const NormalArgs<T> &args, int64_t i) {
        const T *raw = args.quats + 4 * i, *scales = args.log_scales + 3 * i;
        axis = scales[1] < scales[0] ? 1 : 0;
        if (scales[2] < scales[axis]) axis = 2;
        T largest = 0, squared = 0;  // scaled first: squares of huge or tiny numbers leave the range
        for (int k = 0; k < 4; ++k) largest = vmax(largest, T(fabs(raw[k])));
        for (int k = 0; k < 4; ++k) q[k] = raw[k] / largest, squared += q[k] * q[k];
        const T length = T(sqrt(squared));
        for (int k = 0; k < 4; ++k) q[k] /= length;
        inverse = 1 / (largest * length);
        axis_of(axis, q, n);
        T away = 0;
        for (int k = 0; k < 3; ++k) away += n[k] * (args.means[3 * i + k] - T(args.eye[k]));
        sign = away > 0 ? T(-1) : T(1);
        const T all = n[0] + n[1] + n[2];
        held = all - all == 0;  // neither NaN nor infinite
        for (int k = 0; k < 3; ++k) n[k] = held ? sign * n[k] : T(0);
    }
};

template <class T>
void normals(const NormalArgs<T> &args, int64_t block) {
    const int64_t end = vmin(args.n, (block + 1) * BLOCK);
    for (int64_t i = block * BLOCK; i < end; ++i) {
        const NormalOf<T> normal(args, i);
        for (int k = 0; k < 3; ++k) args.out[3 * i + k] = normal.n[k];
    }
}

template <class T>
void normals_backward(const NormalArgs<T> &args, int64_t block) {
    const int64_t end = vmin(args.n, (block + 1) * BLOCK);
    for (int64_t i = block * BLOCK; i < end; ++i) {
        const NormalOf<T> normal(args, i);
        T g[3], of_unit[4] = {}, along = 0;
        for (int k = 0; k < 3; ++k) g[k] = normal.sign * args.grad[3 * i + k];
        if (normal.held) axis_backward(normal.axis, normal.q, g, of_unit);
        for (int k = 0; k < 4; ++k) along += normal.q[k] * of_unit[k];
        for (int k = 0; k < 4; ++k) args.grad_quats[4 * i + k] = normal.held ? (of_unit[k] - normal.q[k] * along) * normal.inverse : T(0);
    }
}

template void normals<float>(const NormalArgs<float> &, int64_t);
template void normals<double>(const NormalArgs<double> &, int64_t);
template void normals_backward<float>(const NormalArgs<float> &, int64_t);
template void normals_backward<double>(const NormalArgs<double> &, int64_t);
template void surface_depths<float>(const SurfaceArgs<float> &, int64_t);
template void surface_depths<double>(const SurfaceArgs<double> &, int64_t);
template void surface_tangents<float>(const SurfaceArgs<float> &, int64_t);
template void surface_tangents<double>(const SurfaceArgs<double> &, int64_t);
template void surface_gradient<float>(const SurfaceArgs<float> &, int64_t);
template void surface_gradient<double>(const SurfaceArgs<double> &, int64_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat
