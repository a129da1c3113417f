#include "trainer.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <numeric>

#include "../native/loss.h"
#include "../native/system.h"

namespace gsplat {
namespace {

// The k-th number that a seed gives (Steele et al. 2014, SplitMix64).
uint64_t random_bits(uint64_t seed, uint64_t k) {
    uint64_t z = seed * 0xD1342543DE82EF95ull + (k + 1) * 0x9E3779B97F4A7C15ull;
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9ull;
    z = (z ^ z >> 27) * 0x94D049BB133111EBull;
    return z ^ z >> 31;
}

// A whole number below `count`, which is below 2^32.
uint32_t random_below(uint64_t seed, uint64_t k, uint64_t count) { return uint32_t((random_bits(seed, k) >> 32) * count >> 32); }

// The camera of the same photo at another size; pixel centres are whole numbers.
Camera resized(Camera camera, int32_t W, int32_t H) {
    const double x = double(W) / camera.W, y = double(H) / camera.H;
    camera.fx *= x, camera.cx = (camera.cx + 0.5) * x - 0.5, camera.fy *= y, camera.cy = (camera.cy + 0.5) * y - 0.5;
    camera.W = W, camera.H = H;
    return camera;
}

// What one pixel of a smaller image covers of the larger one, along one side.
struct Cover {
    int32_t first, count;
    double weights[2], inner;  // of the first and the last pixel, and of those between; they sum to 1
};

std::vector<Cover> covers(int32_t large, int32_t small) {
    std::vector<Cover> list(static_cast<size_t>(small));
    const double step = double(large) / small;
    for (int32_t k = 0; k < small; ++k) {
        const double begin = k * step, end = std::min((k + 1) * step, double(large));
        const int32_t first = int32_t(begin), last = std::min(int32_t(std::ceil(end)) - 1, large - 1);
        list[size_t(k)] = {first, last - first + 1, {(std::min(first + 1.0, end) - begin) / step, (end - last) / step}, 1 / step};
    }
    return list;
}

// A photo at a smaller size: each pixel is the mean of the area it covers, rounded.
std::vector<uint8_t> area_mean(const std::vector<uint8_t> &photo, int32_t W, int32_t H, int32_t w, int32_t h) {
    std::vector<uint8_t> small(size_t(w) * size_t(h) * 3);
    const std::vector<Cover> across = covers(W, w), down = covers(H, h);
    std::vector<double> row(size_t(W) * 3);
    const auto weight = [](const Cover &cover, int32_t k) {
        return k == 0 ? cover.weights[0] : k == cover.count - 1 ? cover.weights[1] : cover.inner;
    };
    for (int32_t y = 0; y < h; ++y) {
        std::fill(row.begin(), row.end(), 0.0);
        for (int32_t k = 0; k < down[size_t(y)].count; ++k) {
            const uint8_t *from = photo.data() + size_t(down[size_t(y)].first + k) * size_t(W) * 3;
            const double share = weight(down[size_t(y)], k);
            for (size_t i = 0; i < row.size(); ++i) row[i] += share * from[i];
        }
        for (int32_t x = 0; x < w; ++x) {
            const Cover &cover = across[size_t(x)];
            for (int c = 0; c < 3; ++c) {
                double sum = 0;
                for (int32_t k = 0; k < cover.count; ++k) sum += weight(cover, k) * row[size_t(cover.first + k) * 3 + size_t(c)];
                small[(size_t(y) * size_t(w) + size_t(x)) * 3 + size_t(c)] = uint8_t(std::clamp(std::floor(sum + 0.5), 0.0, 255.0));
            }
        }
    }
    return small;
}

// The images of a render, and the gradient of a loss in them.
struct Rendered {
    std::vector<float> image, transmittance, gradient;
    explicit Rendered(const Camera &camera)
        : image(3 * size_t(camera.W) * size_t(camera.H)), transmittance(image.size() / 3), gradient(image.size()) {}
    Images<float> images() { return {image.data(), transmittance.data(), nullptr, nullptr, nullptr, 0}; }
};

void hash(uint64_t &digest, const void *bytes, size_t count) {  // FNV-1a
    const auto *at = static_cast<const uint8_t *>(bytes);
    for (size_t i = 0; i < count; ++i) digest = (digest ^ at[i]) * 0x100000001B3ull;
}

// The numbers at the beginning of a state.
struct Header {
    char magic[8];
    uint64_t digest, draws;
    int64_t iteration, start_count, count, queued;
};
constexpr char MAGIC[8] = {'g', 's', 't', 'a', 'b', '0', '0', '1'};

}  // namespace

Trainer::Trainer(const Recipe &recipe, double extent, const double *points, const double *colors, int64_t count, int threads)
    : recipe_(recipe), extent_(extent), threads_(threads) {
    const int64_t degree = int64_t(recipe.sh_degree);
    widths_ = widths_of((degree + 1) * (degree + 1) - 1);
    std::vector<int64_t> chosen(static_cast<size_t>(count));
    std::iota(chosen.begin(), chosen.end(), int64_t(0));
    const int64_t cap = int64_t(recipe.max_gaussians), n = std::min(count, cap);
    if (count > cap) {  // a random subset, in its old order
        for (int64_t k = 0; k < n; ++k)
            std::swap(chosen[size_t(k)], chosen[size_t(k + random_below(uint64_t(recipe.seed) ^ 0xCAB, uint64_t(k), uint64_t(count - k)))]);
        chosen.resize(size_t(n));
        std::sort(chosen.begin(), chosen.end());
    }
    std::vector<double> kept;
    for (const int64_t i : chosen) kept.insert(kept.end(), points + 3 * i, points + 3 * i + 3);
    const std::vector<double> scales = n > 1 ? spacing(kept.data(), n, int(NEIGHBOURS)) : std::vector<double>(size_t(n), START_SCALE);
    for (int g = 0; g < GROUPS; ++g) parameters_[g].assign(size_t(n * widths_[g]), 0.0f);
    const float logit = float(std::log(recipe.start_opacity / (1 - recipe.start_opacity)));
    for (int64_t k = 0; k < n; ++k) {
        for (int c = 0; c < 3; ++c) {
            const size_t at = size_t(3 * k + c);
            parameters_[MEANS][at] = float(kept[at]);
            parameters_[LOG_SCALES][at] = float(std::log(recipe.start_scale * std::max(scales[size_t(k)], SMALLEST_DISTANCE)));
            parameters_[SH0][at] = float((colors[3 * chosen[size_t(k)] + c] - SH_OFFSET) / C0);
        }
        parameters_[QUATS][size_t(4 * k)] = 1;
        parameters_[LOGIT_OPACITIES][size_t(k)] = logit;
    }
    const std::vector<int64_t> order = order_in_space(parameters_[MEANS].data(), n);
    for (int g = 0; g < GROUPS; ++g) {
        parameters_[g] = rows_at(parameters_[g], widths_[g], order);
        first_[g].assign(parameters_[g].size(), 0.0f), second_[g].assign(parameters_[g].size(), 0.0f);
    }
    norm_sums_.assign(size_t(n), 0.0f), times_visible_.assign(size_t(n), 0.0f);
    start_count_ = n;
}

void Trainer::add_view(const Camera &camera, const uint8_t *photo) {
    const size_t size = size_t(camera.W) * size_t(camera.H) * 3;
    views_.push_back({camera, std::vector<uint8_t>(photo, photo + size), {}, camera.W, camera.H});
}

Scene<float> Trainer::scene() const {
    Scene<float> scene{};
    scene.n = count(), scene.rest = int32_t(rest());
    scene.means = parameters_[MEANS].data(), scene.quats = parameters_[QUATS].data(), scene.log_scales = parameters_[LOG_SCALES].data();
    scene.sh0 = parameters_[SH0].data(), scene.sh_rest = parameters_[SH_REST].data();
    scene.logit_opacities = parameters_[LOGIT_OPACITIES].data();
    return scene;
}

int32_t Trainer::degree() const {
    if (recipe_.sh_every == 0) return int32_t(recipe_.sh_degree);
    return int32_t(std::min<int64_t>(int64_t(recipe_.sh_degree), iteration_ / int64_t(recipe_.sh_every)));
}

Settings Trainer::settings() const {
    Settings set{};
    set.z_near = Z_NEAR;
    std::copy_n(recipe_.background, 3, set.background);
    set.sh_degree = degree();
    set.dilation = DILATION, set.dilation2 = DILATION * DILATION;
    set.alpha_max = ALPHA_MAX, set.log2_alpha_max = LOG2_ALPHA_MAX;
    return set;
}

// With the bounds of `Camera.jacobian_bounds`.
Camera Trainer::bounded(Camera camera) const {
    const double limit = recipe_.jacobian_limit;
    const auto bound = [](int32_t size, double middle, double focal, double side) {
        return (0.5 * (size - 1) + 0.5 * side * size - middle) / focal;
    };
    camera.x_low = bound(camera.W, camera.cx, camera.fx, -limit), camera.x_high = bound(camera.W, camera.cx, camera.fx, limit);
    camera.y_low = bound(camera.H, camera.cy, camera.fy, -limit), camera.y_high = bound(camera.H, camera.cy, camera.fy, limit);
    return camera;
}

// As `means_rate` and `decayed_rate` of src/gsplat_edu/train/schedule.py.
double Trainer::means_rate() const {
    const double start = recipe_.means_rate, end = recipe_.means_rate_final;
    if (start == end || start == 0) return extent_ * start;
    return extent_ * start * std::pow(end / start, std::min(double(iteration_) / recipe_.means_rate_iterations, 1.0));
}

double Trainer::rate(double base) const {
    if (double(iteration_) <= recipe_.fast_decay_start) return base;
    const double window = std::max(recipe_.means_rate_iterations - recipe_.fast_decay_start, 1.0);
    return base * std::pow(recipe_.fast_decay, std::min((double(iteration_) - recipe_.fast_decay_start) / window, 1.0));
}

double Trainer::photo_factor() const {
    const double start = recipe_.fast_start_factor;
    const int64_t full_size = int64_t(recipe_.fast_full_size);
    if (iteration_ >= full_size) return 1;
    const int64_t steps = int64_t(std::ceil(2 * std::log2(start) - 1e-9));
    return std::max(start * std::pow(0.5, double(steps * iteration_ / full_size) / 2), 1.0);
}

// Gives all views the size of the factor; photos of another size are made when they are first used.
void Trainer::use_factor(double factor) {
    int32_t shortest = INT32_MAX;
    for (const View &view : views_) shortest = std::min({shortest, view.camera.W, view.camera.H});
    factor = std::max(std::min(factor, shortest / SMALLEST_SIDE), 1.0);
    if (factor == factor_) return;
    factor_ = factor;
    for (View &view : views_) {
        view.reduced = {};
        view.W = std::max(1, int32_t(std::nearbyint(view.camera.W / factor))),
        view.H = std::max(1, int32_t(std::nearbyint(view.camera.H / factor)));
    }
}

// Each view once before any is shown again.
View &Trainer::next_view() {
    if (queue_.empty()) {
        queue_.resize(views_.size());
        std::iota(queue_.begin(), queue_.end(), 0u);
        for (size_t k = queue_.size(); k > 1; --k) std::swap(queue_[k - 1], queue_[random_below(uint64_t(recipe_.seed), draws_++, k)]);
    }
    View &view = views_[queue_.back()];
    queue_.pop_back();
    if (view.reduced.empty() && (view.W != view.camera.W || view.H != view.camera.H))
        view.reduced = area_mean(view.photo, view.camera.W, view.camera.H, view.W, view.H);
    return view;
}

// The gradient in the logits of weight times the mean opacity: of all, or of the visible ones if they are few.
std::vector<float> Trainer::opacity_gradient(const Frame<float> &frame) const {
    if (double(iteration_) >= recipe_.fast_stop) return {};
    const std::vector<float> &logits = parameters_[LOGIT_OPACITIES];
    std::vector<float> gradient(logits.size(), 0.0f);
    const auto of = [&](size_t i, double among) {
        const double opacity = 1 / (1 + std::exp(-double(logits[i])));
        gradient[i] = float(recipe_.fast_opacity_weight * opacity * (1 - opacity) / among);
    };
    const int64_t visible = frame.num_visible();
    if (double(visible) >= FEW_VISIBLE * double(logits.size())) {
        for (size_t i = 0; i < logits.size(); ++i) of(i, double(logits.size()));
        return gradient;
    }
    std::vector<int64_t> ids(static_cast<size_t>(visible));
    std::vector<float> radii(2 * ids.size());
    frame.list_visible(ids.data(), radii.data());
    for (const int64_t id : ids) of(size_t(id), double(std::max<int64_t>(visible, 1)));
    return gradient;
}

double Trainer::step() {
    use_factor(photo_factor());
    const View &view = next_view();
    const Camera camera = bounded(resized(view.camera, view.W, view.H));
    Frame<float> frame(scene(), camera, settings(), nullptr, threads_);
    Rendered rendered(camera);
    frame.composite(rendered.images(), nullptr);
    LossArgs<float> args{};
    args.image = rendered.image.data(), args.target_bytes = (view.reduced.empty() ? view.photo : view.reduced).data();
    args.H = camera.H, args.W = camera.W, args.ssim_weight = recipe_.ssim_weight, args.grad = rendered.gradient.data();
    double l1, ssim;
    loss<float>(args, &l1, &ssim, threads_);
    const std::vector<float> extra = opacity_gradient(frame);
    const double rates[GROUPS] = {means_rate(),           rate(recipe_.quats_rate),   rate(recipe_.scales_rate),
                                  rate(recipe_.sh0_rate), rate(recipe_.sh_rest_rate), rate(recipe_.opacities_rate)};
    constexpr double BETA1 = 0.9, BETA2 = 0.999;
    const double steps = double(iteration_ + 1);
    AdamArgs<float> groups[GROUPS];
    for (int g = 0; g < GROUPS; ++g)
        groups[g] = {parameters_[g].data(),
                     first_[g].data(),
                     second_[g].data(),
                     nullptr,
                     nullptr,
                     {rates[g], BETA1, BETA2, recipe_.adam_eps, 1 - std::pow(BETA1, steps), 1 - std::pow(BETA2, steps)}};
    groups[LOGIT_OPACITIES].extra = extra.empty() ? nullptr : extra.data();
    std::vector<float> norms(static_cast<size_t>(count()));
    const Drawn<float> drawn{rendered.images(), nullptr, {nullptr, nullptr}};
    frame.adam(scene(), drawn, {rendered.gradient.data(), nullptr, nullptr, nullptr}, groups, norms.data());
    observe(frame, norms);
    change();
    ++iteration_;
    return (1 - recipe_.ssim_weight) * l1 + recipe_.ssim_weight * (1 - ssim);
}

void Trainer::observe(const Frame<float> &frame, const std::vector<float> &norms) {
    if (double(iteration_ - 1) >= recipe_.fast_stop) return;
    std::vector<int64_t> ids(static_cast<size_t>(frame.num_visible()));
    std::vector<float> radii(2 * ids.size());
    frame.list_visible(ids.data(), radii.data());
    for (const int64_t id : ids) norm_sums_[size_t(id)] += norms[size_t(id)], times_visible_[size_t(id)] += 1;
}

// As `PlannedDensity.update` of src/gsplat_edu/train/density/fast.py.
void Trainer::change() {
    if (iteration_ % int64_t(recipe_.densify_every) || double(iteration_) <= recipe_.densify_start) return;
    const bool growing = double(iteration_) <= recipe_.fast_stop;
    const double least = growing ? recipe_.min_opacity : std::min(recipe_.min_opacity, ALPHA_MIN);
    const double window = std::max(recipe_.fast_stop - recipe_.densify_start, 1.0);
    const double t = std::clamp((double(iteration_) - recipe_.densify_start) / window, 0.0, 1.0);
    const double planned = double(start_count_) + (recipe_.max_gaussians - double(start_count_)) * t;
    std::vector<float> scores(norm_sums_.size());
    for (size_t i = 0; i < scores.size(); ++i) scores[i] = norm_sums_[i] / std::max(times_visible_[i], 1.0f);
    split_and_prune(parameters_, first_, second_, widths_, scores, least, int64_t(std::nearbyint(planned)), growing);
    norm_sums_.assign(size_t(count()), 0.0f), times_visible_.assign(size_t(count()), 0.0f);
}

void Trainer::render(const Camera &camera, float *image, float *transmittance) const {
    Frame<float> frame(scene(), bounded(camera), settings(), nullptr, threads_);
    frame.composite({image, transmittance, nullptr, nullptr, nullptr, 0}, nullptr);
}

Score Trainer::score(const Camera &camera, const uint8_t *photo) const {
    Rendered rendered(camera);
    render(camera, rendered.image.data(), rendered.transmittance.data());
    Score score{};
    for (size_t i = 0; i < rendered.image.size(); ++i) {
        float &value = rendered.image[i];
        value = std::clamp(value, 0.0f, 1.0f);
        const double error = double(value) - photo[i] / 255.0;
        score.squared += error * error;
    }
    score.squared /= double(rendered.image.size());
    LossArgs<float> args{};
    args.image = rendered.image.data(), args.target_bytes = photo, args.H = camera.H, args.W = camera.W;
    args.ssim_weight = recipe_.ssim_weight, args.grad = rendered.gradient.data();
    loss<float>(args, &score.absolute, &score.ssim, threads_);
    return score;
}

uint64_t Trainer::digest() const {
    uint64_t digest = 0xCBF29CE484222325ull;
    hash(digest, &recipe_, sizeof recipe_), hash(digest, &extent_, sizeof extent_);
    for (const View &view : views_) {
        hash(digest, view.camera.R, sizeof view.camera.R), hash(digest, view.camera.eye, sizeof view.camera.eye);
        hash(digest, view.photo.data(), view.photo.size());
    }
    return digest;
}

std::vector<uint8_t> Trainer::state() const {
    Header header{{}, digest(), draws_, iteration_, start_count_, count(), int64_t(queue_.size())};
    std::memcpy(header.magic, MAGIC, sizeof MAGIC);
    std::vector<uint8_t> bytes;
    const auto add = [&](const void *from, size_t size) {
        const auto *at = static_cast<const uint8_t *>(from);
        bytes.insert(bytes.end(), at, at + size);
    };
    add(&header, sizeof header), add(queue_.data(), queue_.size() * sizeof(uint32_t));
    for (const Parameters *arrays : {&parameters_, &first_, &second_})
        for (const std::vector<float> &array : *arrays) add(array.data(), array.size() * sizeof(float));
    for (const std::vector<float> *array : {&norm_sums_, &times_visible_}) add(array->data(), array->size() * sizeof(float));
    return bytes;
}

void Trainer::load(const uint8_t *bytes, size_t size) {
    Header header;
    if (size < sizeof header) refuse("the saved state is incomplete");
    std::memcpy(&header, bytes, sizeof header);
    if (std::memcmp(header.magic, MAGIC, sizeof MAGIC)) refuse("the saved state was written by another version");
    if (header.digest != digest()) refuse("the saved state belongs to other photos or settings");
    const int64_t numbers = std::accumulate(widths_.begin(), widths_.end(), int64_t(0));
    const bool plausible = header.count >= 1 && header.count <= int64_t(recipe_.max_gaussians) && header.queued >= 0 &&
                           header.queued <= int64_t(views_.size()) && header.iteration >= 0;
    if (!plausible || size != sizeof header + size_t(header.queued) * 4 + size_t(header.count) * size_t(3 * numbers + 2) * 4)
        refuse("the saved state is damaged");
    bytes += sizeof header;
    std::vector<uint32_t> queue(size_t(header.queued));
    std::memcpy(queue.data(), bytes, queue.size() * 4), bytes += queue.size() * 4;
    if (std::any_of(queue.begin(), queue.end(), [&](uint32_t view) { return view >= views_.size(); })) refuse("the saved state is damaged");
    const auto take = [&](std::vector<float> &array, int64_t width) {
        array.resize(size_t(header.count * width));
        std::memcpy(array.data(), bytes, array.size() * sizeof(float)), bytes += array.size() * sizeof(float);
    };
    for (Parameters *arrays : {&parameters_, &first_, &second_})
        for (int g = 0; g < GROUPS; ++g) take((*arrays)[g], widths_[g]);
    take(norm_sums_, 1), take(times_visible_, 1);
    queue_ = std::move(queue), draws_ = header.draws, iteration_ = header.iteration, start_count_ = header.start_count;
}

}  // namespace gsplat
