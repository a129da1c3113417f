// One rendered view: its buffers and the order of its stages, from projection to gradients. Kernels do the work.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>

#include "buffers.h"
#include "kernels.h"

namespace gsplat {

// Sets what follows from the other numbers of a camera, and from its exposure: the time a row is exposed, by that of the readout.
inline void complete(Camera &camera, double exposure) {
    const double bounds[4] = {camera.x_low, camera.x_high, camera.y_low, camera.y_high};
    camera.bounded = camera.lens == PERSPECTIVE && std::any_of(bounds, bounds + 4, [](double b) { return std::isfinite(b); });
    camera.spread = camera.moving ? exposure / std::sqrt(12.0) : 0.0;
    camera.along_ray = camera.lens == FISHEYE || camera.lens == EQUIRECTANGULAR;
    camera.middle = 0.5 * ((camera.axis == 0 ? camera.W : camera.H) - 1);
}

// Statistics of every Gaussian, in the order of `Statistic`, and the error of every pixel that one of them weighs.
template <class T>
struct Collected {
    T *values;        // N STATISTICS; null if not wanted
    const T *errors;  // H W, or null
};

// What a frame has drawn, and what its backward pass collects on the way.
template <class T>
struct Drawn {
    Images<T> images;
    const T *features;  // N channels; null if images.features is
    Collected<T> collected;
};

// Seconds that passed during a stage, processor time of its thread, and the part of it in `parallel`.
struct StageTime {
    double seconds = 0, processor = 0, parallel = 0;
};

struct SlotBuffers {
    Buffer slots, tile_background, features, statistics;
};

template <class T>
class Frame {
  public:
    // Draws only tiles in which a pixel is needed; `needed` has a byte for each pixel, or is null if all are.
    Frame(const Scene<T> &scene, const Camera &camera, const Settings &settings, const uint8_t *needed, int threads);
    void composite(const Images<T> &out, const T *features);
    // The scene, the images and the features are passed again: they may have moved between the passes.
    // `camera` gets `camera_numbers`, unless it is null.
    void backward(const Scene<T> &scene, const Drawn<T> &drawn, const ImageGrads<T> &in, const SceneGrads<T> &out, T *background,
                  double *camera);
    // The same, but every Gaussian's gradient goes into a step of Adam; `groups` has no gradients.
    void adam(const Scene<T> &scene, const Drawn<T> &drawn, const ImageGrads<T> &in, const AdamArgs<T> *groups, T *means2d_norm);

    int64_t num_visible() const { return visible_count_; }
    int64_t num_pairs() const { return pairs_count_; }
    int64_t num_tiles() const { return grid_.tiles(); }
    // Of project, sort, intersect, composite, composite_backward and project_backward.
    const std::array<StageTime, 6> &stages() const { return stages_; }
    // Writes the ids of the visible Gaussians, ascending, and the half extents of their ellipses, px.
    void list_visible(int64_t *ids, T *radii) const;

    // Writes where each tile's list begins, one number more than tiles, and the ids of the Gaussians in all lists, near to far.
    void list_pairs(int64_t *begin, int64_t *ids) const;

  private:
    const Splat<T> *splats() const { return splats_.as<Splat<T>>(); }
    void project(const Scene<T> &scene);
    void sort(const T *order);
    void intersect(const uint8_t *needed);
    const uint32_t *find_drawn(const uint8_t *needed, Buffer &buffer) const;
    CompositeArgs<T> composite_args(const Images<T> &out, const T *features) const;
    CompositeBackwardArgs<T> composite_backward(const Drawn<T> &drawn, const ImageGrads<T> &in, SlotBuffers &to);
    // Sums the slots of each Gaussian, first to last.
    void sum_features(const T *slots, int32_t channels, T *to) const;
    void sum_statistics(const T *slots, T *to) const;
    ProjectBackwardArgs<T> last_stage(const Scene<T> &scene, const T *slots) const;
    int64_t blocks() const { return (n_ + BLOCK - 1) / BLOCK; }

    int64_t n_;
    Camera camera_;
    Settings settings_;
    Grid grid_;
    int threads_;
    int64_t visible_count_ = 0, pairs_count_ = 0;
    std::array<StageTime, 6> stages_{};
    Buffer splats_, block_ids_, block_begin_, visible_, sorted_, pairs_of_, slot_begin_, pairs_, tile_begin_, done_, rows_;
};

}  // namespace gsplat
