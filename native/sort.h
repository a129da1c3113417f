// The order in which Gaussians are composited.
#pragma once

#include "kernels.h"

namespace gsplat {

// Writes `count` ids to `sorted` by the depths of their splats, which are positive; ids of one depth keep their order.
template <class T>
void sort_by_depth(const Splat<T> *splats, const uint32_t *ids, int64_t count, uint32_t *sorted);

}  // namespace gsplat
