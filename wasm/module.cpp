// The C interface of the WebAssembly module. src/gsplat_edu/tab/web/engine.js is its only caller, and has the same lists of numbers.
//
// Arguments are numbers and addresses in the module's memory. Numbers are checked here; that an address has room for what belongs
// there is the caller's promise.
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <memory>

#include "../native/system.h"
#include "trainer.h"

#define GSPLAT_EXPORT(name) extern "C" __attribute__((export_name(#name)))

namespace gsplat {
namespace {

constexpr double MOST_SIDE = 1 << 16;

double finite(double value, const char *reason) {
    if (!std::isfinite(value)) refuse(reason);
    return value;
}

double between(double value, double least, double most, const char *reason) {
    if (!(value >= least && value <= most)) refuse(reason);
    return value;
}

// The numbers of a camera, in this order; CAMERA_NUMBERS of engine.js names them.
Camera camera_of(const double *numbers) {
    constexpr const char *REASON = "a camera has a number that is not finite or out of range";
    const double *at = numbers;
    const auto next = [&] { return finite(*at++, REASON); };
    Camera cam{};
    for (double &entry : cam.R) entry = next();
    for (double &entry : cam.eye) entry = next();
    cam.fx = next(), cam.fy = next(), cam.cx = next(), cam.cy = next();
    cam.W = int32_t(between(*at++, 1, MOST_SIDE, REASON)), cam.H = int32_t(between(*at++, 1, MOST_SIDE, REASON));
    cam.x_low = *at++, cam.x_high = *at++, cam.y_low = *at++, cam.y_high = *at++;  // may be infinite
    if (!(cam.x_low <= cam.x_high && cam.y_low <= cam.y_high)) refuse(REASON);
    cam.lens = Lens(int32_t(between(*at++, PERSPECTIVE, PINHOLE, REASON)));
    cam.distorted = next() != 0, cam.radial_first = next() != 0, cam.moving = next() != 0;
    cam.axis = int32_t(between(*at++, 0, 1, REASON)), cam.pace = next(), cam.widest = next();
    const double exposure = between(*at++, 0, 1e9, REASON);
    for (double &entry : cam.coefficients) entry = next();
    for (double &entry : cam.turn) entry = next();
    for (double &entry : cam.shift) entry = next();
    complete(cam, exposure);
    return cam;
}

// The numbers of a render: z_near, background, sh_degree, antialiased, dilation, alpha_max, pixel_stop.
Settings settings_of(const double *numbers) {
    constexpr const char *REASON = "a setting of the render is out of range";
    Settings set{};
    set.z_near = finite(numbers[0], REASON);
    for (int c = 0; c < 3; ++c) set.background[c] = finite(numbers[1 + c], REASON);
    set.sh_degree = int32_t(between(numbers[4], 0, 3, REASON)), set.antialiased = numbers[5] != 0;
    set.dilation = between(numbers[6], 0, DILATION_MAX, REASON), set.dilation2 = set.dilation * set.dilation;
    set.alpha_max = between(numbers[7], ALPHA_MIN, 1 - 1e-7, REASON), set.log2_alpha_max = std::log2(set.alpha_max);
    set.pixel_stop = numbers[8] != 0;
    return set;
}

// Addresses of a render's arrays, 0 where there is none; ARRAYS of engine.js names them.
template <class T>
struct Arrays {
    const T *means, *quats, *log_scales, *sh0, *sh_rest, *logit_opacities, *features;
    T *image, *transmittance, *depth, *median, *mixed;
    const T *grad_image, *grad_transmittance, *grad_depth, *grad_mixed;
    T *grad_means, *grad_quats, *grad_log_scales, *grad_sh0, *grad_sh_rest, *grad_logit_opacities, *grad_features;
    T *means2d_norm, *grad_background;
    double *grad_camera;
};

// A view that was drawn.
template <class T>
struct DrawnView {
    int64_t n;
    int32_t rest, channels;
    Frame<T> frame;
};

template <class T>
Scene<T> scene_of(const Arrays<T> &a, int64_t n, int32_t rest) {
    Scene<T> scene{};
    scene.n = n, scene.rest = rest, scene.means = a.means, scene.quats = a.quats, scene.log_scales = a.log_scales;
    scene.sh0 = a.sh0, scene.sh_rest = a.sh_rest, scene.logit_opacities = a.logit_opacities;
    return scene;
}

template <class T>
Images<T> images_of(const Arrays<T> &a, int32_t channels) {
    return {a.image, a.transmittance, a.depth, a.median, a.mixed, channels};
}

template <class T>
void *draw(int32_t n, int32_t rest, int32_t channels, const Arrays<T> *arrays, const double *camera, const double *settings, int threads) {
    constexpr const char *REASON = "the scene has a number of Gaussians, harmonics or features that cannot be rendered";
    const Settings set = settings_of(settings);
    const bool whole = n >= 0 && (rest == 0 || rest == 3 || rest == 8 || rest == 15) && channels >= 0 && channels <= MOST_CHANNELS;
    if (!whole || (set.sh_degree + 1) * (set.sh_degree + 1) - 1 > rest) refuse(REASON);
    auto *view = new DrawnView<T>{n, rest, channels, Frame<T>(scene_of(*arrays, n, rest), camera_of(camera), set, nullptr, threads)};
    view->frame.composite(images_of(*arrays, channels), channels ? arrays->features : nullptr);
    return view;
}

template <class T>
void differentiate(void *drawn, const Arrays<T> *arrays) {
    auto &view = *static_cast<DrawnView<T> *>(drawn);
    const Arrays<T> &a = *arrays;
    const SceneGrads<T> grads{a.grad_means, a.grad_quats, a.grad_log_scales, a.grad_sh0,      a.grad_sh_rest, a.grad_logit_opacities,
                              nullptr,      nullptr,      nullptr,           a.grad_features, a.means2d_norm, 0};
    view.frame.backward(scene_of(a, view.n, view.rest),
                        {images_of(a, view.channels), view.channels ? a.features : nullptr, {nullptr, nullptr}},
                        {a.grad_image, a.grad_transmittance, a.grad_depth, view.channels ? a.grad_mixed : nullptr}, grads,
                        a.grad_background, a.grad_camera);
}

Recipe recipe_of(const double *numbers) {
    Recipe recipe;
    static_assert(sizeof recipe % sizeof(double) == 0);
    constexpr size_t COUNT = sizeof recipe / sizeof(double);
    std::copy_n(numbers, COUNT, reinterpret_cast<double *>(&recipe));
    for (size_t k = 0; k < COUNT; ++k) between(numbers[k], 0, 1e15, "a setting of the training is negative or not finite");
    between(recipe.iterations, 1, 1e9, "a training needs at least one iteration");
    between(recipe.max_gaussians, 1, 1 << 28, "a training needs a largest number of splats, at least 1");
    between(recipe.sh_degree, 0, 3, "the degree of harmonics has to be 0 to 3");
    between(recipe.densify_every, 1, 1e9, "the interval of density control has to be at least 1");
    between(recipe.fast_full_size, 1, 1e9, "photos need an iteration of full size, at least 1");
    between(recipe.fast_start_factor, 1, 1e3, "the photos' first factor has to be at least 1");
    between(recipe.start_opacity, 1e-6, 1 - 1e-6, "the start opacity has to be between 0 and 1");
    return recipe;
}

Trainer &trainer(void *handle) { return *static_cast<Trainer *>(handle); }

}  // namespace
}  // namespace gsplat

