// Running sums, in parallel.
#pragma once

#include <cstdint>

namespace gsplat {

// Replaces every number by the sum of those before it, modulo 2^32; returns the sum of all.
uint64_t exclusive_sums(int threads, int64_t count, uint32_t *numbers);

}  // namespace gsplat
