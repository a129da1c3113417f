// The order in which Gaussians are composited.
#pragma once

#include <cstdint>
#include <type_traits>

namespace gsplat {

// A Gaussian and its depth, as an integer of the same order: the bits of a positive float.
template <class T>
struct DepthKey {
    std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t> key;
    uint32_t id;
};

// Writes the ids to `sorted` in the order of their keys; equal keys keep their order. Overwrites `keys`.
template <class T>
void sort_by_depth(int threads, int64_t count, DepthKey<T> *keys, uint32_t *sorted);

}  // namespace gsplat
