"""All constants of the renderer, and values that several packages share: value, unit, purpose, source.

Kerbl et al. 2023 is "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (ACM TOG 42.4);
"its code" is the rasteriser published with it.

Chapter: 02_gaussians_in_2d.
"""

from __future__ import annotations

import math
from typing import Final

DILATION: Final = 0.3
"""px², added to both diagonal entries of every screen-space covariance, so that every splat is at least about a pixel
wide and cannot fall between the samples; `RenderSettings.dilation` replaces it. Source: Kerbl et al. 2023, its code."""

DILATION_MAX: Final = 1e6
"""px²: largest dilation, a blur of 1,000 px. Its fourth power, which gradients contain, is finite in float32. Source:
ours."""

THINNEST: Final = 1e-6
"""px²: a Gaussian whose dilated covariance has det <= THINNEST times its trace is not drawn. Its standard deviation
along the short axis is then at most 1/1000 px, so that pixel centres are in it by chance only, and float32 could not
hold the square of its inverse. A dilation of 2e-6 px² or more makes every Gaussian thicker. Source: ours."""

ALPHA_MIN: Final = 1.0 / 255.0
"""Alpha below this is zero: one step of an 8-bit image. This gives a Gaussian a finite extent. Source: Kerbl et al.
2023, its code."""

ALPHA_MAX: Final = 0.99
"""Alpha is clamped to this, so that 1 - alpha never reaches 0 and the transmittance behind a splat keeps a
gradient. Source: Kerbl et al. 2023, appendix C."""

Z_NEAR: Final = 0.05
"""World units: means at this camera depth or nearer are culled, because the projection divides by depth. Source: the
course's convention (Kerbl et al. use 0.2)."""

T_STOP: Final = 1e-4
"""Transmittance below which nothing behind is visible and compositing may stop. Source: Kerbl et al. 2023, appendix
C."""

TILE: Final = 16
"""px: edge of the square tiles in which kernels composite and terminate. Source: Kerbl et al. 2023, section 6."""

RIM_SLACK: Final = 1e-3
"""px, margin added around an ellipse when kernels determine its tiles and rows, so that rounding never loses a pixel at
the rim; it costs at most one extra pair."""

COLOR_LIMIT: Final = 1e6
"""The kernels treat a colour beyond this as not finite and skip its Gaussian. No photo comes close, and the gradients
of nearby Gaussians would lose all their digits to it. Source: ours."""

SPLAT_LIMIT: Final = 1e15
"""px: the native kernels skip a Gaussian whose standard deviation on the screen exceeds this. float32 can hold the
squares of its inverse, a factor of the exponent. Source: ours."""

SPLAT_LIMIT_F32: Final = 1e9
"""px: the same for kernels that compute in float32, where the determinant of a longer one could overflow. Source:
ours."""

DET_FLOOR: Final = 1e-12
"""px⁴: lower bound of the determinant of a screen-space covariance before dilation, used where antialiasing takes the
root of its ratio to the dilated one. A Gaussian that degenerates to a line has determinant 0, where the root has no
slope; below the bound the factor is constant. Source: ours."""

LAMBDA_FLOOR: Final = 0.1
"""px⁴: lower bound of the discriminant when computing the larger eigenvalue of a screen-space covariance for the
3-sigma box, so that rounding cannot make it negative. Source: Kerbl et al. 2023, its code."""

SSIM_C1: Final = 0.01**2
"""Stabilises SSIM's ratio of means, for images of range 1. Source: Wang et al. 2004, K1 = 0.01."""

SSIM_C2: Final = 0.03**2
"""Stabilises SSIM's ratio of variances, for images of range 1. Source: Wang et al. 2004, K2 = 0.03."""

SSIM_SIGMA: Final = 1.5
"""px: standard deviation of SSIM's window, which has 11 taps and is zero outside the image. Source: Wang et al. 2004;
the padding is that of Kerbl et al. 2023's code."""

# Spherical harmonics: normalisation constants of the real basis, degrees 0 to 3. Each makes the square of its
# polynomial integrate to 1 over the sphere. Source: Sloan 2008, "Stupid Spherical Harmonics Tricks".

