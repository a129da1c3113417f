// The module gsplat_edu._native. Only this file, bindings_volume.cpp, structures.h and arguments.h know Python.
//
// Every call takes its arguments by name. The dtype, shape, layout, alignment and device of every array are checked here,
// before a kernel gets its address. Kernels check nothing.

#include <nanobind/stl/array.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdlib>
#include <limits>
#include <utility>
#include <vector>

#include "bindings_screen.h"
#include "bindings_surface.h"
#include "bindings_surfels.h"
#include "bindings_volume.h"
#include "buffers.h"
#include "dispatch.h"
#include "loss.h"
#include "structures.h"
#include "threads.h"

using namespace gsplat;

namespace {

// The scene and image sizes of a frame, against which the arguments of its later calls are checked.
template <class T>
struct BoundFrame {
    int64_t n, rest;
    bool direct, composited = false, with_depth = false;
    int64_t channels = 0;
    int32_t H, W;
    int64_t camera_numbers;  // of its gradient
    Frame<T> frame;

    BoundFrame(const SceneArrays &scene, const Camera &camera, const Settings &settings, const uint8_t *needed, int threads)
        : n(scene.n),
          rest(scene.rest),
          direct(scene.direct),
          H(camera.H),
          W(camera.W),
          camera_numbers(gsplat::camera_numbers(camera)),
          frame(scene.as<T>(), camera, settings, needed, threads) {}

    void check(const Arguments &a, const char *name, const PerGaussian &given) const {
        if (!given.means.is(KIND<T>)) a.fail(name, "is of another dtype than the frame");
        if (given.n != n || given.rest != rest || given.direct != direct) a.fail(name, "differs in shape from the scene of the frame");
    }

    void check(const Arguments &a, const char *name, const ImageArrays &given, bool whole) const {
        if (!given.image.is(KIND<T>)) a.fail(name, "is of another dtype than the frame");
        if (given.image.shape[0] != H || given.image.shape[1] != W) a.fail(name, "has another size than the frame");
        if (whole && !given.transmittance) a.fail(name, "needs transmittance");
    }

    // Features of the frame's Gaussians for images that have them.
    Array features_of(Arguments &a, const ImageArrays &images) const {
        const Array features = a.array_or_none("features", KIND<T>, {n, images.features ? images.channels() : ANY});
        if (bool(features) != bool(images.features)) a.fail("features", "has to be given exactly where the images have features");
        return features;
    }

    // Before a backward pass.
    void check_images(const Arguments &a, const ImageArrays &images, const ImageArrays &incoming) const {
        if (!composited) a.fail("images", "are not there yet; call composite first");
        check(a, "images", images, true), check(a, "incoming", incoming, false);
        if (bool(images.depth) != with_depth) a.fail("images", "has to have a depth exactly where the composited ones had");
        if (images.channels() != channels) a.fail("images", "has to have as many channels of features as the composited ones");
        if (incoming.depth && !images.depth) a.fail("incoming", "has a gradient of the depth, which was not rendered");
        if (incoming.median) a.fail("incoming", "has a gradient of the median depth, which has none");
        if (incoming.features && incoming.channels() != channels) a.fail("incoming", "has another number of channels than the images");
    }

