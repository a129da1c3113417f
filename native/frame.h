// One rendered view: its buffers and the order of its stages, from projection to gradients. Kernels do the work.
#pragma once

#include <array>

#include "buffers.h"
#include "kernels.h"

namespace gsplat {

template <class T>
struct Outputs {
    T *image, *transmittance, *depth;  // depth may be null
};

template <class T>
struct ImageGrads {
    const T *image, *transmittance, *depth;  // the last two may be null
};

// Seconds that passed during a stage, processor time of its thread, and the part of it in `parallel`.
struct StageTime {
    double seconds = 0, processor = 0, parallel = 0;
};

template <class T>
class Frame {
  public:
    Frame(const Scene<T> &scene, const Camera &camera, const Settings &settings, int threads);
    void composite(const Outputs<T> &out);
    // The scene and the outputs are passed again: they may have moved between the passes.
    // `camera` gets CAMERA numbers, unless it is null.
    void backward(const Scene<T> &scene, const Outputs<T> &forward, const ImageGrads<T> &in, const SceneGrads<T> &out, T *background,
                  double *camera);
    // The same, but every Gaussian's gradient goes into a step of Adam; `groups` has no gradients.
    void adam(const Scene<T> &scene, const Outputs<T> &forward, const ImageGrads<T> &in, const AdamArgs<T> *groups, T *means2d_norm);

    int64_t num_visible() const { return visible_count_; }
    int64_t num_pairs() const { return pairs_count_; }
    // Of project, sort, intersect, composite, composite_backward and project_backward.
    const std::array<StageTime, 6> &stages() const { return stages_; }
    // Writes the ids of the visible Gaussians, ascending, and the half extents of their ellipses, px.
    void list_visible(int64_t *ids, T *radii) const;

  private:
    const Splat<T> *splats() const { return splats_.as<Splat<T>>(); }
    void project(const Scene<T> &scene);
    void sort();
    void intersect();
    CompositeBackwardArgs<T> composite_backward(const Outputs<T> &forward, const ImageGrads<T> &in, Buffer &slots, Buffer &background);
    ProjectBackwardArgs<T> last_stage(const Scene<T> &scene, const T *slots) const;
    int64_t blocks() const { return (n_ + BLOCK - 1) / BLOCK; }

    int64_t n_;
    Camera camera_;
    Settings settings_;
    Grid grid_;
    int threads_;
    int64_t visible_count_ = 0, pairs_count_ = 0;
    std::array<StageTime, 6> stages_{};
    Buffer splats_, block_ids_, block_begin_, visible_, sorted_, pairs_of_, slot_begin_, pairs_, tile_begin_, done_;
};

}  // namespace gsplat
