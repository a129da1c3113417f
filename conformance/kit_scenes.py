"""The scenes of the conformance kit by name: what each tests, and what a failure usually means.

All inputs are float32 numbers stored as float64, so that every renderer starts from the same ones.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsplat_edu import look_at, quat_to_R
from run import PINHOLE

Arrays = dict[str, Any]


def single(array: object) -> np.ndarray:
    """Round to float32."""
    return np.asarray(array, np.float32).astype(np.float64)


def pinhole(width: int = 24, height: int = 20, **changes: object) -> Arrays:
    """Return a camera three units in front of the origin, slightly turned, with the principal point off-centre."""
    found = {
        "R": quat_to_R((1.0, 0.02, -0.03, 0.1)),
        "eye": (0.1, -0.05, -3.0),
        "fx": 1.1 * width,
        "fy": 1.2 * width,
        "cx": 0.52 * width,
        "cy": 0.47 * height,
        "width": width,
        "height": height,
    } | changes
    numbers = {name: float(np.float32(found[name])) for name in ("fx", "fy", "cx", "cy")}
    return PINHOLE | found | numbers | {name: single(found[name]) for name in ("R", "eye")}


STRAIGHT = {"R": np.eye(3), "eye": (0.0, 0.0, -3.0)}
"""A pose along z, for which float32 and float64 compute the same depths."""


def given(**changes: object) -> Arrays:
    """Return the settings of a case: the defaults of the specification and a coloured background."""
    found = {
        "background": (0.2, 0.5, 0.9),
        "sh_degree": 3,
        "antialiased": False,
        "jacobian_limit": None,
        "alpha_max": 0.99,
        "z_near": 0.05,
    } | changes
    return found | {"background": single(found["background"])}


@dataclass(frozen=True)
class Plan:
    """A scene and how its truth is made.

    Args:
        name: Name of the case.
        shows: What it tests.
        hint: What a failure usually means.
        gaussians: Raw parameters and features, as for `run.Case`.
        camera: As for `run.Case`.
        settings: As for `run.Case`.
        gradients: Whether the case has gradients.
        smooth: Whether no rim, clamp or floor is in the image at all, so that only formulas count.
        exact_depths: Whether depths coincide or equal z_near, which rounding of the camera or of z would change.
        stops: Whether tiles fall below T_STOP, where a renderer may stop.
    """

    name: str
    shows: str
    hint: str
    gaussians: Arrays
    camera: Arrays
    settings: Arrays = field(default_factory=given)
    gradients: bool = False
    smooth: bool = False
    exact_depths: bool = False
    stops: bool = False


def random(n: int, seed: int, channels: int = 2, coefficients: int = 1, **changes: object) -> Arrays:
    """Return n random Gaussians with distinct depths."""
    rng = np.random.default_rng(seed)
    means = rng.uniform(-0.8, 0.8, (n, 3))
    means[:, 2] = rng.permutation(n) / max(n, 1) - 0.5
    found = {
        "means": means,
        "quats": rng.normal(size=(n, 4)),
        "log_scales": rng.normal(size=(n, 3)) * 0.6 - 2.0,
        "sh": rng.normal(size=(n, coefficients, 3))
        * np.where(np.arange(coefficients) == 0, 1.0, 0.3)[:, None],
        "logit_opacities": rng.normal(size=n) * 1.5,
        "features": rng.normal(size=(n, channels)),
    } | changes
    return {name: single(array) for name, array in found.items()}


def wide(n: int, seed: int, channels: int = 5, **changes: object) -> Arrays:
    """Return Gaussians wider than an image of 11 x 9 px: no pixel is near a rim, an alpha clamp or a floor."""
    rng = np.random.default_rng(seed)
    sh = rng.normal(size=(n, 16, 3)) * 0.05
    sh[:, 0] += 0.5
    found = {
        "means": np.stack([*rng.uniform(-0.3, 0.3, (2, n)), np.linspace(-0.5, 0.5, n)], axis=1),
        "log_scales": rng.uniform(-0.6, 0.2, (n, 3)),
        "sh": sh,
        "logit_opacities": rng.uniform(-0.5, 1.0, n),
    } | changes
    return random(n, seed + 100, channels, **found)


def scales(n: int, seed: int, middle: float, spread: float = 0.4) -> np.ndarray:
    """Return the logarithms of n scales around a middle."""
    return middle + np.random.default_rng(seed).uniform(-spread, spread, (n, 3))


def _needles(n: int) -> np.ndarray:
    thin = np.log(np.tile((0.5, 0.005, 0.005), (n, 1)))
    return np.random.default_rng(1).permuted(thin, axis=1)


def _tied() -> np.ndarray:
    means = np.random.default_rng(7).uniform(-0.5, 0.5, (24, 3))
    means[:, 2] = np.repeat((0.5, 0.0), 12)
    return means


def _near() -> Arrays:
    """Return Gaussians behind, at and around z_near = 0.0625, and two far behind them."""
    z = np.array([-1.0, -0.0625, 0.0, 0.03125, 0.0625, 0.078125, 0.25, 1.0, 2.0])
    rng = np.random.default_rng(21)
    means = np.stack([*rng.uniform(-0.15, 0.15, (2, len(z))) * np.maximum(np.abs(z), 0.1), z], axis=1)
    scales = np.log(0.12 * np.maximum(np.abs(z), 0.1))[:, None] + rng.uniform(-0.3, 0.3, (len(z), 3))
    return random(len(z), 21, means=means, log_scales=scales, logit_opacities=np.full(len(z), 0.5))


def _beside() -> np.ndarray:
    """Return means on all sides of the image, at 1.1 to 3 times half the field of view, and one inside."""
    around = np.random.default_rng(12).uniform(-2.6, 2.6, (15, 3))
    around[:, 2] = np.linspace(-0.7, 0.8, 15)
    around[0, :2] = 0.1
    return around


def _layers(n: int, seed: int) -> Arrays:
    rng = np.random.default_rng(seed)
    means = np.stack([*rng.normal(size=(2, n)) * 0.1, np.linspace(-1, 1, n)], axis=1)
    scales = rng.normal(size=(n, 3)) * 0.3 - 0.5
    return random(
        n, seed, channels=1, means=means, log_scales=scales, logit_opacities=rng.normal(size=n) * 0.4 - 4.1
    )


def _oblique() -> Arrays:
    """Return a camera that looks along a direction in which no harmonic is zero."""
    eye = np.array((2.0, -1.5, -1.7))
    return pinhole(R=look_at(eye, (0.0, 0.0, 0.0)), eye=eye)


def _each_harmonic() -> Arrays:
    """Return 16 Gaussians in a grid before `_oblique`, each with one harmonic only, which is strong."""
    rows, columns = np.divmod(np.arange(16), 4)
    grid = np.stack([(columns - 1.5) * 0.6, (rows - 1.5) * 0.5, np.linspace(2.6, 3.4, 16)], axis=1)
    means = grid @ _oblique()["R"] + _oblique()["eye"]
    sh = np.zeros((16, 16, 3))
    sh[np.arange(16), np.arange(16)] = (0.9, -0.7, 0.4)
    return random(
        16, 30, means=means, log_scales=np.full((16, 3), -1.7), sh=sh, logit_opacities=np.full(16, 1.5)
    )


def _unnormalised() -> np.ndarray:
    rng = np.random.default_rng(31)
    return rng.normal(size=(12, 4)) * np.geomspace(0.05, 20.0, 12)[:, None]


def plans() -> tuple[Plan, ...]:
    """Return the plans of pinholes; `kit_lenses` has all."""
    parts = (_formulas, _opacities, _hard, _placed, _sizes, _smooth, _pieces, _more_gradients)
    return tuple(plan for part in parts for plan in part())


def _formulas() -> tuple[Plan, ...]:
    """Return the cases of shape, position and colour of single Gaussians."""
    return (
        Plan(
            "one_gaussian",
            "One Gaussian between pixels: pixel centres, axes, rows and columns.",
            "Pixel centres are at integer coordinates, not at halves; u goes with columns and v, downwards, with rows.",
            random(1, 10, means=[(0.13, -0.21, 0.3)], log_scales=[(-1.6, -2.2, -1.9)], logit_opacities=[1.2]),
            pinhole(),
        ),
        Plan(
            "quaternions",
            "Elongated Gaussians with quaternions of lengths from 0.05 to 20.",
            "The order is (w, x, y, z); quaternions are normalised; R rotates from the Gaussian's axes to the world's.",
            random(12, 31, quats=_unnormalised(), log_scales=np.tile((-1.2, -2.0, -2.8), (12, 1))),
            pinhole(),
        ),
        Plan(
            "each_harmonic",
            "One Gaussian per harmonic of degrees 0 to 3, seen from different directions.",
            "Basis, signs or order of the harmonics, the offset 0.5, the floor at 0, or the direction (eye to mean).",
            _each_harmonic(),
            _oblique(),
        ),
        Plan(
            "sh_degree_1_of_3",
            "16 coefficients, of which sh_degree = 1 uses four.",
            "Coefficients of degrees above sh_degree are ignored.",
            random(12, 32, coefficients=16),
            pinhole(16, 16),
            given(sh_degree=1),
        ),
        Plan(
            "negative_colours",
            "Colours below zero, floored at 0 before compositing.",
            "Colours are floored at 0 per Gaussian and channel, and have no upper bound.",
            random(12, 33, sh=np.random.default_rng(33).normal(size=(12, 1, 3)) * 4.0),
            pinhole(16, 16),
        ),
    )


def _opacities() -> tuple[Plan, ...]:
    """Return the cases of what becomes of an opacity."""
    return (
        Plan(
            "smaller_than_a_pixel",
            "Points, whose ellipses are the dilation alone.",
            "0.3 px² is added to both diagonal entries of the covariance in the image.",
            random(60, 4, log_scales=scales(60, 4, -8.0)),
            pinhole(),
        ),
        Plan(
            "antialiased",
            "Opacities compensated for the dilation, on Gaussians from points to 10 px.",
            "The factor is sqrt(det before / det after dilation), applied to the opacity before clamp and cut-off.",
            random(40, 101, log_scales=scales(40, 101, -2.8, 1.6)),
            pinhole(),
            given(antialiased=True),
        ),
        Plan(
            "alpha_clamp",
            "Opaque Gaussians whose alpha is clamped around their centres.",
            "alpha is at most alpha_max = 0.99, and an opaque ellipse ends at 1/255, beyond 3 standard deviations.",
            random(3, 36, log_scales=scales(3, 36, -1.0), logit_opacities=np.full(3, 8.0)),
            pinhole(),
        ),
        Plan(
            "clamp_at_0.999",
            "The same with alpha_max = 0.999, as in gsplat.",
            "alpha_max is a setting.",
            random(3, 36, log_scales=scales(3, 36, -1.0), logit_opacities=np.full(3, 8.0)),
            pinhole(16, 16),
            given(alpha_max=0.999),
        ),
        Plan(
            "nearly_transparent",
            "Opacities around 1/255, at which alpha is cut off.",
            "alpha below 1/255 is zero, exactly; opacities are sigmoids.",
            random(60, 6, log_scales=scales(60, 6, -1.5), logit_opacities=np.linspace(-5.54, -5.0, 60)),
            pinhole(),
        ),
    )


def _hard() -> tuple[Plan, ...]:
    """Return the cases of compositing and of hard shapes."""
    return (
        Plan(
            "random",
            "40 random Gaussians of all kinds.",
            "If only this case and similar ones fail, look at the order of compositing and at the background.",
            random(40, 103, coefficients=16),
            pinhole(),
        ),
        Plan(
            "ties_in_depth",
            "Two groups of 12 Gaussians with equal depths, stored far group first.",
            "Compositing is near to far by the camera z of the mean; equal depths keep the order of the input.",
            random(24, 7, means=_tied(), log_scales=scales(24, 7, -1.4)),
            pinhole(**STRAIGHT),
            exact_depths=True,
        ),
        Plan(
            "needles",
            "Gaussians 100 times as long as wide.",
            "The covariance is a product (R S)(R S)'; its inverse needs the determinant without cancellation.",
            random(30, 100, log_scales=_needles(30)),
            pinhole(),
        ),
        Plan(
            "larger_than_the_image",
            "Gaussians larger than the image.",
            "A large ellipse is dropped or cut: it reaches every pixel with alpha >= 1/255.",
            random(10, 3, log_scales=scales(10, 3, 0.8), logit_opacities=np.full(10, -0.8)),
            pinhole(),
        ),
    )


def _placed() -> tuple[Plan, ...]:
    """Return the hard cases of where Gaussians are."""
    return (
        Plan(
            "off_screen_centres",
            "Means beside the image, whose ellipses reach into it; the Jacobian is clamped.",
            "x/z and y/z inside J are clamped to jacobian_limit times half the image about its centre (not about cx).",
            random(15, 12, means=_beside(), log_scales=scales(15, 12, -0.4)),
            pinhole(),
            given(jacobian_limit=1.3),
        ),
        Plan(
            "off_screen_unclamped",
            "The same with the unclamped Jacobian.",
            "jacobian_limit = None means no clamp.",
            random(15, 12, means=_beside(), log_scales=scales(15, 12, -0.4)),
            pinhole(),
        ),
        Plan(
            "z_near",
            "Means behind the camera, at z_near and just beyond it.",
            "Means with z <= z_near are not drawn; z_near is a setting.",
            _near(),
            pinhole(**STRAIGHT | {"eye": (0.0, 0.0, 0.0)}),
            given(z_near=0.0625),
            exact_depths=True,
        ),
        Plan(
            "opaque_tiles_stop",
            "Opaque layers: T falls below 1e-4 in whole tiles, where a renderer may stop or continue.",
            "Stopping before the Gaussian that takes T below 1e-4, or at a larger T, leaves out what is still visible.",
            random(40, 101, log_scales=scales(40, 101, -0.5), logit_opacities=np.full(40, 3.0)),
            pinhole(),
            stops=True,
        ),
        Plan(
            "hundreds_of_layers",
            "300 faint Gaussians over the same pixels.",
            "Lists of Gaussians per tile or pixel are cut short, or small weights are lost in sums.",
            _layers(300, 194),
            pinhole(12, 10),
        ),
    )


def _sizes() -> tuple[Plan, ...]:
    """Return the cases of unusual sizes and of empty images."""
    return (
        Plan(
            "odd_size",
            "An image of 17 x 33 px, no multiple of a tile.",
            "Rows and columns are exchanged, or pixels of partial tiles are lost.",
            random(30, 9, coefficients=4),
            pinhole(17, 33),
        ),
        Plan(
            "one_pixel",
            "An image of 1 x 1 px.",
            "Pixels of partial tiles are lost.",
            random(20, 8, log_scales=scales(20, 8, -1.0), logit_opacities=np.full(20, -2.0)),
            pinhole(1, 1),
            given(jacobian_limit=1.3),
        ),
        Plan(
            "nothing_in_view",
            "Gaussians behind the camera only: the background.",
            "Without a visible Gaussian, the image is the background, T is 1, and all maps are 0.",
            random(3, 13, means=np.array([(0, 0, -5.0), (0.3, 0, -4.0), (0, 1, -9.0)])),
            pinhole(9, 7),
        ),
        Plan(
            "no_gaussians",
            "An empty scene.",
            "Arrays may have no rows.",
            random(0, 14),
            pinhole(9, 7),
        ),
    )


def _smooth() -> tuple[Plan, ...]:
    """Return the cases whose gradients are those of formulas alone."""
    hint = "A formula's gradient is wrong. d/d R has nine entries; the viewing direction depends on means and eye."
    return (
        Plan(
            "gradient_smooth",
            "All gradients, where nothing is cut, clamped or floored.",
            hint,
            wide(5, 0),
            pinhole(11, 9),
            gradients=True,
            smooth=True,
        ),
        Plan(
            "gradient_antialiased",
            "The same with antialiasing.",
            "The opacity factor depends on covariance, mean and camera through both determinants.",
            wide(5, 1, channels=2),
            pinhole(11, 9),
            given(antialiased=True),
            gradients=True,
            smooth=True,
        ),
        Plan(
            "gradient_32_features",
            "32 channels of features.",
            "Every channel is composited and differentiated; features are over zero, not over the background.",
            wide(4, 3, channels=32),
            pinhole(8, 7),
            gradients=True,
            smooth=True,
        ),
    )


def _pieces() -> tuple[Plan, ...]:
    """Return the cases with gradients on both sides of a branch, none near it."""
    beside = np.array(
        [
            (-1.9, 0.1, -0.5),
            (0.2, -1.8, -0.3),
            (1.9, 1.9, -0.1),
            (0.1, 0.2, 0.1),
            (-0.3, 1.8, 0.3),
            (0.3, -0.2, 0.5),
        ]
    )
    floored = np.random.default_rng(41).choice([-2.6, 0.8], (5, 1, 3))
    return (
        Plan(
            "gradient_jacobian_clamp",
            "Means beside the image, some beyond the clamp of the Jacobian.",
            "A clamped x/z has no gradient in the mean; the bound itself moves with fx, fy, cx and cy.",
            wide(6, 3, channels=2, means=beside, log_scales=scales(6, 40, 0.3)),
            pinhole(11, 9),
            given(jacobian_limit=1.3),
            gradients=True,
        ),
        Plan(
            "gradient_alpha_clamp",
            "Some alphas are clamped at 0.99.",
            "A clamped alpha has gradient zero in everything it is made of.",
            wide(4, 100, channels=2, log_scales=scales(4, 100, -0.6), logit_opacities=(6.0, -1.0, 0.5, -0.5)),
            pinhole(11, 9),
            gradients=True,
        ),
        Plan(
            "gradient_colour_floor",
            "Some colours are floored at 0.",
            "A floored channel has gradient zero in its coefficients and in the direction.",
            wide(5, 41, channels=1, sh=np.concatenate([floored, wide(5, 41)["sh"][:, 1:]], axis=1)),
            pinhole(11, 9),
            gradients=True,
        ),
    )


def _more_gradients() -> tuple[Plan, ...]:
    """Return cases with gradients of more of everything."""
    return (
        Plan(
            "gradient_sh_degree_1",
            "Gradients with sh_degree = 1 and 16 stored coefficients.",
            "Unused coefficients have gradient zero.",
            wide(4, 42, channels=1),
            pinhole(11, 9),
            given(sh_degree=1),
            gradients=True,
        ),
        Plan(
            "gradient_random",
            "24 random Gaussians with rims in the image.",
            "Sums over pixels or tiles are incomplete, or T behind a Gaussian is wrong.",
            random(24, 100, channels=3, coefficients=4),
            pinhole(20, 18),
            gradients=True,
        ),
        Plan(
            "gradient_needles",
            "Gradients of thin Gaussians.",
            "Digits are lost in the gradient of the inverse covariance.",
            random(12, 44, channels=1, log_scales=_needles(12)),
            pinhole(20, 18),
            given(antialiased=True, jacobian_limit=1.3),
            gradients=True,
        ),
    )
