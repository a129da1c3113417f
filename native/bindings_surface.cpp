// The calls of the native module that surfaces need; like all calls, they check every array before a kernel gets its address.
#include "bindings_surface.h"

#include "arguments.h"
#include "buffers.h"
#include "dispatch.h"
#include "structures.h"
#include "threads.h"

namespace gsplat {

namespace {

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
    a.numbers("R", args.R, 9);
    args.fx = a.number("fx"), args.fy = a.number("fy"), args.cx = a.number("cx"), args.cy = a.number("cy");
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

}  // namespace

void bind_surface(nb::module_ &m) {
    m.def("surface_f32", &surface_of<float>);
    m.def("surface_f64", &surface_of<double>);
    m.def("normals_f32", &normals<float>);
    m.def("normals_f64", &normals<double>);
    m.def("normals_backward_f32", &normals_backward<float>);
    m.def("normals_backward_f64", &normals_backward<double>);
}

}  // namespace gsplat
