#include "scene.h"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace gsplat {
namespace {

constexpr double OUTSIDE = 0.01, FARTHEST = 1e30;  // as in src/gsplat_edu/scene/morton.py
constexpr int64_t SAMPLE = 4096;

// The quantile of sorted numbers, linear between them.
double quantile(const std::vector<double> &sorted, double share) {
    const double place = share * double(sorted.size() - 1), below = std::floor(place), t = place - below;
    const double a = sorted[size_t(below)], b = sorted[std::min(size_t(below) + 1, sorted.size() - 1)];
    return t < 0.5 ? a + (b - a) * t : b - (b - a) * (1 - t);
}

// Two zeros behind each of the 16 bits.
uint64_t spread_bits(uint64_t bits) {
    bits = (bits | bits << 16) & 0x0000FF0000FFull;
    bits = (bits | bits << 8) & 0x00F00F00F00Full;
    bits = (bits | bits << 4) & 0x0C30C30C30C3ull;
    return (bits | bits << 2) & 0x249249249249ull;
}

bool finite_row(const Parameters &parameters, const Widths &widths, int64_t row) {
    for (int g = 0; g < GROUPS; ++g)
        for (int64_t k = row * widths[g]; k < (row + 1) * widths[g]; ++k)
            if (!std::isfinite(parameters[g][size_t(k)])) return false;
    return true;
}

// The children of one Gaussian, on the positive and on the negative side of its longest axis:
//     mean' = mean +- s e / sqrt 2,   s' = s / sqrt 2,   o' = 1 - (1 - o)^(1 / sqrt 2)
struct Children {
    float offset[3], log_scale, logit;
    int axis;
};

Children children_of(const Parameters &parameters, int64_t row) {
    const float *logs = &parameters[LOG_SCALES][size_t(3 * row)], *q = &parameters[QUATS][size_t(4 * row)];
    Children made{};
    made.axis = int(std::max_element(logs, logs + 3) - logs);
    const double w = q[0], x = q[1], y = q[2], z = q[3], k = 2 / (w * w + x * x + y * y + z * z);
    const double columns[3][3] = {{1 - k * (y * y + z * z), k * (x * y + w * z), k * (x * z - w * y)},
                                  {k * (x * y - w * z), 1 - k * (x * x + z * z), k * (y * z + w * x)},
                                  {k * (x * z + w * y), k * (y * z - w * x), 1 - k * (x * x + y * y)}};
    const double distance = std::sqrt(0.5) * std::exp(double(logs[made.axis]));
    for (int c = 0; c < 3; ++c) made.offset[c] = float(distance * columns[made.axis][c]);
    made.log_scale = float(logs[made.axis] - 0.5 * std::log(2.0));
    // log(1 - o') = log(1 - o) / sqrt 2, without cancellation for faint or nearly opaque parents
    const double logit = parameters[LOGIT_OPACITIES][size_t(row)];
    const double softplus = std::max(logit, 0.0) + std::log1p(std::exp(-std::fabs(logit)));
    const double log_rest = -std::sqrt(0.5) * softplus;
    made.logit = float(std::log(-std::expm1(log_rest)) - log_rest);
    return made;
}

}  // namespace

std::vector<float> rows_at(const std::vector<float> &from, int64_t width, const std::vector<int64_t> &indices) {
    std::vector<float> rows(indices.size() * size_t(width), 0.0f);
    for (size_t k = 0; k < indices.size(); ++k)
        if (indices[k] >= 0) std::copy_n(from.begin() + indices[k] * width, width, rows.begin() + int64_t(k) * width);
    return rows;
}

