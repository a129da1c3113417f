// The structures that Python passes to the kernels: camera, settings, scenes, gradients and images, read from checked arguments.
#pragma once

#include <array>
#include <cmath>
#include <limits>
#include <string>

#include "arguments.h"
#include "frame.h"

namespace gsplat {

constexpr int64_t MOST = std::numeric_limits<int32_t>::max();  // of a size
constexpr int64_t MOST_THREADS = 65536;

// A structure that Python has made.
template <class S>
const S &struct_of(Arguments &a, const char *name) {
    const S *found = nullptr;
    if (!nb::try_cast(a.take(name), found, false) || !found) a.fail(name, "has to be the structure of that name");
    return *found;
}

// What follows a pinhole's numbers; of a pinhole at rest, nothing does. Returns the exposure.
inline double read_lens(Arguments &a, Camera &cam) {
    cam.lens = PINHOLE;
    if (!a.has("lens")) return 0;
    std::array<double, 6> motion;
    cam.lens = Lens(a.whole("lens", PERSPECTIVE, ORTHOGRAPHIC));
    a.numbers("coefficients", cam.coefficients, COEFFICIENTS), a.numbers("motion", motion.data(), 6);
    cam.distorted = a.flag("distorted"), cam.radial_first = a.flag("radial_first"), cam.moving = a.flag("moving");
    cam.axis = int32_t(a.whole("axis", 0, 1)), cam.pace = a.number("pace"), cam.widest = a.number("widest");
    const double exposure = a.number("exposure");
    if (!(exposure >= 0 && std::isfinite(exposure))) a.fail("exposure", "has to be finite and at least 0");
    if (cam.distorted && cam.lens > FISHEYE) a.fail("distorted", "has to be false for this lens");
    std::copy_n(motion.data(), 3, cam.turn), std::copy_n(motion.data() + 3, 3, cam.shift);
    for (const double c : cam.coefficients)
        if (!std::isfinite(c)) a.fail("coefficients", "have to be finite");
    for (const double c : motion)
        if (!std::isfinite(c)) a.fail("motion", "has to be finite");
    return exposure;
}

inline Camera camera_of(Arguments a) {
    Camera cam{};
    const Array R = a.array("R", {Kind::F64}, {3, 3}), eye = a.array("eye", {Kind::F64}, {3});
    std::copy_n(R.as<double>(), 9, cam.R);
    std::copy_n(eye.as<double>(), 3, cam.eye);
    cam.fx = a.number("fx"), cam.fy = a.number("fy"), cam.cx = a.number("cx"), cam.cy = a.number("cy");
    std::array<double, 2> x, y;
    a.numbers("x_bounds", x.data(), 2), a.numbers("y_bounds", y.data(), 2);
    if (x[0] > x[1]) a.fail("x_bounds", "have to ascend");
    if (y[0] > y[1]) a.fail("y_bounds", "have to ascend");
    cam.x_low = x[0], cam.x_high = x[1], cam.y_low = y[0], cam.y_high = y[1];
    cam.H = int32_t(a.whole("H", 1, MOST)), cam.W = int32_t(a.whole("W", 1, MOST));
    const int64_t tiles = ((int64_t(cam.H) + TILE - 1) / TILE) * ((int64_t(cam.W) + TILE - 1) / TILE);
    if (tiles > MOST) a.fail("H", "times W is more pixels than can be rendered");
    complete(cam, read_lens(a, cam));
    a.finish();
    return cam;
}

inline Settings settings_of(Arguments a) {
    Settings set{};
    set.z_near = a.number("z_near");
    a.numbers("background", set.background, 3);
    set.sh_degree = int32_t(a.whole("sh_degree", 0, 3));
    set.antialiased = a.flag("antialiased");
    set.dilation = a.number("dilation");
    if (!(set.dilation >= 0 && set.dilation <= DILATION_MAX)) a.fail("dilation", "has to be 0 to 1e6 px²");
    set.dilation2 = set.dilation * set.dilation;
    set.alpha_max = a.number("alpha_max");
    if (set.alpha_max < ALPHA_MIN || set.alpha_max >= 1) a.fail("alpha_max", "has to be at least 1/255 and below 1");
    set.log2_alpha_max = std::log2(set.alpha_max);
    set.pixel_stop = a.flag("pixel_stop");
    a.finish();
    return set;
}

// Arrays with one entry per Gaussian: raw parameters, or covariances, colours and opacities.
struct PerGaussian {
    Array means, quats, log_scales, sh0, sh_rest, logit_opacities, cov3ds, colors, opacities;
    bool direct = false;
    int64_t n = 0, rest = 0;

    PerGaussian(Arguments &a, bool written) : direct(a.has("cov3ds")) {
        means = a.array("means", {Kind::F32, Kind::F64}, {ANY, 3}, written);
        const Kind kind = means.is(Kind::F32) ? Kind::F32 : Kind::F64;
        n = means.shape[0];
        if (direct) {
            cov3ds = a.array("cov3ds", {Kind::F64}, {n, 3, 3}, written);
            colors = a.array("colors", {kind}, {n, 3}, written);
            opacities = a.array("opacities", {kind}, {n}, written);
            return;
        }
        quats = a.array("quats", {kind}, {n, 4}, written);
        log_scales = a.array("log_scales", {kind}, {n, 3}, written);
        sh0 = a.array("sh0", {kind}, {n, 1, 3}, written);
        sh_rest = a.array("sh_rest", {kind}, {n, ANY, 3}, written);
        logit_opacities = a.array("logit_opacities", {kind}, {n}, written);
        rest = sh_rest.shape[1];
        if (rest != 0 && rest != 3 && rest != 8 && rest != 15) a.fail("sh_rest", "has to hold 0, 3, 8 or 15 coefficients per channel");
    }
};

struct SceneArrays : PerGaussian {
    Array order;