using namespace gsplat;

GSPLAT_EXPORT(allocate) void *allocate(size_t bytes) {
    void *found = bytes > SIZE_MAX - 64 ? nullptr : std::aligned_alloc(64, (bytes + 64) / 64 * 64);
    if (!found) refuse("there is not enough memory");
    return found;
}
GSPLAT_EXPORT(release) void release(void *memory) { std::free(memory); }

GSPLAT_EXPORT(draw_f32)
void *draw_f32(int32_t n, int32_t rest, int32_t channels, const Arrays<float> *a, const double *camera, const double *settings,
               int threads) {
    return draw(n, rest, channels, a, camera, settings, threads);
}
GSPLAT_EXPORT(draw_f64)
void *draw_f64(int32_t n, int32_t rest, int32_t channels, const Arrays<double> *a, const double *camera, const double *settings,
               int threads) {
    return draw(n, rest, channels, a, camera, settings, threads);
}
GSPLAT_EXPORT(differentiate_f32) void differentiate_f32(void *drawn, const Arrays<float> *a) { differentiate(drawn, a); }
GSPLAT_EXPORT(differentiate_f64) void differentiate_f64(void *drawn, const Arrays<double> *a) { differentiate(drawn, a); }
GSPLAT_EXPORT(forget_f32) void forget_f32(void *drawn) { delete static_cast<DrawnView<float> *>(drawn); }
GSPLAT_EXPORT(forget_f64) void forget_f64(void *drawn) { delete static_cast<DrawnView<double> *>(drawn); }

GSPLAT_EXPORT(train)
void *train(const double *recipe, double extent, const double *points, const double *colors, int32_t count, int threads) {
    if (count < 1) refuse("there is no point to start from");
    for (int32_t k = 0; k < 3 * count; ++k) finite(points[k], "a start point is not finite"), finite(colors[k], "a colour is not finite");
    if (!(extent > 0 && std::isfinite(extent))) refuse("the size of the scene has to be positive");
    return new Trainer(recipe_of(recipe), extent, points, colors, count, threads);
}
GSPLAT_EXPORT(end_training) void end_training(void *handle) { delete &trainer(handle); }
GSPLAT_EXPORT(add_view) void add_view(void *handle, const double *camera, const uint8_t *photo) {
    const Camera cam = camera_of(camera);
    if (cam.lens != PINHOLE) refuse("photos have to be those of a pinhole; undistort them first");
    trainer(handle).add_view(cam, photo);
}
GSPLAT_EXPORT(step) double step(void *handle) { return trainer(handle).step(); }
GSPLAT_EXPORT(iteration) double iteration(void *handle) { return double(trainer(handle).iteration()); }
GSPLAT_EXPORT(count) int32_t count(void *handle) { return int32_t(trainer(handle).count()); }
GSPLAT_EXPORT(parameter) const float *parameter(void *handle, int32_t group) { return trainer(handle).parameters()[size_t(group)].data(); }
GSPLAT_EXPORT(render) void render(void *handle, const double *camera, float *image, float *transmittance) {
    trainer(handle).render(camera_of(camera), image, transmittance);
}
// Writes the mean squared error, the mean absolute error and the mean SSIM.
GSPLAT_EXPORT(score) void score(void *handle, const double *camera, const uint8_t *photo, double *out) {
    const Score found = trainer(handle).score(camera_of(camera), photo);
    out[0] = found.squared, out[1] = found.absolute, out[2] = found.ssim;
}
// The state as bytes that the caller releases; their number goes to `size`.
GSPLAT_EXPORT(state) uint8_t *state(void *handle, uint32_t *size) {
    const std::vector<uint8_t> bytes = trainer(handle).state();
    auto *copy = static_cast<uint8_t *>(allocate(bytes.size()));
    std::copy(bytes.begin(), bytes.end(), copy);
    *size = uint32_t(bytes.size());
    return copy;
}
GSPLAT_EXPORT(load) void load(void *handle, const uint8_t *bytes, uint32_t size) { trainer(handle).load(bytes, size); }
