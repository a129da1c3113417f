// The Gaussians of a training with Adam's moments, and what changes their number.
#pragma once

#include <array>
#include <vector>

#include "../native/kernels.h"

namespace gsplat {

// The raw parameters of N Gaussians, or one of Adam's moments of them: an array for each `Group`.
using Parameters = std::array<std::vector<float>, GROUPS>;

// Numbers per Gaussian of each group.
using Widths = std::array<int64_t, GROUPS>;
inline Widths widths_of(int64_t rest) { return {3, 4, 3, 3, 3 * rest, 1}; }

// Splits the Gaussians of the highest score and removes faint ones; survivors keep their moments, and all are sorted along a
// Morton curve. src/gsplat_edu/train/density/fast.py and surgery.py have the same in torch, which works on any device.
struct Change {
    int64_t split = 0, pruned = 0;
};
Change split_and_prune(Parameters &parameters, Parameters &first, Parameters &second, const Widths &widths,
                       const std::vector<float> &scores, double least_opacity, int64_t planned, bool growing);

// The order of N points along a Morton curve, as src/gsplat_edu/scene/morton.py has it.
std::vector<int64_t> order_in_space(const float *points, int64_t count);

// Takes rows by their indices; -1 gives a row of zeros.
std::vector<float> rows_at(const std::vector<float> &from, int64_t width, const std::vector<int64_t> &indices);

// For each of N points the root mean square of the distances to its `count` nearest others.
std::vector<double> spacing(const double *points, int64_t n, int count);

}  // namespace gsplat
