// Made by tools/generate_constants.py from src/gsplat_edu/base/constants.py. Do not edit.
// clang-format off
#pragma once

namespace gsplat {

constexpr int TILE = 16;
constexpr double DILATION = 0.3;
constexpr double DILATION_MAX = 1000000.0;
constexpr double THINNEST = 1e-06;
constexpr double ALPHA_MIN = 0.00392156862745098;
constexpr double ALPHA_MAX = 0.99;
constexpr double Z_NEAR = 0.05;
constexpr double T_STOP = 0.0001;
constexpr double DET_FLOOR = 1e-12;
constexpr double SPLAT_LIMIT = 1000000000000000.0;
constexpr double COLOR_LIMIT = 1000000.0;
constexpr double RIM_SLACK = 0.001;
constexpr double C0 = 0.28209479177387814;
constexpr double C1 = 0.4886025119029199;
constexpr double C2[5] = {1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396};
constexpr double C3[7] = {-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658, 1.445305721320277, -0.5900435899266435};
constexpr double SH_OFFSET = 0.5;
constexpr double SSIM_C1 = 0.0001;
constexpr double SSIM_C2 = 0.0009;
constexpr double SRGB_OFFSET = 0.055;
constexpr double NEAR_AXIS = 0.04;
constexpr double POLE = 0.0174524064372836;
constexpr double LOG2_ALPHA_MIN = -7.994353436858858;
constexpr double LOG2_ALPHA_MAX = -0.014499569695115089;
constexpr double SSIM_TAP[6] = {0.2660117248617943, 0.21300553771125366, 0.1093606895097, 0.03600077212843082, 0.007598758135239184, 0.0010283800844791099};

}  // namespace gsplat
