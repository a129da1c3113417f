// The calls of the native module that gsplat's interface needs; like all calls, they check every array before a kernel gets its address.
#include "bindings_screen.h"

#include <vector>

#include "arguments.h"
#include "dispatch.h"
#include "structures.h"
#include "threads.h"

namespace gsplat {

namespace {

// What both passes of the projection take.
template <class T>
ScreenArgs<T> screen_args(Arguments &a) {
    const Array means = a.array("means", {KIND<T>}, {ANY, 3});
    ScreenArgs<T> args{};
    args.n = means.shape[0], args.means = means.as<T>();
    args.covars = a.array_or_none("covars", KIND<T>, {args.n, 6}).template as<T>();
    if (!args.covars) {
        args.quats = a.array("quats", {KIND<T>}, {args.n, 4}).template as<T>();
        args.scales = a.array("scales", {KIND<T>}, {args.n, 3}).template as<T>();
    }
    a.numbers("viewmat", args.viewmat, 12), a.numbers("K", args.K, 4), a.numbers("size", args.size, 2);
    args.margin = a.number("margin"), args.eps2d = a.number("eps2d");
    args.z_near = a.number("z_near"), args.z_far = a.number("z_far");
    return args;
}

template <class T>
void screen_of(nb::args positional, nb::kwargs given) {
    Arguments a("screen", positional, given);
    ScreenArgs<T> args = screen_args<T>(a);
    const auto written = [&](const char *name, const Shape &shape) {
        return a.array(name, {Kind::F64}, shape, true).template as<double>();
    };
    args.centres = written("centres", {args.n, 2}), args.depths = written("depths", {args.n});
    args.conics = written("conics", {args.n, 3}), args.compensations = written("compensations", {args.n});
    args.spreads = written("spreads", {args.n, 3});
    args.drawable = a.array("drawable", {Kind::U8}, {args.n}, true).template as<uint8_t>();
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    nb::gil_scoped_release release;
    parallel(threads, (args.n + BLOCK - 1) / BLOCK, [&](int64_t block, int) { kernels<T>().screen(args, block); });
}

// Returns the gradient of the camera's numbers, and adds the others to their arrays.
template <class T>
nb::list screen_backward_of(nb::args positional, nb::kwargs given) {
    Arguments a("screen_backward", positional, given);
    ScreenArgs<T> args = screen_args<T>(a);
    const auto read = [&](const char *name, const Shape &shape) { return a.array_or_none(name, Kind::F64, shape).template as<double>(); };
    args.grad_centres = read("grad_centres", {args.n, 2}), args.grad_depths = read("grad_depths", {args.n});
    args.grad_conics = read("grad_conics", {args.n, 3}), args.grad_compensations = read("grad_compensations", {args.n});
    args.grad_spreads = read("grad_spreads", {args.n, 3});
    const auto added = [&](const char *name, int64_t width) { return a.array(name, {KIND<T>}, {args.n, width}, true).template as<T>(); };
    args.grad_means = added("grad_means", 3);
    if (args.covars)
        args.grad_covars = added("grad_covars", 6);
    else
        args.grad_quats = added("grad_quats", 4), args.grad_scales = added("grad_scales", 3);
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    double total[SCREEN_CAMERA] = {};
    {
        nb::gil_scoped_release release;
        const int64_t blocks = (args.n + BLOCK - 1) / BLOCK;
        std::vector<double> sums(size_t(blocks * SCREEN_CAMERA));
        args.camera_sums = sums.data();
        parallel(threads, blocks, [&](int64_t block, int) { kernels<T>().screen_backward(args, block); });
        for (size_t k = 0; k < sums.size(); ++k) total[k % SCREEN_CAMERA] += sums[k];
    }
    nb::list found;
    for (const double value : total) found.append(value);
    return found;
}

template <class T>
void radii_of(nb::args positional, nb::kwargs given) {
    Arguments a("radii", positional, given);
    RadiusArgs<T> args{};
    const Array centres = a.array("centres", {Kind::F64}, {ANY, 2});
    args.n = centres.shape[0], args.centres = centres.as<double>();
    args.spreads = a.array("spreads", {Kind::F64}, {args.n, 3}).template as<double>();
    args.drawable = a.array("drawable", {Kind::U8}, {args.n}).template as<uint8_t>();
    args.opacities = a.array_or_none("opacities", KIND<T>, {args.n}).template as<T>();
    args.compensations = a.array_or_none("compensations", Kind::F64, {args.n}).template as<double>();
    a.numbers("size", args.size, 2);
    args.eps2d = a.number("eps2d"), args.extent = a.number("extent"), args.radius_clip = a.number("radius_clip");
    args.radii = a.array("radii", {Kind::I32}, {args.n, 2}, true).template as<int32_t>();
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    nb::gil_scoped_release release;
    parallel(threads, (args.n + BLOCK - 1) / BLOCK,
             [&](int64_t block, int) { kernels<T>().radii(args, block * BLOCK, std::min(args.n, (block + 1) * BLOCK)); });
}

// What both passes of the harmonics take. The rows are checked and inverted here: a task takes a range of them.
template <class T>
HarmonicArgs<T> harmonic_args(Arguments &a, std::vector<int64_t> &index_of) {
    const Array directions = a.array("directions", {KIND<T>}, {ANY, 3});
    const Array coefficients = a.array("coefficients", {KIND<T>}, {ANY, ANY, 3});
    HarmonicArgs<T> args{};
    args.n = directions.shape[0], args.directions = directions.as<T>();
    args.rows = coefficients.shape[0], args.stored = coefficients.shape[1], args.coefficients = coefficients.as<T>();
    args.degree = int32_t(a.whole("degree", 0, 3));
    if (args.used() > args.stored) a.fail("degree", "needs more coefficients");
    args.row_of = a.array("rows", {Kind::I64}, {args.n}).template as<int64_t>();
    index_of.assign(size_t(args.rows), -1);
    for (int64_t i = 0; i < args.n; ++i) {
        const int64_t row = args.row_of[i];
        if (row < 0 || row >= args.rows || index_of[size_t(row)] >= 0) a.fail("rows", "have to be different rows of coefficients");
        index_of[size_t(row)] = i;
    }
    args.index_of = index_of.data();
    return args;
}

template <class T>
void harmonics_of(nb::args positional, nb::kwargs given) {
    Arguments a("harmonics", positional, given);
    std::vector<int64_t> index_of;
    HarmonicArgs<T> args = harmonic_args<T>(a, index_of);
    args.colors = a.array("colors", {KIND<T>}, {args.n, 3}, true).template as<T>();
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    nb::gil_scoped_release release;
    parallel(threads, (args.rows + BLOCK - 1) / BLOCK, [&](int64_t block, int) { kernels<T>().harmonic_colors(args, block); });
}

template <class T>
void harmonics_backward_of(nb::args positional, nb::kwargs given) {
    Arguments a("harmonics_backward", positional, given);
    std::vector<int64_t> index_of;
    HarmonicArgs<T> args = harmonic_args<T>(a, index_of);
    args.grad_colors = a.array("grad_colors", {KIND<T>}, {args.n, 3}).template as<T>();
    args.grad_directions = a.array("grad_directions", {KIND<T>}, {args.n, 3}, true).template as<T>();
    args.grad_coefficients = a.array("grad_coefficients", {KIND<T>}, {args.rows, args.stored, 3}, true).template as<T>();
    args.overwrites = a.flag("overwrites");
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    nb::gil_scoped_release release;
    parallel(threads, (args.rows + BLOCK - 1) / BLOCK, [&](int64_t block, int) { kernels<T>().harmonic_colors_backward(args, block); });
}

}  // namespace

void bind_screen(nb::module_ &m) {
    m.def("screen_f32", &screen_of<float>);
    m.def("screen_f64", &screen_of<double>);
    m.def("screen_backward_f32", &screen_backward_of<float>);
    m.def("screen_backward_f64", &screen_backward_of<double>);
    m.def("radii_f32", &radii_of<float>);
    m.def("radii_f64", &radii_of<double>);
    m.def("harmonics_f32", &harmonics_of<float>);
    m.def("harmonics_f64", &harmonics_of<double>);
    m.def("harmonics_backward_f32", &harmonics_backward_of<float>);
    m.def("harmonics_backward_f64", &harmonics_backward_of<double>);
}

}  // namespace gsplat