    const StatisticArrays *collected_of(Arguments &a) const;
};

// Statistics to collect, or null for None.
template <class T>
const StatisticArrays *BoundFrame<T>::collected_of(Arguments &a) const {
    if (a.is_none("collected")) return nullptr;
    const auto &given = struct_of<StatisticArrays>(a, "collected");
    if (!given.values.is(KIND<T>)) a.fail("collected", "is of another dtype than the frame");
    if (given.values.shape[0] != n) a.fail("collected", "has another number of Gaussians than the frame");
    if (given.errors && (given.errors.shape[0] != H || given.errors.shape[1] != W))
        a.fail("collected", "has errors of another size than the frame");
    return &given;
}

template <class T>
Collected<T> collected_as(const StatisticArrays *given) {
    return given ? Collected<T>{given->values.as<T>(), given->errors.as<T>()} : Collected<T>{nullptr, nullptr};
}

template <class T>
void make_frame(BoundFrame<T> *self, nb::args positional, nb::kwargs given) {
    Arguments a("Frame", positional, given);
    const auto &scene = struct_of<SceneArrays>(a, "scene");
    const auto &camera = struct_of<Camera>(a, "camera");
    const auto &settings = struct_of<Settings>(a, "settings");
    const Array needed = a.array_or_none("needed", Kind::U8, {camera.H, camera.W});
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    if (!scene.means.is(KIND<T>)) a.fail("scene", "is of another dtype than the frame");
    if (!scene.direct && (settings.sh_degree + 1) * (settings.sh_degree + 1) - 1 > scene.rest)
        a.fail("settings", "sh_degree is above the degree of the scene's sh_rest");
    nb::gil_scoped_release release;
    new (self) BoundFrame<T>(scene, camera, settings, needed.as<uint8_t>(), threads);
}

template <class T>
void composite(BoundFrame<T> &self, nb::args positional, nb::kwargs given) {
    Arguments a("Frame.composite", positional, given);
    const auto &images = struct_of<ImageArrays>(a, "images");
    self.check(a, "images", images, true);
    const Array features = self.features_of(a, images);
    a.finish();
    nb::gil_scoped_release release;
    self.frame.composite(images.as_outputs<T>(), features.as<T>());
    self.composited = true, self.with_depth = bool(images.depth), self.channels = images.channels();
}

template <class T>
void backward(BoundFrame<T> &self, nb::args positional, nb::kwargs given) {
    Arguments a("Frame.backward", positional, given);
    const auto &scene = struct_of<SceneArrays>(a, "scene");
    const auto &images = struct_of<ImageArrays>(a, "images");
    const auto &incoming = struct_of<ImageArrays>(a, "incoming");
    const auto &gradients = struct_of<GradientArrays>(a, "gradients");
    const Array features = self.features_of(a, images);
    const StatisticArrays *collected = self.collected_of(a);
    a.finish();
    self.check(a, "scene", scene), self.check(a, "gradients", gradients);
    self.check_images(a, images, incoming);
    if (incoming.features && (!gradients.features || gradients.features.shape[1] != self.channels))
        a.fail("gradients", "needs features, with as many channels as the images");
    if (gradients.camera && gradients.camera.shape[0] != self.camera_numbers)
        a.fail("gradients", "has a camera with another number of entries than the frame's camera has");
    nb::gil_scoped_release release;
    self.frame.backward(scene.as<T>(), {images.as_outputs<T>(), features.as<T>(), collected_as<T>(collected)}, incoming.as_gradients<T>(),
                        gradients.as<T>(), gradients.background.as<T>(), gradients.camera.as<double>());
}

// The arguments of Frame.adam: a group for each raw parameter, and the norms of the image positions' gradients.
struct AdamGroups {
    const AdamArrays *groups[GROUPS];
    Array means2d_norm;

    template <class T>
    AdamGroups(Arguments &a, const BoundFrame<T> &frame) {
        const int64_t n = frame.n;
        const Shape shapes[GROUPS] = {{n, 3}, {n, 4}, {n, 3}, {n, 1, 3}, {n, frame.rest, 3}, {n}};
        for (int g = 0; g < GROUPS; ++g) {
            groups[g] = &struct_of<AdamArrays>(a, NAMES[g]);
            if (!groups[g]->parameter.is(KIND<T>)) a.fail(NAMES[g], "is of another dtype than the frame");
            if (!shapes[g].allows(groups[g]->parameter.shape)) a.fail(NAMES[g], "differs in shape from the scene of the frame");
        }
        means2d_norm = a.array("means2d_norm", {KIND<T>}, {n}, true);
    }

