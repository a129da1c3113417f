// The calls of the native module that surfaces need; like all calls, they check every array before a kernel gets its address.
#include "bindings_surface.h"

#include "arguments.h"
#include "buffers.h"
#include "dispatch.h"
#include "patches.h"
#include "structures.h"
#include "threads.h"

namespace gsplat {

namespace {

// The rays of a camera with a lens or a rolling shutter; those of a pinhole are not given.
template <class T>
RayImage<T> rays_of(Arguments &a, const Shape &plane) {
    RayImage<T> found{};
    if (!a.has("rays")) return found;
    found.rays = a.array("rays", {KIND<T>}, {plane[0], plane[1], 3}).template as<T>();
    const Array frames = a.array("frames", {Kind::F64}, {ANY, 12});
    const int64_t axis = a.whole("axis", 0, 1), wanted = axis == 0 ? plane[1] : plane[0];
    found.frames = frames.as<double>();
    found.wraps = int32_t(a.whole("wraps", 0, 1));
    if (frames.shape[0] == 1) return found;
    if (frames.shape[0] != wanted) a.fail("frames", "have to be one, or one for each row or column");
    found.by_row = axis == 1, found.by_column = axis == 0;
    return found;
}

// Returns the loss of a camera's composited normals, and writes its gradients.
template <class T>
double surface_of(nb::args positional, nb::kwargs given) {
    Arguments a("surface", positional, given);
    const Array normals = a.array("normals", {KIND<T>}, {ANY, ANY, 3});
    const Shape plane = {normals.shape[0], normals.shape[1]};
    SurfaceArgs<T> args{};
    args.normals = normals.as<T>();
    args.depth = a.array("depth", {KIND<T>}, plane).template as<T>();
    args.alpha = a.array("alpha", {KIND<T>}, plane).template as<T>();
    args.grad_normals = a.array("grad_normals", {KIND<T>}, normals.shape, true).template as<T>();
    args.grad_depth = a.array("grad_depth", {KIND<T>}, plane, true).template as<T>();
    args.grad_alpha = a.array("grad_alpha", {KIND<T>}, plane, true).template as<T>();
    args.lens = rays_of<T>(a, plane);
    if (!args.lens.rays) {
        a.numbers("R", args.R, 9);
        args.fx = a.number("fx"), args.fy = a.number("fy"), args.cx = a.number("cx"), args.cy = a.number("cy");
    }
    args.scale = a.number("scale"), args.jump = a.number("jump");
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    if (plane[0] > MOST || plane[1] > MOST) a.fail("normals", "is too large");
    args.H = int32_t(plane[0]), args.W = int32_t(plane[1]);
    nb::gil_scoped_release release;
    Buffer depths, tangents, sums;
    const size_t pixels = size_t(plane.size());
    args.depths = static_cast<T *>(depths.reserve(pixels * sizeof(T)));
    args.tangents = static_cast<T *>(tangents.reserve(6 * pixels * sizeof(T)));
    args.sums = static_cast<double *>(sums.reserve((size_t(args.H) + 1) * sizeof(double)));
    const auto &table = kernels<T>();
    parallel(threads, args.H, [&](int64_t row, int) { table.surface_depths(args, row); });
    parallel(threads, args.H, [&](int64_t row, int) { table.surface_tangents(args, row); });
    parallel(threads, args.H, [&](int64_t row, int) { table.surface_gradient(args, row); });
    double total = 0;
    for (int64_t row = 0; row < args.H; ++row) total += args.sums[row];
    return total;
}

// What both passes of normals take.
template <class T>
NormalArgs<T> normal_args(Arguments &a) {
    const Array means = a.array("means", {KIND<T>}, {ANY, 3});
    NormalArgs<T> args{};
    args.n = means.shape[0], args.means = means.as<T>();
    args.quats = a.array("quats", {KIND<T>}, {args.n, 4}).template as<T>();
    args.log_scales = a.array("log_scales", {KIND<T>}, {args.n, 3}).template as<T>();
    a.numbers("eye", args.eye, 3);
    return args;
}

template <class T>
void normals(nb::args positional, nb::kwargs given) {
    Arguments a("normals", positional, given);
    NormalArgs<T> args = normal_args<T>(a);
    args.out = a.array("out", {KIND<T>}, {args.n, 3}, true).template as<T>();
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    nb::gil_scoped_release release;
    parallel(threads, (args.n + BLOCK - 1) / BLOCK, [&](int64_t block, int) { kernels<T>().normals(args, block); });
}

template <class T>
void normals_backward(nb::args positional, nb::kwargs given) {
    Arguments a("normals_backward", positional, given);
    NormalArgs<T> args = normal_args<T>(a);
    args.grad = a.array("grad", {KIND<T>}, {args.n, 3}).template as<T>();
    args.grad_quats = a.array("grad_quats", {KIND<T>}, {args.n, 4}, true).template as<T>();
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    nb::gil_scoped_release release;
    parallel(threads, (args.n + BLOCK - 1) / BLOCK, [&](int64_t block, int) { kernels<T>().normals_backward(args, block); });
}

// A photo of one channel with its camera; which of its pixels count may be None.
Grey grey_of(Arguments &a, const char *name, const char *counts, const char *intrinsics, const Shape &wanted) {
    Grey grey{};
    const Array pixels = a.array(name, {Kind::U8}, wanted);
    grey.counts = a.array_or_none(counts, Kind::U8, pixels.shape).as<uint8_t>();
    if (pixels.shape[0] > MOST || pixels.shape[1] > MOST) a.fail(name, "is too large");
    grey.pixels = pixels.as<uint8_t>();
    grey.H = int32_t(pixels.shape[0]), grey.W = int32_t(pixels.shape[1]);
    double numbers[4];
    a.numbers(intrinsics, numbers, 4);
    grey.fx = numbers[0], grey.fy = numbers[1], grey.cx = numbers[2], grey.cy = numbers[3];
    return grey;
}

// Returns the loss of a camera's patches, and how many of them learn; writes their gradients.
template <class T>
nb::tuple patches_of(nb::args positional, nb::kwargs given) {
    Arguments a("patches", positional, given);
    const Array normals = a.array("normals", {KIND<T>}, {ANY, ANY, 3});
    const Shape plane = {normals.shape[0], normals.shape[1]};
    PatchArgs<T> args{};
    args.normals = normals.as<T>();
    args.depth = a.array("depth", {KIND<T>}, plane).template as<T>();
    args.alpha = a.array("alpha", {KIND<T>}, plane).template as<T>();
    args.grad_normals = a.array("grad_normals", {KIND<T>}, normals.shape, true).template as<T>();
    args.grad_depth = a.array("grad_depth", {KIND<T>}, plane, true).template as<T>();
    args.grad_alpha = a.array("grad_alpha", {KIND<T>}, plane, true).template as<T>();
    args.photo = grey_of(a, "photo", "photo_counts", "photo_intrinsics", plane);
    args.other = grey_of(a, "other", "other_counts", "other_intrinsics", {ANY, ANY});
    a.numbers("R", args.R, 9), a.numbers("turn", args.turn, 9), a.numbers("shift", args.shift, 3);
    args.lens = rays_of<T>(a, plane);
    if (args.lens.rays) args.other_camera = &struct_of<Camera>(a, "other_camera");
    args.radius = int32_t(a.whole("radius", 1, MOST_RADIUS)), args.stride = int32_t(a.whole("stride", 1, MOST));
    args.first_u = int32_t(a.whole("first_u", 0, MOST)), args.first_v = int32_t(a.whole("first_v", 0, MOST));
    args.scale = a.number("scale"), args.most = a.number("most");
    args.least_alpha = a.number("least_alpha"), args.least_cosine = a.number("least_cosine"), args.least_spread = a.number("least_spread");
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    double total = 0, learning = 0;
    {
        nb::gil_scoped_release release;
        const size_t pixels = size_t(plane.size());
        if (pixels) {  // an empty array may have no address
            memset(args.grad_normals, 0, 3 * pixels * sizeof(T));
            memset(args.grad_depth, 0, pixels * sizeof(T));
            memset(args.grad_alpha, 0, pixels * sizeof(T));
        }
        Buffer sums;
        const int64_t rows = args.rows();
        args.sums = static_cast<double *>(sums.reserve((2 * size_t(rows) + 1) * sizeof(double)));
        parallel(threads, rows, [&](int64_t row, int) { patch_row(args, row); });
        for (int64_t row = 0; row < rows; ++row) total += args.sums[2 * row], learning += args.sums[2 * row + 1];
    }
    return nb::make_tuple(total, int64_t(learning));
}

}  // namespace

void bind_surface(nb::module_ &m) {
    m.def("surface_f32", &surface_of<float>);
    m.def("surface_f64", &surface_of<double>);
    m.def("patches_f32", &patches_of<float>);
    m.def("patches_f64", &patches_of<double>);
    m.def("normals_f32", &normals<float>);
    m.def("normals_f64", &normals<double>);
    m.def("normals_backward_f32", &normals_backward<float>);
    m.def("normals_backward_f64", &normals_backward<double>);
}

}  // namespace gsplat
