// A training with the recipe fast: pinhole views, one a step, Adam in the backward pass.
//
// It takes the steps that src/gsplat_edu/train takes with its defaults, without what photos ask for there (exposure, sky, masks,
// refined cameras). The kernels are the same.
#pragma once

#include <vector>

#include "../native/frame.h"
#include "recipe.h"
#include "scene.h"

namespace gsplat {

// A photo and its camera, without bounds of the Jacobian.
struct View {
    Camera camera;
    std::vector<uint8_t> photo, reduced;  // H W 3; of the size in use, if it is another one
    int32_t W, H;                         // of the size in use
};

// Mean errors of a render against a photo: of the squares, of the absolute values, and the mean SSIM.
struct Score {
    double squared, absolute, ssim;
};

class Trainer {
  public:
    // A ball on each of `count` points of colours from 0 to 1.
    Trainer(const Recipe &recipe, double extent, const double *points, const double *colors, int64_t count, int threads);

    void add_view(const Camera &camera, const uint8_t *photo);
    // Takes one step; returns the loss of its view.
    double step();
    bool done() const { return iteration_ >= int64_t(recipe_.iterations); }
    // H W 3 and H W, with the degree of harmonics in use.
    void render(const Camera &camera, float *image, float *transmittance) const;
    Score score(const Camera &camera, const uint8_t *photo) const;

    int64_t iteration() const { return iteration_; }
    int64_t count() const { return int64_t(parameters_[LOGIT_OPACITIES].size()); }
    const Parameters &parameters() const { return parameters_; }

    // Everything that the steps changed. `load` refuses what another training wrote.
    std::vector<uint8_t> state() const;
    void load(const uint8_t *bytes, size_t size);

  private:
    int64_t rest() const { return widths_[SH_REST] / 3; }
    Scene<float> scene() const;
    Settings settings() const;
    Camera bounded(Camera camera) const;
    int32_t degree() const;
    double rate(double base) const;
    double means_rate() const;
    double photo_factor() const;
    void use_factor(double factor);
    View &next_view();
    std::vector<float> opacity_gradient(const Frame<float> &frame) const;
    void observe(const Frame<float> &frame, const std::vector<float> &norms);
    void change();
    uint64_t digest() const;

    Recipe recipe_;
    double extent_;
    int threads_;
    Widths widths_;
    Parameters parameters_, first_, second_;
    std::vector<float> norm_sums_, times_visible_;
    std::vector<View> views_;
    std::vector<uint32_t> queue_;
    uint64_t draws_ = 0;
    int64_t iteration_ = 0, start_count_ = 0;
    double factor_ = 1;
};

}  // namespace gsplat