    // Threads write a range of each array; memory that two of them share would make the result depend on their order.
    void refuse_overlaps(const Arguments &a, std::initializer_list<const ImageArrays *> images, const StatisticArrays *collected) const {
        std::vector<std::pair<const char *, const Array *>> written, read;
        for (int g = 0; g < GROUPS; ++g) {
            for (const Array *array : {&groups[g]->parameter, &groups[g]->first, &groups[g]->second}) written.emplace_back(NAMES[g], array);
            read.emplace_back(NAMES[g], &groups[g]->extra);
        }
        written.emplace_back("means2d_norm", &means2d_norm);
        if (collected) written.emplace_back("collected", &collected->values), read.emplace_back("collected", &collected->errors);
        for (const ImageArrays *each : images)
            for (const Array *array : {&each->image, &each->transmittance, &each->depth, &each->features})
                read.emplace_back("images", array);
        read.insert(read.end(), written.begin(), written.end());
        for (const auto &[name, array] : written)
            for (const auto &[_, other] : read)
                if (array != other && array->overlaps(*other)) a.fail(name, "has an array that overlaps another one");
    }

    template <class T>
    Scene<T> scene(int64_t n, int64_t rest) const {
        const auto at = [&](int g) { return groups[g]->parameter.template as<T>(); };
        return {n,       at(MEANS), at(QUATS), at(LOG_SCALES), at(SH0), at(SH_REST), at(LOGIT_OPACITIES), int32_t(rest),
                nullptr, nullptr,   nullptr};
    }

