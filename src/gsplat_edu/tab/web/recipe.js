// Made by tools/generate_recipe.py from src/gsplat_edu/train and base/constants.py. Do not edit.

export const RECIPE_ITERATIONS = 30000;
export const FAST_DENSIFICATIONS = 20;
export const DENSIFY_EVERY = 100;
export const PLANNED = 100000;
export const PLANNED_PIXELS = 734580;
export const PLANNED_VIEWS = 85;
export const LEAST_PLANNED = 1000;
export const SEPARATE = 2.0;
export const Z_NEAR = 0.05;
export const DILATION = 0.3;
export const ALPHA_MAX = 0.99;
export const C0 = 0.28209479177387814;

// The settings of the recipe fast for RECIPE_ITERATIONS, in the order in which the module reads them.
export const RECIPE = {
  iterations: 30000,
  seed: 0,
  max_gaussians: 0,
  means_rate: 0.00016,
  means_rate_final: 1.6e-5,
  means_rate_iterations: 30000,
  quats_rate: 0.002,
  scales_rate: 0.01,
  sh0_rate: 0.005,
  sh_rest_rate: 0.000625,
  opacities_rate: 0.1,
  adam_eps: 1e-15,
  ssim_weight: 0.2,
  sh_degree: 3,
  sh_every: 3000,
  jacobian_limit: 1.3,
  start_opacity: 0.1,
  start_scale: 1.0,
  densify_start: 500,
  densify_every: 100,
  min_opacity: 0.02,
  fast_start_factor: 4.0,
  fast_full_size: 18000,
  fast_stop: 18000,
  fast_decay_start: 21000,
  fast_decay: 0.1,
  fast_opacity_weight: 0.002,
};

// Those that scale with the length of a run.
export const MILESTONES = [
  "means_rate_iterations",
  "sh_every",
  "densify_start",
  "fast_full_size",
  "fast_stop",
  "fast_decay_start",
];
