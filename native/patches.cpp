// patches: how well patches of a photo agree with a neighbouring photo, seen through the rendered surface, and the gradient.
//
// A pixel with the ray r of depth 1 lies on the plane through its mean depth z = D / a, with the unit normal n = N / |N|, both in the
// camera's axes. A pixel of the patch around it, with the ray r_i, sees the plane at the depth s_i, and the other camera sees
// that point at x_i:
//
//     s_i = z (n . r) / (n . r_i),   y_i = s_i turn r_i + shift,   x_i = (fx y_0 / y_2 + cx, fy y_1 / y_2 + cy)
//
// With the patch's own values a_i, and b_i the other photo's at x_i (bilinear), both less their means:
//
//     ncc = sum a_i b_i / (|a| |b|),   loss = min(1 - ncc, most)
//
// Back, for a loss below `most`:
//
//     db_i = -(a_i / |a| - ncc b_i / |b|) / |b|,   ds_i = db_i grad b(x_i) . dx_i/ds_i
//     dz = sum ds_i s_i / z,   dn = sum ds_i z (r / (n . r_i) - (n . r) r_i / (n . r_i)^2)
//     dN = (dn - n (n . dn)) / |N|,   dD = dz / a,   da = -z dz / a
//
// Through lenses, everything is in world axes. With the centres o and o_i when the pixels are read, and the plane's point P = o + z r:
//
//     s_i = n . (P - o_i) / (n . r_i),   y_i = o_i + s_i r_i - eye,   x_i = sight of y_i,   dn = sum ds_i (P - o_i - s_i r_i) / (n . r_i)
//
// The first and the last column of a panorama are neighbours: a patch has pixels on both sides, and x_i is found up to whole turns.
//
// Everything is computed in double, whatever the type of the images: the result does not depend on the instruction set.
#include "patches.h"

#include "sight.h"

#include <algorithm>
#include <cmath>
#include <cstring>

