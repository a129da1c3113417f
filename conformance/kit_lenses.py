"""The kit's scenes of other cameras than a pinhole at rest: lenses, panoramas, orthographic views, rolling shutters."""

from __future__ import annotations

import numpy as np

from kit_scenes import Arrays, Plan, given, pinhole, plans as pinhole_plans, random, single, wide

COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "d1", "d2", "d3", "p1", "p2", "s1", "s2", "s3", "s4")
"""The entries of a camera's `distortion`."""

CENTRE = (0.1, -0.05, -0.2)
"""The centre of the cameras that see all around."""

TURN, SHIFT = (0.06, -0.05, 0.04), (0.05, 0.03, -0.04)
"""Motion during the readout: radians, and world units."""

RADIAL_FIRST = {
    "k1": -0.02,
    "k2": 0.004,
    "k3": -3e-3,
    "k4": 8e-4,
    "k5": -9e-5,
    "k6": 3e-6,
    "p1": 2e-3,
    "p2": -1e-3,
    "s1": 2e-3,
    "s2": -1e-3,
    "s3": 1e-3,
    "s4": 5e-4,
}
OPENCV = {"k1": -0.21, "k2": 0.04, "k3": -0.01, "d1": 0.02, "d2": 0.01, "p1": 0.004, "p2": -0.006}
FISHEYE = {"k1": -0.01, "k2": 0.004, "k3": -0.002, "k4": 0.0003}


def distorted(camera: Arrays, *, radial_first: bool = False, **coefficients: float) -> Arrays:
    """Return a camera with a distortion."""
    values = single([coefficients.get(name, 0.0) for name in COEFFICIENTS])
    return camera | {"distortion": values, "radial_first": radial_first}


def moving(camera: Arrays, readout: str) -> Arrays:
    """Return a camera with a rolling shutter."""
    return camera | {"readout": readout, "turn": single(TURN), "shift": single(SHIFT)}


def exposed(camera: Arrays, exposure: float, readout: str = "none") -> Arrays:
    """Return a camera with motion blur."""
    return moving(camera, readout) | {"exposure": float(np.float32(exposure))}


def fisheye(width: int = 26, height: int = 22, **changes: object) -> Arrays:
    """Return an equidistant fisheye amid `around`, whose corners are at 110 degrees."""
    focal = 0.33 * width
    return pinhole(width, height, eye=CENTRE, projection="fisheye", fx=focal, fy=1.1 * focal, **changes)


def orthographic(width: int = 20, height: int = 16) -> Arrays:
    """Return an orthographic camera before `random`, of a third of the image's width per unit."""
    return pinhole(width, height, projection="orthographic", fx=0.33 * width, fy=0.36 * width)


def panorama(width: int = 40, height: int = 20) -> Arrays:
    """Return a panorama amid `around`."""
    whole = {
        "projection": "equirectangular",
        "fx": width / (2 * np.pi),
        "fy": height / np.pi,
        "cx": (width - 1) / 2,
        "cy": (height - 1) / 2,
    }
    # the focal lengths belong to the size of the image, so they are not rounded to float32
    return pinhole(width, height, eye=CENTRE) | whole