std::vector<int64_t> order_in_space(const float *points, int64_t count) {
    std::vector<int64_t> order(static_cast<size_t>(count));
    std::iota(order.begin(), order.end(), int64_t(0));
    if (!count) return order;
    const auto coordinate = [&](int64_t i, int axis) {
        const double value = points[3 * i + axis];
        return std::isnan(value) ? 0.0 : std::clamp(value, -FARTHEST, FARTHEST);
    };
    double low[3], size = 1 / FARTHEST;
    for (int axis = 0; axis < 3; ++axis) {
        std::vector<double> some;
        for (int64_t i = 0; i < count; i += 1 + count / SAMPLE) some.push_back(coordinate(i, axis));
        std::sort(some.begin(), some.end());
        low[axis] = quantile(some, OUTSIDE);
        size = std::max(size, quantile(some, 1 - OUTSIDE) - low[axis]);
    }
    std::vector<uint64_t> codes(static_cast<size_t>(count), 0);
    for (int64_t i = 0; i < count; ++i)
        for (int axis = 0; axis < 3; ++axis) {
            const double cell = std::clamp((coordinate(i, axis) - low[axis]) / size, 0.0, 1.0) * 65535;
            codes[size_t(i)] |= spread_bits(uint64_t(cell)) << axis;
        }
    std::stable_sort(order.begin(), order.end(), [&](int64_t a, int64_t b) { return codes[size_t(a)] < codes[size_t(b)]; });
    return order;
}

Change split_and_prune(Parameters &parameters, Parameters &first, Parameters &second, const Widths &widths,
                       const std::vector<float> &scores, double least_opacity, int64_t planned, bool growing) {
    const int64_t n = int64_t(scores.size());
    std::vector<uint8_t> keep(scores.size());
    int64_t kept = 0;
    for (int64_t i = 0; i < n; ++i) {
        const double opacity = 1 / (1 + std::exp(-double(parameters[LOGIT_OPACITIES][size_t(i)])));
        keep[size_t(i)] = finite_row(parameters, widths, i) && float(opacity) >= float(least_opacity);
        kept += keep[size_t(i)];
    }
    // The highest scores, of equal ones the first.
    std::vector<int64_t> candidates;
    for (int64_t i = 0; i < n; ++i)
        if (keep[size_t(i)] && scores[size_t(i)] > 0) candidates.push_back(i);
    const int64_t room = growing ? std::clamp<int64_t>(planned - kept, 0, int64_t(candidates.size())) : 0;
    std::stable_sort(candidates.begin(), candidates.end(), [&](int64_t a, int64_t b) { return scores[size_t(a)] > scores[size_t(b)]; });
    candidates.resize(size_t(room));
    std::sort(candidates.begin(), candidates.end());
    std::vector<int64_t> sources, origins;  // the row that a new one copies; the row whose moments it keeps
    for (const int64_t i : candidates) keep[size_t(i)] = 0;
    for (int64_t i = 0; i < n; ++i)
        if (keep[size_t(i)]) sources.push_back(i), origins.push_back(i);
    const int64_t survivors = int64_t(sources.size());
    for (int side = 0; side < 2; ++side) {
        sources.insert(sources.end(), candidates.begin(), candidates.end());
        origins.insert(origins.end(), candidates.size(), -1);
    }
    Parameters changed;
    for (int g = 0; g < GROUPS; ++g) changed[g] = rows_at(parameters[g], widths[g], sources);
    for (size_t k = 0; k < candidates.size(); ++k) {
        const Children made = children_of(parameters, candidates[k]);
        for (int side = 0; side < 2; ++side) {
            const size_t row = size_t(survivors) + size_t(side) * candidates.size() + k;
            for (int c = 0; c < 3; ++c) changed[MEANS][3 * row + size_t(c)] += side ? -made.offset[c] : made.offset[c];
            changed[LOG_SCALES][3 * row + size_t(made.axis)] = made.log_scale;
            changed[LOGIT_OPACITIES][row] = made.logit;
        }
    }
    const std::vector<int64_t> order = order_in_space(changed[MEANS].data(), int64_t(sources.size()));
    std::vector<int64_t> moved(order.size());
    for (size_t k = 0; k < order.size(); ++k) moved[k] = origins[size_t(order[k])];
    for (int g = 0; g < GROUPS; ++g) {
        parameters[g] = rows_at(changed[g], widths[g], order);
        changed[g] = {};
        first[g] = rows_at(first[g], widths[g], moved), second[g] = rows_at(second[g], widths[g], moved);
    }
    return {room, n - kept};
}