    explicit SceneArrays(Arguments a) : PerGaussian(a, false) {
        if (a.has("order")) order = a.array("order", {means.is(Kind::F32) ? Kind::F32 : Kind::F64}, {n});
        a.finish();
    }

    template <class T>
    Scene<T> as() const {
        return {n,
                means.as<T>(),
                quats.as<T>(),
                log_scales.as<T>(),
                sh0.as<T>(),
                sh_rest.as<T>(),
                logit_opacities.as<T>(),
                int32_t(rest),
                cov3ds.as<double>(),
                colors.as<T>(),
                opacities.as<T>(),
                order.as<T>()};
    }
};

struct GradientArrays : PerGaussian {
    Array means2d_norm, background, camera, features;

    explicit GradientArrays(Arguments a) : PerGaussian(a, true) {
        const Kind kind = means.is(Kind::F32) ? Kind::F32 : Kind::F64;
        means2d_norm = a.array("means2d_norm", {kind}, {n}, true);
        background = a.array("background", {kind}, {3}, true);
        camera = a.array_or_none("camera", Kind::F64, {ANY}, true);
        if (camera && camera.shape[0] != CAMERA && camera.shape[0] != LENS_CAMERA)
            a.fail("camera", "has to be of 16 numbers, or of 37 for a lens");
        features = a.array_or_none("features", kind, {n, ANY}, true);
        a.finish();
    }

    template <class T>
    SceneGrads<T> as() const {
        return {means.as<T>(),       quats.as<T>(),  log_scales.as<T>(), sh0.as<T>(),      sh_rest.as<T>(),      logit_opacities.as<T>(),
                cov3ds.as<double>(), colors.as<T>(), opacities.as<T>(),  features.as<T>(), means2d_norm.as<T>(), 0};
    }
};

// The images that a frame draws, or the loss's gradients of them. None means not wanted, or zero.
struct ImageArrays {
    Array image, transmittance, depth, median, features;

    explicit ImageArrays(Arguments a) {
        image = a.array("image", {Kind::F32, Kind::F64}, {ANY, ANY, 3}, true);
        const Kind kind = image.is(Kind::F32) ? Kind::F32 : Kind::F64;
        const int64_t H = image.shape[0], W = image.shape[1];
        transmittance = a.array_or_none("transmittance", kind, {H, W}, true);
        depth = a.array_or_none("depth", kind, {H, W}, true);
        median = a.array_or_none("median", kind, {H, W}, true);
        features = a.array_or_none("features", kind, {H, W, ANY}, true);
        if (features && (channels() < 1 || channels() > MOST_CHANNELS))
            a.fail("features", "has to have 1 to " + std::to_string(MOST_CHANNELS) + " channels");
        a.finish();
    }

    int64_t channels() const { return features ? features.shape[2] : 0; }

    template <class T>
    Images<T> as_outputs() const {
        return {image.as<T>(), transmittance.as<T>(), depth.as<T>(), median.as<T>(), features.as<T>(), int32_t(channels())};
    }
    template <class T>
    ImageGrads<T> as_gradients() const {
        return {image.as<T>(), transmittance.as<T>(), depth.as<T>(), features.as<T>()};
    }
};

// Where a backward pass writes statistics, and the errors that it weighs.
struct StatisticArrays {
    Array values, errors;

    explicit StatisticArrays(Arguments a) {
        values = a.array("values", {Kind::F32, Kind::F64}, {ANY, STATISTICS}, true);
        errors = a.array_or_none("errors", values.is(Kind::F32) ? Kind::F32 : Kind::F64, {ANY, ANY});
        a.finish();
    }
};

inline AdamNumbers adam_numbers(Arguments &a) {
    return {a.number("rate"), a.number("beta1"), a.number("beta2"), a.number("eps"), a.number("correction1"), a.number("correction2")};
}

// A parameter with its moments, for a step of Adam; the gradient is the kernel's own plus `extra`, unless that is None.
struct AdamArrays {
    Array parameter, first, second, extra;
    AdamNumbers numbers;

    explicit AdamArrays(Arguments a) {
        parameter = a.array_of_any_shape("parameter", {Kind::F32, Kind::F64}, true);
        const Kind kind = parameter.is(Kind::F32) ? Kind::F32 : Kind::F64;
        first = a.array("first", {kind}, parameter.shape, true), second = a.array("second", {kind}, parameter.shape, true);
        extra = a.array_or_none("extra", kind, parameter.shape);
        numbers = adam_numbers(a);
        a.finish();
    }

    template <class T>
    AdamArgs<T> as() const {
        return {parameter.as<T>(), first.as<T>(), second.as<T>(), nullptr, extra.as<T>(), numbers};
    }
};

}  // namespace gsplat