    static constexpr const char *NAMES[GROUPS] = {"means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities"};
};

template <class T>
void adam_backward(BoundFrame<T> &self, nb::args positional, nb::kwargs given) {
    Arguments a("Frame.adam", positional, given);
    const auto &images = struct_of<ImageArrays>(a, "images");
    const auto &incoming = struct_of<ImageArrays>(a, "incoming");
    if (self.direct) a.fail("images", "are of covariances; Adam moves raw parameters");
    const AdamGroups given_groups(a, self);
    const StatisticArrays *collected = self.collected_of(a);
    a.finish();
    self.check_images(a, images, incoming);
    if (images.features) a.fail("images", "have features, which Adam does not move");
    given_groups.refuse_overlaps(a, {&images, &incoming}, collected);
    AdamArgs<T> groups[GROUPS];
    for (int g = 0; g < GROUPS; ++g) groups[g] = given_groups.groups[g]->template as<T>();
    nb::gil_scoped_release release;
    self.frame.adam(given_groups.template scene<T>(self.n, self.rest), {images.as_outputs<T>(), nullptr, collected_as<T>(collected)},
                    incoming.as_gradients<T>(), groups, given_groups.means2d_norm.template as<T>());
}

template <class T>
void visible(const BoundFrame<T> &self, nb::args positional, nb::kwargs given) {
    Arguments a("Frame.visible", positional, given);
    const int64_t count = self.frame.num_visible();
    const Array ids = a.array("ids", {Kind::I64}, {count}, true), radii = a.array("radii", {KIND<T>}, {count, 2}, true);
    a.finish();
    nb::gil_scoped_release release;
    self.frame.list_visible(ids.as<int64_t>(), radii.as<T>());
}

template <class T>
void tile_lists(const BoundFrame<T> &self, nb::args positional, nb::kwargs given) {
    Arguments a("Frame.tile_lists", positional, given);
    const Array begin = a.array("begin", {Kind::I64}, {self.frame.num_tiles() + 1}, true);
    const Array ids = a.array("ids", {Kind::I64}, {self.frame.num_pairs()}, true);
    a.finish();
    nb::gil_scoped_release release;
    self.frame.list_pairs(begin.as<int64_t>(), ids.as<int64_t>());
}

std::array<double, 6> of_stages(const std::array<StageTime, 6> &stages, double StageTime::*part) {
    std::array<double, 6> found;
    std::transform(stages.begin(), stages.end(), found.begin(), [part](const StageTime &stage) { return stage.*part; });
    return found;
}

template <class T>
void bind_frame(nb::module_ &m, const char *name) {
    using F = BoundFrame<T>;
    nb::class_<F>(m, name)
        .def("__init__", &make_frame<T>)
        .def("composite", &composite<T>)
        .def("backward", &backward<T>)
        .def("adam", &adam_backward<T>)
        .def("visible", &visible<T>)
        .def("tile_lists", &tile_lists<T>)
        .def_prop_ro("seconds", [](const F &self) { return of_stages(self.frame.stages(), &StageTime::seconds); })
        .def_prop_ro("processor_seconds", [](const F &self) { return of_stages(self.frame.stages(), &StageTime::processor); })
        .def_prop_ro("parallel_seconds", [](const F &self) { return of_stages(self.frame.stages(), &StageTime::parallel); })
        .def_prop_ro("num_visible", [](const F &self) { return self.frame.num_visible(); })
        .def_prop_ro("num_pairs", [](const F &self) { return self.frame.num_pairs(); });
}

template <class S>
void bind_struct(nb::module_ &m, const char *name, S (*made)(Arguments)) {
    nb::class_<S>(m, name).def("__init__", [name, made](S *self, nb::args positional, nb::kwargs given) {
        new (self) S(made(Arguments(name, positional, given)));
    });
}

template <class T>
void adam(nb::args positional, nb::kwargs given) {
    Arguments a("adam", positional, given);
    const Array parameter = a.array_of_any_shape("parameter", {KIND<T>}, true);
    const Array first = a.array("first", {KIND<T>}, parameter.shape, true), second = a.array("second", {KIND<T>}, parameter.shape, true);
    const Array gradient = a.array("gradient", {KIND<T>}, parameter.shape);
    const AdamArgs<T> args{parameter.as<T>(), first.as<T>(), second.as<T>(), gradient.as<T>(), nullptr, adam_numbers(a)};
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    const int64_t size = parameter.shape.size();
    nb::gil_scoped_release release;
    constexpr int64_t GRAIN = 1 << 15;
    parallel(threads, (size + GRAIN - 1) / GRAIN,
             [&](int64_t task, int) { kernels<T>().adam(args, task * GRAIN, std::min(size, (task + 1) * GRAIN)); });
}

template <class T>
void noise(nb::args positional, nb::kwargs given) {
    Arguments a("noise", positional, given);
    const Array means = a.array("means", {KIND<T>}, {ANY, 3}, true);
    const int64_t n = means.shape[0];
    const Array quats = a.array("quats", {KIND<T>}, {n, 4}), log_scales = a.array("log_scales", {KIND<T>}, {n, 3});
    const Array logit_opacities = a.array("logit_opacities", {KIND<T>}, {n});
    NoiseArgs<T> args{
        means.as<T>(),      quats.as<T>(),         log_scales.as<T>(),   logit_opacities.as<T>(), uint64_t(a.whole("seed", 0, INT64_MAX)),
        a.number("amount"), a.number("sharpness"), a.number("threshold")};
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    nb::gil_scoped_release release;
    constexpr int64_t GRAIN = 1 << 12;
    parallel(threads, (n + GRAIN - 1) / GRAIN,
             [&](int64_t task, int) { kernels<T>().noise(args, task * GRAIN, std::min(n, (task + 1) * GRAIN)); });
}

// What both passes of recolor take, and the shape of the image.
template <class T>
struct RecolorCall {
    RecolorArgs<T> args{};
    Shape shape;
    double background[3];
};

// The colour of what is seen is A (x - T background) + (1 - T) b, before the background: A x + b + T s with the shift
// s = background - A background - b. Without transmittance, the whole image is recoloured. recolor.cpp says what a falloff does.
template <class T>
RecolorCall<T> recolor_call(Arguments &a) {
    const Array image = a.array("image", {KIND<T>}, {ANY, ANY, 3}), matrix = a.array("matrix", {KIND<T>}, {3, 4});
    const Array photo = a.array_or_none("photo", Kind::U8, image.shape);
    const Array transmittance = a.array_or_none("transmittance", KIND<T>, {image.shape[0], image.shape[1]});
    const Array falloff = a.array_or_none("falloff", KIND<T>, {image.shape[0], image.shape[1]});
    RecolorCall<T> call{{}, image.shape, {}};
    a.numbers("background", call.background, 3);
    RecolorArgs<T> &args = call.args;
    args.image = image.as<T>(), args.photo = photo.as<uint8_t>(), args.pixels = image.shape.size() / 3;
    args.transmittance = transmittance.as<T>(), args.falloff = falloff.as<T>();
    std::copy_n(matrix.as<T>(), RECOLOR_NUMBERS, args.matrix);
    std::copy_n(call.background, 3, args.background);
    for (int c = 0; c < 3; ++c) {
        const T *row = args.matrix + 4 * c;
        double shift = call.background[c] - row[3];
        for (int k = 0; k < 3; ++k) shift -= row[k] * call.background[k];
        args.shift[c] = T(shift);
    }
    return call;
}

template <class T>
void recolor(nb::args positional, nb::kwargs given) {
    Arguments a("recolor", positional, given);
    RecolorCall<T> call = recolor_call<T>(a);
    RecolorArgs<T> &args = call.args;
    args.out = a.array("out", {KIND<T>}, call.shape, true).template as<T>();
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    nb::gil_scoped_release release;
    parallel(threads, args.tasks(), [&](int64_t task, int) { kernels<T>().recolor(args, task); });
}

// Writes the gradients of the image and of the transmittance if there is one, and that of the matrix unless it is None.
template <class T>
void recolor_backward(nb::args positional, nb::kwargs given) {
    Arguments a("recolor_backward", positional, given);
    RecolorCall<T> call = recolor_call<T>(a);
    RecolorArgs<T> &args = call.args;
    const Shape plane = {call.shape[0], call.shape[1]};
    args.grad = a.array("grad", {KIND<T>}, call.shape).template as<T>();
    args.out = a.array("grad_image", {KIND<T>}, call.shape, true).template as<T>();
    args.grad_transmittance = a.array_or_none("grad_transmittance", KIND<T>, plane, true).template as<T>();
    if (!args.grad_transmittance != !args.transmittance) a.fail("grad_transmittance", "has to be given if transmittance is, and only then");
    T *grad_matrix = a.array_or_none("grad_matrix", KIND<T>, {3, 4}, true).template as<T>();
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    nb::gil_scoped_release release;
    std::vector<double> sums(size_t(args.tasks()) * RECOLOR_SUMS);
    args.sums = grad_matrix ? sums.data() : nullptr;
    parallel(threads, args.tasks(), [&](int64_t task, int) { kernels<T>().recolor_backward(args, task); });
    if (!grad_matrix) return;
    double total[RECOLOR_SUMS] = {};
    for (size_t i = 0; i < sums.size(); ++i) total[i % RECOLOR_SUMS] += sums[i];
    for (int c = 0; c < 3; ++c) {  // the shift depends on the matrix, too
        for (int k = 0; k < 3; ++k) total[4 * c + k] -= total[RECOLOR_NUMBERS + c] * call.background[k];
        total[4 * c + 3] -= total[RECOLOR_NUMBERS + c];
    }
    std::copy(total, total + RECOLOR_NUMBERS, grad_matrix);
}

// Returns (mean |x - y|, mean SSIM) and writes the gradient.
template <class T>
std::array<double, 2> loss_of(nb::args positional, nb::kwargs given) {
    Arguments a("loss", positional, given);
    const Array image = a.array("image", {KIND<T>}, {ANY, ANY, 3});
    const Array target = a.array("target", {KIND<T>, Kind::U8}, image.shape);
    const Array gradient = a.array("gradient", {KIND<T>}, image.shape, true);
    const double ssim_weight = a.number("ssim_weight");
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    if (image.shape[0] > MOST || image.shape[1] > MOST / 3) a.fail("image", "is too large");
    const bool bytes = target.is(Kind::U8);
    LossArgs<T> args{image.as<T>(),
                     bytes ? nullptr : target.as<T>(),
                     bytes ? target.as<uint8_t>() : nullptr,
                     int32_t(image.shape[0]),
                     int32_t(image.shape[1]),
                     ssim_weight,
                     gradient.as<T>(),
                     nullptr};
    nb::gil_scoped_release release;
    std::array<double, 2> means;
    loss<T>(args, &means[0], &means[1], threads);
    return means;
}

// Vector FMAs per second of one thread: the unit of cost in the benchmarks.
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

// A Python function, kept for the life of the process: native frames may outlive the interpreter's modules.
PyObject *free_memory_function = nullptr;

int64_t free_memory() {
    if (!Py_IsInitialized()) return -1;
    nb::gil_scoped_acquire hold;
    PyObject *found = PyObject_CallNoArgs(free_memory_function);
    const int64_t bytes = found && found != Py_None ? int64_t(PyLong_AsLongLong(found)) : -1;
    Py_XDECREF(found);
    if (!PyErr_Occurred()) return bytes;
    // Out of memory, or the interpreter is shutting down: training continues without the answer. An interrupt ends it.
    if (!PyErr_ExceptionMatches(PyExc_MemoryError) && !PyErr_ExceptionMatches(PyExc_ImportError)) throw nb::python_error();
    PyErr_Clear();
    return -1;
}

}  // namespace

