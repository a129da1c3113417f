// One rendered view: its buffers, from projection to gradients. Kernels do the work; this decides the order.
#pragma once

#include <array>
#include <memory>

#include "kernels.h"

namespace gsplat {

// The instruction set in use; set once at import, or by name in tests. Throws std::invalid_argument with a reason.
const Isa &isa();
void choose_isa(const char *name);
// Names of those this build has and this machine runs, best last.
int list_isas(const char **names, int capacity);

template <class T>
const Kernels<T> &kernels();

// What is asked before a large block is allocated: the bytes that are free, negative where nobody knows. None at first.
using FreeMemory = int64_t (*)();
void ask_before_large_blocks(FreeMemory free_memory);

// Memory that is kept when its owner goes and handed to the next one that asks, so that frames of changing size do
// not grow the process.
class Buffer {
  public:
    Buffer() = default;
    ~Buffer();
    Buffer(const Buffer &) = delete;
    Buffer &operator=(const Buffer &) = delete;
    // At least `bytes`; what was in it is lost. Throws std::bad_alloc, for a large block also where the system would
    // grant memory that it does not have.
    void *reserve(size_t bytes);
    template <class T>
    T *as() const { return static_cast<T *>(data_); }

  private:
    void *data_ = nullptr;
    size_t capacity_ = 0;
};

template <class T>
struct Outputs {
    T *image, *transmittance, *depth;  // depth may be null
};

template <class T>
struct ImageGrads {
    const T *image, *transmittance, *depth;  // the last two may be null
};

template <class T>
class Frame {
  public:
    Frame(const Scene<T> &scene, const Camera &camera, const Settings &settings, int threads);
    void composite(const Outputs<T> &out);
    // The scene and the outputs are given again: between the passes they may have moved.
    void backward(const Scene<T> &scene, const Outputs<T> &forward, const ImageGrads<T> &in, const SceneGrads<T> &out, T *background);

    int64_t num_visible() const { return visible_count_; }
    int64_t num_pairs() const { return pairs_count_; }
    // Wall seconds of project, sort, intersect, composite, composite_backward and project_backward.
    const std::array<double, 6> &seconds() const { return seconds_; }
    const uint32_t *visible() const { return visible_.as<uint32_t>(); }
    const Splat<T> *splats() const { return splats_.as<Splat<T>>(); }

  private:
    void project(const Scene<T> &scene);
    void sort();
    void intersect();
    int64_t blocks() const { return (n_ + BLOCK - 1) / BLOCK; }

    int64_t n_;
    Camera camera_;
    Settings settings_;
    Grid grid_;
    int threads_;
    int64_t visible_count_ = 0, pairs_count_ = 0;
    std::array<double, 6> seconds_{};
    Buffer splats_, visible_, sorted_, pairs_of_, slot_begin_, pairs_, tile_begin_, done_;
};

// (1 - k) L1 + k (1 - SSIM): the two means, and the gradient to args.grad. Sums and scratch are provided.
template <class T>
void loss(LossArgs<T> args, double *l1, double *ssim, int threads);

}  // namespace gsplat