namespace gsplat {

namespace {

constexpr int MOST_PIXELS = (2 * MOST_RADIUS + 1) * (2 * MOST_RADIUS + 1);

double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// out = m v, or the transpose of m times v.
void multiply(const double *m, const double *v, double *out) {
    for (int k = 0; k < 3; ++k) out[k] = dot(m + 3 * k, v);
}
void multiply_transposed(const double *m, const double *v, double *out) {
    for (int k = 0; k < 3; ++k) out[k] = m[k] * v[0] + m[3 + k] * v[1] + m[6 + k] * v[2];
}

void ray_of(const Grey &photo, double u, double v, double *ray) {
    ray[0] = (u - photo.cx) / photo.fx, ray[1] = (v - photo.cy) / photo.fy, ray[2] = 1;
}

// Values less their mean; returns their length.
double centred(double *values, int count) {
    double mean = 0, squared = 0;
    for (int i = 0; i < count; ++i) mean += values[i];
    mean /= count;
    for (int i = 0; i < count; ++i) values[i] -= mean, squared += values[i] * values[i];
    return std::sqrt(squared);
}

// The value of a photo at a point by bilinear interpolation, and its derivatives; false if a pixel that is needed does not count.
bool sample(const Grey &photo, bool wraps, double x, double y, double *value, double *along_x, double *along_y) {
    if (wraps) {
        x -= photo.W * std::floor(x / photo.W);
        if (!(x < photo.W)) x = 0;  // rounded up
    }
    if (!(x >= 0 && y >= 0 && (wraps || x <= photo.W - 1) && y <= photo.H - 1)) return false;
    const int64_t u = wraps ? int64_t(x) : std::min(int64_t(x), int64_t(photo.W) - 2), v = std::min(int64_t(y), int64_t(photo.H) - 2);
    if (u < 0 || v < 0) return false;  // a photo of one row or column
    const int64_t at = v * photo.W + u, below = at + photo.W, aside = wraps && u + 1 == photo.W ? -u : 1;
    if (photo.counts && !(photo.counts[at] && photo.counts[at + aside] && photo.counts[below] && photo.counts[below + aside])) return false;
    const uint8_t *p = photo.pixels;
    const double right = x - double(u), down = y - double(v);
    const double upper = p[at] + right * (double(p[at + aside]) - p[at]), lower = p[below] + right * (double(p[below + aside]) - p[below]);
    *value = upper + down * (lower - upper), *along_y = lower - upper;
    *along_x = (1 - down) * (double(p[at + aside]) - p[at]) + down * (double(p[below + aside]) - p[below]);
    return true;
}

// The plane of a pixel, in the camera's axes; through lenses, in the world's.
struct Plane {
    double ray[3], n[3], length, z, facing;            // n . ray, negative
};

// The pixels of a patch: values here, and where the other photo sees them; its slope by s; rays, and n . ray. Through lenses, also the
// centre of the patch's pixel less that of each, o - o_i.
struct Pixels {
    int count = 0;
    double own[MOST_PIXELS], seen[MOST_PIXELS], slope[MOST_PIXELS], rays[MOST_PIXELS][3], facing[MOST_PIXELS], away[MOST_PIXELS][3];
};

template <class T>
void lens_ray(const PatchArgs<T> &args, int64_t u, int64_t v, double *ray) {
    const T *given = args.lens.rays + 3 * (v * args.photo.W + u);
    const double own[3] = {double(given[0]), double(given[1]), double(given[2])};
    multiply(args.lens.frame(v, u), own, ray);
}

template <class T>
bool plane_of(const PatchArgs<T> &args, int64_t u, int64_t v, Plane *plane) {
    const int64_t at = v * args.photo.W + u;
    const double alpha = args.alpha[at];
    if (!(alpha >= args.least_alpha)) return false;
    const double normal[3] = {double(args.normals[3 * at]), double(args.normals[3 * at + 1]), double(args.normals[3 * at + 2])};
    plane->length = std::sqrt(dot(normal, normal)), plane->z = args.depth[at] / alpha;
    if (!(plane->length > 0 && plane->z > 0)) return false;
    multiply(args.R, normal, plane->n);
    for (double &value : plane->n) value /= plane->length;
    if (args.lens.rays)
        lens_ray(args, u, v, plane->ray);
    else
        ray_of(args.photo, double(u), double(v), plane->ray);
    plane->facing = dot(plane->n, plane->ray);
    return true;
}

// Fills in the pixels around (u, v), all of which are in the photo; false if the other photo does not see all of them.
template <class T>
bool through_pinholes(const PatchArgs<T> &args, int64_t u, int64_t v, const Plane &plane, Pixels *found) {
    const int64_t r = args.radius, W = args.photo.W;
    int count = 0;
    for (int64_t j = v - r; j <= v + r; ++j)
        for (int64_t i = u - r; i <= u + r; ++i, ++count) {
            const int64_t at = j * W + i;
            if (args.photo.counts && !args.photo.counts[at]) return false;
            found->own[count] = args.photo.pixels[at];
            double *ray = found->rays[count], turned[3], point[3], along_x, along_y;
            ray_of(args.photo, double(i), double(j), ray);
            const double facing = found->facing[count] = dot(plane.n, ray);
            if (!(facing < -args.least_cosine * std::sqrt(dot(ray, ray)))) return false;
            const double s = plane.z * plane.facing / facing;
            multiply(args.turn, ray, turned);
            for (int k = 0; k < 3; ++k) point[k] = s * turned[k] + args.shift[k];
            if (!(point[2] > 0)) return false;
            const Grey &other = args.other;
            const double inverse = 1 / point[2], x = point[0] * inverse, y = point[1] * inverse;
            if (!sample(other, false, other.fx * x + other.cx, other.fy * y + other.cy, &found->seen[count], &along_x, &along_y))
                return false;
            found->slope[count] =
                (along_x * other.fx * (turned[0] - x * turned[2]) + along_y * other.fy * (turned[1] - y * turned[2])) * inverse;
        }
    found->count = count;
    return true;
}

using GSPLAT_ISA::VD;
using GSPLAT_ISA::WIDE;

// Where the other camera sees WIDE points, less its centre, and their images' slopes along rays; false if it does not see one of them.
bool see(const Grey &other, const Camera &camera, const double (*points)[3], const double (*rays)[3], double *seen, double *slope) {
    VD offset[3], time{}, at_rest[3];
    for (int k = 0; k < 3; ++k)
        for (int l = 0; l < WIDE; ++l) offset[k][l] = points[l][k];
    if (camera.moving) {
        GSPLAT_ISA::rotated(camera.R, offset, at_rest);
        GSPLAT_ISA::time_of(camera, at_rest, time);
    }
    GSPLAT_ISA::Sight sight;
    GSPLAT_ISA::sight(camera, offset, time, 0.0, sight);
    for (int l = 0; l < WIDE; ++l) {
        if (!sight.valid[l]) return false;
        if (camera.wraps()) {  // the longitude's slope is bounded at the poles
            const double x = sight.p[0][l], y = sight.p[1][l], z = sight.p[2][l], h2 = x * x + z * z;
            if (!(h2 > POLE * POLE * (h2 + y * y))) return false;
        }
        double along_x, along_y, by_u = 0, by_v = 0;
        if (!sample(other, camera.wraps(), sight.u[l], sight.v[l], &seen[l], &along_x, &along_y)) return false;
        for (int k = 0; k < 3; ++k) by_u += sight.t0[k][l] * rays[l][k], by_v += sight.t1[k][l] * rays[l][k];
        slope[l] = along_x * by_u + along_y * by_v;
    }
    return true;
}

// The same through lenses.
template <class T>
bool through_lenses(const PatchArgs<T> &args, int64_t u, int64_t v, const Plane &plane, Pixels *found) {
    const int64_t r = args.radius, W = args.photo.W;
    const double *eye = args.lens.frame(v, u) + 9;
    double points[MOST_PIXELS + WIDE][3];
    int count = 0;
    for (int64_t j = v - r; j <= v + r; ++j)
        for (int64_t k = u - r; k <= u + r; ++k, ++count) {
            const int64_t i = k < 0 ? k + W : k < W ? k : k - W, at = j * W + i;  // beyond the edge of a panorama is its other edge
            if (args.photo.counts && !args.photo.counts[at]) return false;
            found->own[count] = args.photo.pixels[at];
            double *ray = found->rays[count], *away = found->away[count];
            lens_ray(args, i, j, ray);
            const double *start = args.lens.frame(j, i) + 9;
            const double facing = found->facing[count] = dot(plane.n, ray);
            if (!(facing < -args.least_cosine * std::sqrt(dot(ray, ray)))) return false;
            for (int l = 0; l < 3; ++l) away[l] = eye[l] - start[l];
            const double s = (plane.z * plane.facing + dot(plane.n, away)) / facing;
            if (!(s > 0)) return false;
            for (int l = 0; l < 3; ++l) points[count][l] = start[l] + s * ray[l] + args.shift[l];
        }
    for (int first = 0; first < count; first += WIDE) {
        const int begin = std::min(first, count - WIDE);  // the last points may be seen twice
        if (!see(args.other, *args.other_camera, points + begin, found->rays + begin, found->seen + begin, found->slope + begin))
            return false;
    }
    found->count = count;
    return true;
}

// The loss of the patch around a pixel; false if it has none. `of_z` and `of_n` get the gradients, 0 if it does not learn.
template <class T>
bool patch(const PatchArgs<T> &args, int64_t u, int64_t v, const Plane &plane, double *loss, double *of_z, double *of_n) {
    const int64_t r = args.radius, W = args.photo.W, H = args.photo.H;
    if (v < r || v + r >= H || W <= 2 * r || (!args.lens.wraps && (u < r || u + r >= W))) return false;
    Pixels found;
    const bool lenses = args.lens.rays;
    if (!(lenses ? through_lenses(args, u, v, plane, &found) : through_pinholes(args, u, v, plane, &found))) return false;
    const int count = found.count;
    const double *own = found.own, *seen = found.seen, *facing = found.facing;
    const double own_length = centred(found.own, count), length = centred(found.seen, count),
                 least = args.least_spread * std::sqrt(double(count));
    if (!(own_length >= least && length >= least)) return false;
    double ncc = 0;
    for (int i = 0; i < count; ++i) ncc += own[i] * seen[i];
    ncc /= own_length * length;
    *loss = std::min(1 - ncc, args.most), *of_z = of_n[0] = of_n[1] = of_n[2] = 0;
    if (!(1 - ncc < args.most)) return true;
    for (int i = 0; i < count; ++i) {
        const double of_s = -(own[i] / own_length - ncc * seen[i] / length) / length * found.slope[i], inverse = 1 / facing[i];
        *of_z += of_s * plane.facing * inverse;
        for (int k = 0; k < 3; ++k) of_n[k] += of_s * plane.z * inverse * (plane.ray[k] - plane.facing * inverse * found.rays[i][k]);
        if (!lenses) continue;
        const double apart = dot(plane.n, found.away[i]);
        for (int k = 0; k < 3; ++k) of_n[k] += of_s * inverse * (found.away[i][k] - apart * inverse * found.rays[i][k]);
    }
    return true;
}

}  // namespace

template <class T>
void patch_row(const PatchArgs<T> &args, int64_t row) {
    const int64_t v = args.first_v + row * args.stride, W = args.photo.W;
    double total = 0, learning = 0;
    for (int64_t u = args.first_u; u < W; u += args.stride) {
        Plane plane;
        double loss, of_z, of_n[3], of_normal[3];
        if (!plane_of(args, u, v, &plane) || !patch(args, u, v, plane, &loss, &of_z, of_n)) continue;
        total += args.scale * loss, learning += loss < args.most;
        const double along = dot(plane.n, of_n), alpha = args.alpha[v * W + u];
        for (int k = 0; k < 3; ++k) of_n[k] = args.scale * (of_n[k] - plane.n[k] * along) / plane.length;
        multiply_transposed(args.R, of_n, of_normal);
        for (int k = 0; k < 3; ++k) args.grad_normals[3 * (v * W + u) + k] = T(of_normal[k]);
        args.grad_depth[v * W + u] = T(args.scale * of_z / alpha);
        args.grad_alpha[v * W + u] = T(-args.scale * of_z * plane.z / alpha);
    }
    args.sums[2 * row] = total, args.sums[2 * row + 1] = learning;
}

template void patch_row<float>(const PatchArgs<float> &, int64_t);
template void patch_row<double>(const PatchArgs<double> &, int64_t);

}  // namespace gsplat