namespace {

// Points by halves: `order` from `begin` to `end` is a leaf, or its middle splits the longest side of the box.
class Tree {
  public:
    Tree(const double *points, int64_t n) : points_(points), order_(static_cast<size_t>(n)), axes_(static_cast<size_t>(n)) {
        std::iota(order_.begin(), order_.end(), int64_t(0));
        build(0, n);
    }

    // Squared distances of the points nearest to one of them, itself included, in ascending order.
    void nearest(int64_t point, std::vector<double> &found) const {
        std::fill(found.begin(), found.end(), INFINITY);
        search(points_ + 3 * point, 0, int64_t(order_.size()), found);
    }

  private:
    static constexpr int64_t LEAF = 12;

    void build(int64_t begin, int64_t end) {
        if (end - begin <= LEAF) return;
        double low[3] = {INFINITY, INFINITY, INFINITY}, high[3] = {-INFINITY, -INFINITY, -INFINITY};
        for (int64_t k = begin; k < end; ++k)
            for (int axis = 0; axis < 3; ++axis) {
                const double value = points_[3 * order_[size_t(k)] + axis];
                low[axis] = std::min(low[axis], value), high[axis] = std::max(high[axis], value);
            }
        int axis = 0;
        for (int c = 1; c < 3; ++c)
            if (high[c] - low[c] > high[axis] - low[axis]) axis = c;
        const int64_t middle = (begin + end) / 2;
        std::nth_element(order_.begin() + begin, order_.begin() + middle, order_.begin() + end,
                         [&](int64_t a, int64_t b) { return points_[3 * a + axis] < points_[3 * b + axis]; });
        axes_[size_t(middle)] = axis;
        build(begin, middle), build(middle + 1, end);
    }

    void take(const double *at, int64_t k, std::vector<double> &found) const {
        const double *p = points_ + 3 * order_[size_t(k)];
        double distance = 0;
        for (int c = 0; c < 3; ++c) distance += (p[c] - at[c]) * (p[c] - at[c]);
        if (distance >= found.back()) return;
        found.back() = distance;
        for (size_t i = found.size() - 1; i > 0 && found[i] < found[i - 1]; --i) std::swap(found[i], found[i - 1]);
    }

    void search(const double *at, int64_t begin, int64_t end, std::vector<double> &found) const {
        if (end - begin <= LEAF) {
            for (int64_t k = begin; k < end; ++k) take(at, k, found);
            return;
        }
        const int64_t middle = (begin + end) / 2;
        const int axis = axes_[size_t(middle)];
        const double side = at[axis] - points_[3 * order_[size_t(middle)] + axis];
        side < 0 ? search(at, begin, middle, found) : search(at, middle + 1, end, found);
        take(at, middle, found);
        if (side * side < found.back()) side < 0 ? search(at, middle + 1, end, found) : search(at, begin, middle, found);
    }

    const double *points_;
    std::vector<int64_t> order_;
    std::vector<int> axes_;
};

}  // namespace

std::vector<double> spacing(const double *points, int64_t n, int count) {
    const Tree tree(points, n);
    std::vector<double> result(static_cast<size_t>(n)), found(size_t(std::min<int64_t>(count + 1, n)));
    for (int64_t i = 0; i < n; ++i) {
        tree.nearest(i, found);
        result[size_t(i)] = std::sqrt(std::accumulate(found.begin() + 1, found.end(), 0.0) / double(found.size() - 1));
    }
    return result;
}

}  // namespace gsplat
