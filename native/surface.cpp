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
// A pixel takes part if its four neighbours have a depth, and these differ by less than `jump` of the nearest.
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
    GSPLAT_METHOD T x(int64_t u) const { return (T(u) - cx) * inverse; }
};

template <class T>
void surface_depths(const SurfaceArgs<T> &args, int64_t row) {
    const T *alphas = args.alpha + row * args.W, *sums = args.depth + row * args.W;
    T *depths = args.depths + row * args.W;
    for (int64_t u = 0; u < args.W; ++u) depths[u] = alphas[u] > 0 ? sums[u] / alphas[u] : T(0);
}

template <class T>
void surface_tangents(const SurfaceArgs<T> &args, int64_t row) {
    const int64_t W = args.W;
    T *out = args.tangents + 6 * row * W;
    memset(out, 0, size_t(6 * W) * sizeof(T));
    memset(args.grad_normals + 3 * row * W, 0, size_t(3 * W) * sizeof(T));
    args.sums[row] = 0;
    if (row == 0 || row + 1 == args.H) return;
    const RowRay<T> ray(args, row), above(args, row - 1), below(args, row + 1);
    const T *z = args.depths + row * W, *up = z - W, *down = z + W;
    const T *normals = args.normals + 3 * row * W, *alphas = args.alpha + row * W;
    T *grads = args.grad_normals + 3 * row * W;
    const T jump = T(1 + args.jump), scale = T(args.scale);
    double total = 0;
    for (int64_t u = 1; u + 1 < W; ++u) {
        const T left = z[u - 1], right = z[u + 1], high = up[u], low = down[u];
        const T least = vmin(vmin(left, right), vmin(high, low)), most = vmax(vmax(left, right), vmax(high, low));
        if (!(least > 0 && most < jump * least)) continue;
        const T x = ray.x(u), before = ray.x(u - 1), after = ray.x(u + 1);
        T tx[3], ty[3], m[3];
        for (int k = 0; k < 3; ++k) {
            tx[k] = right * (ray.base[k] + after * ray.right[k]) - left * (ray.base[k] + before * ray.right[k]);
            ty[k] = low * (below.base[k] + x * ray.right[k]) - high * (above.base[k] + x * ray.right[k]);
        }
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
void surface_gradient(const SurfaceArgs<T> &args, int64_t row) {
    const RowRay<T> ray(args, row);
    const int64_t W = args.W, H = args.H;
    const T *z = args.depths + row * W, *tangents = args.tangents + 6 * row * W, *alphas = args.alpha + row * W;
    T *of_depth = args.grad_depth + row * W, *of_alpha = args.grad_alpha + row * W;
    for (int64_t u = 0; u < W; ++u) {
        const T x = ray.x(u);
        T dz = 0;
        for (int k = 0; k < 3; ++k) {
            T of_point = 0;
            if (u > 0) of_point += tangents[6 * (u - 1) + k];
            if (u + 1 < W) of_point -= tangents[6 * (u + 1) + k];
            if (row > 0) of_point += tangents[6 * (u - W) + 3 + k];
            if (row + 1 < H) of_point -= tangents[6 * (u + W) + 3 + k];
            dz += of_point * (ray.base[k] + x * ray.right[k]);
        }
        of_depth[u] = alphas[u] > 0 ? dz / alphas[u] : T(0);
        of_alpha[u] = -of_depth[u] * z[u];
    }
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