C0: Final = 0.28209479177387814
"""1 / (2 sqrt(pi)): the constant harmonic. colour = C0 * sh0 + 0.5 at degree 0."""

C1: Final = math.sqrt(3.0 / (4.0 * math.pi))
"""Degree 1: factor of x, y and z."""

C2: Final = (
    math.sqrt(15.0 / math.pi) / 2.0,
    -math.sqrt(15.0 / math.pi) / 2.0,
    math.sqrt(5.0 / math.pi) / 4.0,
    -math.sqrt(15.0 / math.pi) / 2.0,
    math.sqrt(15.0 / math.pi) / 4.0,
)
"""Degree 2, one factor per harmonic from m = -2 to 2, signs included: of xy, yz, 2z² - x² - y², xz, x² - y²."""

C3: Final = (
    -math.sqrt(35.0 / (2.0 * math.pi)) / 4.0,
    math.sqrt(105.0 / math.pi) / 2.0,
    -math.sqrt(21.0 / (2.0 * math.pi)) / 4.0,
    math.sqrt(7.0 / math.pi) / 4.0,
    -math.sqrt(21.0 / (2.0 * math.pi)) / 4.0,
    math.sqrt(105.0 / math.pi) / 4.0,
    -math.sqrt(35.0 / (2.0 * math.pi)) / 4.0,
)
"""Degree 3, one factor per harmonic from m = -3 to 3, signs included: of y(3x² - y²), xyz, y(4z² - x² - y²), z(2z² -
3x² - 3y²), x(4z² - x² - y²), z(x² - y²), x(x² - 3y²)."""

SH_OFFSET: Final = 0.5
"""Added to every evaluated colour, so that all-zero coefficients are mid-grey.
Source: Kerbl et al. 2023, its code."""

SH_MAX_DEGREE: Final = 3
"""Highest supported SH degree: 16 coefficients per channel."""

RUN_CONFIG: Final = "config.json"
"""File of the folder of every run, with all its settings."""

AUTO: Final = "auto"
"""Value of an option or a field that leaves the choice to the program, which decides by the photos."""

LOOPBACK: Final = "127.0.0.1"
"""IPv4 address of this computer, reachable from this computer only. Source: RFC 1122, section 3.2.1.3."""

SRGB_OFFSET: Final = 0.055
"""Offset of the sRGB curve, of encoded colours: 1.055 l^(1/2.4) - 0.055. Source: IEC 61966-2-1."""

PAGE_FACES: Final = 2_000_000
"""Most triangles of all meshes of a page. They take about 60 MB before compression. `gsplat-edu mesh` keeps to it
unless told otherwise. Source: ours."""

SCENE_SUFFIXES: Final = (
    ".ply",
    ".compressed.ply",
    ".splat",
    ".ksplat",
    ".spz",
    ".sog",
    ".glb",
    ".usda",
    ".usdz",
    ".usdc",
    ".rad",
    ".csv",
)
"""Suffixes of the files that can hold a scene. Source: ours."""

POINT_SUFFIXES: Final = (".las", ".laz")
"""Suffixes of the point clouds that `convert` makes of a scene's centres; they hold no scene. Source: ours."""

SIZED: Final = (".spz", ".sog", ".compressed.ply", ".html")
"""Endings of the files that `convert --size` writes. Source: ours."""

FAR_BELOW: Final = 0.1
"""A scene that was trained for less than this fraction of its length is not usable: splats have hardly moved."""

NEAR_AXIS: Final = 0.04
NEAR_AXIS_F32: Final = 0.1
"""Largest r² / z² at which a fisheye's theta / r is a series, in float64 and in float32: above it, the closed form of
the second derivative loses at most three digits to cancellation."""

POLE: Final = math.cos(math.radians(89.0))
"""Smallest distance from the axis of the poles, as a fraction of the distance from the camera, in the Jacobian of an
equirectangular projection: nearer to a pole, first order would stretch an ellipse around the whole image."""
