// The order in which Gaussians are composited.
#pragma once

#include "kernels.h"

namespace gsplat {

// Writes `count` ids to `sorted`, ordered by the positive depths of their splats; ids of equal depth keep their order.
template <class T>
void sort_by_depth(const Splat<T> *splats, const uint32_t *ids, int64_t count, uint32_t *sorted);

}  // namespace gsplat