def around(n: int, seed: int, widest: float = 180.0, channels: int = 2, **changes: object) -> Arrays:
    """Return n Gaussians around `CENTRE` at distinct distances, at up to `widest` degrees to the axis of its cameras.

    Latitudes are at most 70 degrees.
    """
    rng = np.random.default_rng(seed)
    R = pinhole()["R"]
    directions = rng.normal(size=(60 * n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    low = np.abs(directions[:, 1]) < np.sin(np.radians(70.0))
    directions = directions[low & (directions[:, 2] > np.cos(np.radians(widest)))][:n]
    distance = 0.8 + 2.2 * rng.permutation(n) / n
    found = {
        "means": directions @ R * distance[:, None] + CENTRE,
        "log_scales": np.log(0.09 * distance)[:, None] + rng.normal(size=(n, 3)) * 0.4,
    } | changes
    return random(n, seed, channels, 4, **found)


def seam() -> Arrays:
    """Return Gaussians behind the camera, whose ellipses cross the seam of a panorama, and one before it."""
    R, n = pinhole()["R"], 9
    longitude = np.append(np.pi + np.linspace(-0.2, 0.2, n - 1), 0.3)
    latitude = np.append(np.linspace(-1.0, 1.0, n - 1), 0.1)
    directions = np.stack(
        [np.cos(latitude) * np.sin(longitude), np.sin(latitude), np.cos(latitude) * np.cos(longitude)], axis=1
    )
    distance = np.linspace(1.0, 2.0, n)
    scales = np.log(np.outer(distance * np.cos(latitude), (0.2, 0.12, 0.08)))
    return random(n, 51, means=directions @ R * distance[:, None] + CENTRE, log_scales=scales)


def turned_back() -> Arrays:
    """Return Gaussians at r = 0.2 to 0.9 and 1.2 to 1.5 of a lens whose image is largest at r = 1.054."""
    r, turn = np.array([0.2, 0.5, 0.7, 0.9, 1.2, 1.3, 1.5]), np.arange(7) * 2.4
    camera = pinhole()
    ahead = np.stack([r * np.cos(turn), r * np.sin(turn), np.ones(7)], axis=1) * np.linspace(2, 3, 7)[:, None]
    means = ahead @ camera["R"] + camera["eye"]
    return random(7, 52, means=means, log_scales=np.full((7, 3), -1.6), logit_opacities=np.full(7, 1.0))


def beside(seed: int) -> Arrays:
    """Return Gaussians beside the image of `pinhole(24, 20, fx=14, fy=15)`, long in depth, and some within it.

    x/z is 1.2 to 1.3, or y/z 0.95 to 1.05, beyond the bounds of a limit of 1.3 and within the end of the lens.
    """
    rng, n = np.random.default_rng(seed), 16
    out = np.stack([rng.uniform(1.2, 1.3, n), rng.uniform(-0.4, 0.4, n)], axis=1)
    out[1::2] = np.stack([rng.uniform(-0.5, 0.5, n // 2), rng.uniform(0.95, 1.05, n // 2)], axis=1)
    out[2::4] *= -1
    out[3::4] *= -1
    out[-4:] = rng.uniform(-0.5, 0.5, (4, 2))
    camera = pinhole()
    depth = 2.0 + 0.1 * rng.permutation(n)
    means = np.append(out, np.ones((n, 1)), axis=1) * depth[:, None] @ camera["R"] + camera["eye"]
    scales = np.log(rng.uniform(0.15, 0.9, (n, 3)))
    return random(n, seed, means=means, log_scales=scales, logit_opacities=rng.uniform(0.0, 2.0, n))


def plans() -> tuple[Plan, ...]:
    """Return all plans of the kit."""
    return (*pinhole_plans(), *_perspective(), *_others(), *_shutters(), *_clamped(), *_gradients())


def _perspective() -> tuple[Plan, ...]:
    """Return the cases of distorted lenses at rest."""
    close = pinhole(24, 20, eye=(0.1, -0.05, -1.6), fx=14.0, fy=15.0)
    return (
        Plan(
            "lens_opencv",
            "A perspective lens with radial, rational and decentring terms.",
            "The distortion applies to (x / z, y / z), its derivative to J; d1 to d3 are the denominator.",
            random(30, 301),
            distorted(close, **OPENCV),
        ),
        Plan(
            "lens_prism",
            "A perspective lens with decentring and thin prism.",
            "s1 and s2 belong to u, s3 and s4 to v; s2 and s4 to the fourth power of the radius.",
            random(30, 202),
            distorted(close, k1=0.05, p1=0.01, s1=0.01, s2=-0.003, s3=-0.02, s4=0.002),
        ),
        Plan(
            "lens_ends",
            "Means beyond the angle at which the image of a barrel distortion turns back.",
            "A lens ends where its radial image stops growing; means beyond are not drawn.",
            turned_back(),
            distorted(pinhole(24, 20, fx=14.0, fy=14.0), k1=-0.3),
        ),
    )


def _clamped() -> tuple[Plan, ...]:
    """Return the cases of perspective lenses and shutters whose ellipses have bounds."""
    camera = pinhole(24, 20, fx=14.0, fy=15.0)
    return (
        Plan(
            "lens_clamp",
            "Means beside the image of a distorted lens, beyond the bounds of the Jacobian.",
            "The ellipse takes J at the clamped point; bounds follow from the rays of the image's edges.",
            beside(61),
            distorted(camera, k1=0.06, p1=0.004, s1=0.01),
            given(jacobian_limit=1.3),
        ),
        Plan(
            "shutter_clamp",
            "The same of a pinhole with a rolling shutter.",
            "The shear, too, is that of the clamped point; place and time are those of the mean.",
            beside(62),
            moving(camera, "down"),
            given(jacobian_limit=1.3),
        ),
    )


def _others() -> tuple[Plan, ...]:
    """Return the cases of other projections at rest."""
    return (
        Plan(
            "lens_fisheye",
            "A fisheye that sees up to 110 degrees from its axis.",
            "theta is atan2(r, z), also for z < 0; depth, order and z_near are by distance.",
            around(50, 703, 115.0),
            distorted(fisheye(), **FISHEYE),
        ),
        Plan(
            "lens_radial_first",
            "A fisheye whose decentring and prism apply to the image of the radial polynomial.",
            "radial_first: (A, B) is R (a, b); all six numerator coefficients are used.",
            around(40, 304, 100.0),
            distorted(fisheye(), radial_first=True, **RADIAL_FIRST),
        ),
        Plan(
            "lens_panorama",
            "A whole sphere in an equirectangular image.",
            "Longitude is atan2(x, z), latitude atan2(y, |(x, z)|), with +y down; depth is the distance.",
            around(50, 205),
            panorama(),
        ),
        Plan(
            "lens_seam",
            "Gaussians across the seam of a panorama, behind the camera.",
            "Columns are periodic: a pixel sees the copy of a Gaussian that is nearest to it.",
            seam(),
            panorama(),
        ),
        Plan(
            "lens_orthographic",
            "An orthographic camera.",
            "u = fx x + cx; the third column of J is zero; all directions are the optical axis.",
            random(30, 206, coefficients=16),
            orthographic(),
        ),
        Plan(
            "lens_antialiased",
            "Antialiasing behind a fisheye.",
            "The factor is that of the ellipse that the lens makes.",
            around(40, 307, 100.0, log_scales=np.random.default_rng(307).uniform(-4.5, -1.5, (40, 3))),
            distorted(fisheye(), **FISHEYE),
            given(antialiased=True),
        ),
    )


def _shutters() -> tuple[Plan, ...]:
    """Return the cases of cameras that move while they are read."""
    close = pinhole(24, 20, eye=(0.1, -0.05, -1.6), fx=14.0, fy=15.0)
    return (
        Plan(
            "shutter_down",
            "A pinhole that turns and moves while its rows are read from the top.",
            "A row's time is (v + 1/2) / H - 1/2; ellipses are sheared; directions are from the centre at the time.",
            random(30, 211, coefficients=16),
            moving(pinhole(), "down"),
        ),
        Plan(
            "shutter_up",
            "A distorted lens, read from the bottom.",
            "Rows are read in the other order.",
            random(30, 212),
            moving(distorted(close, **OPENCV), "up"),
        ),
        Plan(
            "shutter_left",
            "A fisheye, read by columns from the right.",
            "The time is that of the column, (W - 1/2 - u) / W - 1/2.",
            around(40, 213, 100.0),
            moving(distorted(fisheye(), **FISHEYE), "left"),
        ),
        Plan(
            "blur_global",
            "A pinhole with a global shutter that moves while it is exposed.",
            "The ellipse gets b b' / 12, and the opacity is lowered by the root of the determinants' ratio.",
            random(30, 517),
            exposed(pinhole(), 1.5),
        ),
        Plan(
            "blur_down",
            "A pinhole that is read by rows, each exposed for twice the readout's time.",
            "b is the motion in the image with the time of the row: g e / (1 - k'g).",
            random(30, 518),
            exposed(pinhole(), 2.0, "down"),
        ),
        Plan(
            "shutter_right",
            "An orthographic camera, read by columns from the left.",
            "The time is that of the column, (u + 1/2) / W - 1/2.",
            random(30, 514),
            moving(orthographic(), "right"),
        ),
        Plan(
            "shutter_panorama",
            "A panorama, read from the bottom.",
            "Shutter and seam together.",
            around(40, 215),
            moving(panorama(), "up"),
        ),
    )


def _gradients() -> tuple[Plan, ...]:
    """Return the cases with gradients."""
    return (
        Plan(
            "gradient_lens_opencv",
            "All gradients of a distorted lens, where nothing is cut, clamped or floored.",
            "J depends on the mean, on fx and fy, and on all fifteen coefficients, also on those that are zero.",
            wide(5, 221, channels=2),
            distorted(pinhole(11, 9), **OPENCV),
            gradients=True,
            smooth=True,
        ),
        Plan(
            "gradient_lens_fisheye",
            "Gradients of a fisheye, past 90 degrees.",
            "The derivatives of theta / r, near the axis and behind the camera.",
            around(14, 222, 105.0, 1, log_scales=np.random.default_rng(222).uniform(-1.6, -0.8, (14, 3))),
            distorted(fisheye(16, 14), **FISHEYE),
            gradients=True,
        ),
        Plan(
            "gradient_lens_panorama",
            "Gradients of a panorama; fx and fy have none, because they belong to the image's size.",
            "The derivatives of longitude and latitude, and of what crosses the seam.",
            around(14, 223, 180.0, 1),
            panorama(32, 16),
            gradients=True,
        ),
        Plan(
            "gradient_lens_orthographic",
            "Gradients of an orthographic camera.",
            "The direction is the third row of R: it has a gradient in R, and none in means and eye.",
            wide(5, 224, channels=1),
            orthographic(11, 9),
            gradients=True,
            smooth=True,
        ),
        Plan(
            "gradient_shutter",
            "All gradients of a distorted lens with a rolling shutter.",
            "The time at which a mean is seen depends on everything: implicit differentiation, or through the solver.",
            wide(5, 325, channels=1),
            moving(distorted(pinhole(11, 9), **OPENCV), "down"),
            gradients=True,
            smooth=True,
        ),
        Plan(
            "gradient_blur",
            "All gradients of a distorted lens with a rolling shutter and motion blur.",
            "The blur and its opacity factor depend on means, shapes, pose, lens and motion.",
            wide(5, 327, channels=1),
            exposed(distorted(pinhole(11, 9), **OPENCV), 2.0, "down"),
            gradients=True,
            smooth=True,
        ),
    )
