// The module gsplat_edu._native: the only file here that knows Python. Arrays come as addresses; render/cpu.py owns
// the tensors and has checked dtype, shape and layout.
#include <nanobind/nanobind.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdlib>
#include <string>
#include <vector>

#include "frame.h"
#include "threads.h"

namespace nb = nanobind;
using namespace gsplat;

namespace {

using Address = uintptr_t;

template <class T>
T *at(Address address) {
    return reinterpret_cast<T *>(address);
}

// View: R (9), eye (3), fx, fy, cx, cy, z_near, background (3), bounds of x/z (2) and y/z (2) inside the Jacobian.
using View = std::array<double, 24>;

Camera camera_of(const View &v, int32_t H, int32_t W) {
    Camera cam{};
    for (int k = 0; k < 9; ++k) cam.R[k] = v[k];
    for (int k = 0; k < 3; ++k) cam.eye[k] = v[9 + k];
    cam.fx = v[12], cam.fy = v[13], cam.cx = v[14], cam.cy = v[15];
    cam.x_low = v[20], cam.x_high = v[21], cam.y_low = v[22], cam.y_high = v[23], cam.H = H, cam.W = W;
    return cam;
}

template <class T>
Scene<T> scene_of(int64_t n, int32_t rest, const std::array<Address, 9> &p) {
    return {n, at<T>(p[0]), at<T>(p[1]), at<T>(p[2]), at<T>(p[3]), at<T>(p[4]), at<T>(p[5]), rest, at<T>(p[6]), at<T>(p[7]), at<T>(p[8])};
}

template <class T>
void bind_frame(nb::module_ &m, const char *name) {
    using F = Frame<T>;
    nb::class_<F>(m, name)
        .def("__init__",
             [](F *self, int64_t n, int32_t rest, const std::array<Address, 9> &scene, const View &view, int32_t H, int32_t W,
                int32_t sh_degree, bool antialiased, int threads) {
                 nb::gil_scoped_release release;
                 Settings set{view[16], {view[17], view[18], view[19]}, sh_degree, antialiased};
                 new (self) F(scene_of<T>(n, rest, scene), camera_of(view, H, W), set, threads);
             })
        .def("composite",
             [](F &self, Address image, Address transmittance, Address depth) {
                 nb::gil_scoped_release release;
                 self.composite({at<T>(image), at<T>(transmittance), at<T>(depth)});
             })
        .def("backward",
             [](F &self, int64_t n, int32_t rest, const std::array<Address, 9> &scene, const std::array<Address, 3> &forward,
                const std::array<Address, 3> &in, const std::array<Address, 10> &out, Address background) {
                 nb::gil_scoped_release release;
                 SceneGrads<T> grads{at<T>(out[0]), at<T>(out[1]), at<T>(out[2]), at<T>(out[3]), at<T>(out[4]),
                                     at<T>(out[5]), at<T>(out[6]), at<T>(out[7]), at<T>(out[8]), at<T>(out[9])};
                 self.backward(scene_of<T>(n, rest, scene), {at<T>(forward[0]), at<T>(forward[1]), at<T>(forward[2])},
                               {at<T>(in[0]), at<T>(in[1]), at<T>(in[2])}, grads, at<T>(background));
             })
        .def("visible",
             [](const F &self, Address ids, Address radii) {
                 for (int64_t k = 0; k < self.num_visible(); ++k) {
                     const uint32_t id = self.visible()[k];
                     at<int64_t>(ids)[k] = id;
                     for (int j = 0; j < 2; ++j) at<T>(radii)[2 * k + j] = self.splats()[id].extent[j];
                 }
             })
        .def_prop_ro("seconds", &F::seconds)
        .def_prop_ro("num_visible", &F::num_visible)
        .def_prop_ro("num_pairs", &F::num_pairs);
}

template <class T>
void adam(const std::array<Address, 4> &arrays, int64_t size, const std::array<double, 6> &number, int threads) {
    nb::gil_scoped_release release;
    AdamArgs<T> args{at<T>(arrays[0]), at<T>(arrays[1]), at<T>(arrays[2]), at<T>(arrays[3]),
                     number[0], number[1], number[2], number[3], number[4], number[5]};
    constexpr int64_t GRAIN = 1 << 15;
    parallel(threads, (size + GRAIN - 1) / GRAIN, [&](int64_t task, int) {
        kernels<T>().adam(args, task * GRAIN, std::min(size, (task + 1) * GRAIN));
    });
}

// image, target, bytes, gradient -> (mean |x - y|, mean SSIM)
template <class T>
std::array<double, 2> loss_of(const std::array<Address, 4> &p, int32_t H, int32_t W, double ssim_weight, int threads) {
    nb::gil_scoped_release release;
    LossArgs<T> args{at<T>(p[0]), at<T>(p[1]), at<uint8_t>(p[2]), H, W, ssim_weight, at<T>(p[3]), nullptr};
    std::array<double, 2> means;
    loss<T>(args, &means[0], &means[1], threads);
    return means;
}

// Vector FMAs per second of one thread: the unit that benchmarks count cost in.
double fma_rate() {
    nb::gil_scoped_release release;
    float sink = 0;
    constexpr int64_t ROUNDS = 4000000;
    const auto start = std::chrono::steady_clock::now();
    const int chains = isa().fma_benchmark(ROUNDS, &sink);
    const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - start;
    return double(ROUNDS) * chains / seconds.count();
}

std::vector<std::string> isas() {
    const char *names[8];
    const int count = list_isas(names, 8);
    return {names, names + count};
}

// A Python function, kept as long as the process: native frames may outlive the interpreter's modules.
PyObject *free_memory_function = nullptr;

int64_t free_memory() {
    if (!Py_IsInitialized()) return -1;
    nb::gil_scoped_acquire hold;
    PyObject *found = PyObject_CallNoArgs(free_memory_function);
    const int64_t bytes = found && found != Py_None ? int64_t(PyLong_AsLongLong(found)) : -1;
    Py_XDECREF(found);
    if (PyErr_Occurred()) {  // not knowing is no reason to end a training
        PyErr_Clear();
        return -1;
    }
    return bytes;
}

}  // namespace

NB_MODULE(_native, m) {
    nb::set_leak_warnings(false);  // what Python still holds when it ends is freed with the process
    choose_isa(std::getenv("GSPLAT_EDU_ISA"));
    bind_frame<float>(m, "FrameF32");
    bind_frame<double>(m, "FrameF64");
    m.def("adam_f32", &adam<float>);
    m.def("adam_f64", &adam<double>);
    m.def("loss_f32", &loss_of<float>);
    m.def("loss_f64", &loss_of<double>);
    m.def("ask_before_large_blocks", [](const nb::object &function) {
        free_memory_function = function.inc_ref().ptr();
        ask_before_large_blocks(&free_memory);
    });
    m.def("isas", &isas);
    m.def("isa", [] { return std::string(isa().name); });
    m.def("choose_isa", [](const std::string &name) { choose_isa(name.c_str()); });
    m.def("fma_rate", &fma_rate);
}
