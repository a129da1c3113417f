// Made by tools/generate_recipe.py from src/gsplat_edu/train. Do not edit.
// clang-format off
#pragma once

namespace gsplat {

// The settings of a training with the recipe fast; `gsplat_edu.train.config` says what they mean.
struct Recipe {
    double iterations;
    double seed;
    double max_gaussians;
    double means_rate;
    double means_rate_final;
    double means_rate_iterations;
    double quats_rate;
    double scales_rate;
    double sh0_rate;
    double sh_rest_rate;
    double opacities_rate;
    double adam_eps;
    double ssim_weight;
    double sh_degree;
    double sh_every;
    double jacobian_limit;
    double start_opacity;
    double start_scale;
    double densify_start;
    double densify_every;
    double min_opacity;
    double fast_start_factor;
    double fast_full_size;
    double fast_stop;
    double fast_decay_start;
    double fast_decay;
    double fast_opacity_weight;
    double background[3];
};

constexpr double SMALLEST_SIDE = 32;
constexpr double NEIGHBOURS = 3;
constexpr double SMALLEST_DISTANCE = 0.00031622776601683794;
constexpr double START_SCALE = 0.09;
constexpr double FEW_VISIBLE = 0.25;

}  // namespace gsplat