NB_MODULE(_native, m) {
    nb::set_leak_warnings(false);  // objects that Python still holds at exit are freed with the process
    choose_isa(std::getenv("GSPLAT_EDU_ISA"));
    bind_struct<Camera>(m, "Camera", &camera_of);
    bind_struct<Settings>(m, "Settings", &settings_of);
    bind_struct<SceneArrays>(m, "Scene", [](Arguments a) { return SceneArrays(std::move(a)); });
    bind_struct<GradientArrays>(m, "Gradients", [](Arguments a) { return GradientArrays(std::move(a)); });
    bind_struct<AdamArrays>(m, "AdamGroup", [](Arguments a) { return AdamArrays(std::move(a)); });
    bind_struct<ImageArrays>(m, "Images", [](Arguments a) { return ImageArrays(std::move(a)); });
    bind_struct<StatisticArrays>(m, "Statistics", [](Arguments a) { return StatisticArrays(std::move(a)); });
    bind_frame<float>(m, "FrameF32");
    bind_frame<double>(m, "FrameF64");
    bind_volume(m);
    m.def("adam_f32", &adam<float>);
    m.def("adam_f64", &adam<double>);
    m.def("noise_f32", &noise<float>);
    m.def("noise_f64", &noise<double>);
    m.def("recolor_f32", &recolor<float>);
    m.def("recolor_f64", &recolor<double>);
    m.def("recolor_backward_f32", &recolor_backward<float>);
    m.def("recolor_backward_f64", &recolor_backward<double>);
    m.def("loss_f32", &loss_of<float>);
    m.def("loss_f64", &loss_of<double>);
    bind_screen(m);
    bind_surface(m);
    bind_surfels(m);
    m.def("ask_before_large_blocks", [](const nb::object &function) {
        free_memory_function = function.inc_ref().ptr();
        ask_before_large_blocks(&free_memory);
    });
    m.def("isas", &isas);
    m.def("isa", [] { return std::string(isa().name); });
    m.def("choose_isa", [](const std::string &name) { choose_isa(name.c_str()); });
    m.def("fma_rate", &fma_rate);
    m.def("parallel_time", [] { return std::array<double, 2>{parallel_time().seconds, double(parallel_time().calls)}; });
}
