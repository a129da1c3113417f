"""Cameras of every projection and shutter, and scenes around them."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from gsplat_edu import Camera, build_cov3d_batch, eval_sh, quat_to_R_batch, render_gaussians
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.shutter import AT_ONCE, RollingShutter
from native_scenes import BACKGROUND, Scene

OPENCV = Projection(
    distortion=Distortion.of(k1=-0.21, k2=0.04, k3=-0.01, d1=0.02, d2=0.01, p1=0.004, p2=-0.006)
)
PRISM = Projection(distortion=Distortion.of(k1=0.05, p1=0.01, s1=0.01, s2=-0.003, s3=-0.02, s4=0.002))
PINCUSHION = Projection(distortion=Distortion.of(k1=0.03, p1=0.002, s1=0.002))
FISHEYE = Projection("fisheye", Distortion.of(k1=-0.01, k2=0.004, k3=-0.002, k4=0.0003))
THIN_PRISM = Projection(
    "fisheye", Distortion.of(k1=0.02, k2=-0.004, p1=0.003, p2=-0.002, s1=0.004, s3=-0.003)
)
ARIA = Projection(
    "fisheye",
    Distortion.of(
        radial_first=True,
        k1=-0.02,
        k2=0.004,
        k3=-3e-3,
        k4=8e-4,
        k5=-9e-5,
        k6=3e-6,
        p1=2e-3,
        p2=-1e-3,
        s1=2e-3,
        s2=-1e-3,
        s3=1e-3,
        s4=5e-4,
    ),
)
MOVING = RollingShutter((0.06, -0.05, 0.04), (0.05, 0.03, -0.04))

LENSES: dict[str, tuple[Projection, RollingShutter | None]] = {
    "opencv": (OPENCV, None),
    "prism": (PRISM, None),
    "fisheye": (FISHEYE, None),
    "equidistant": (Projection("fisheye"), None),
    "thin prism": (THIN_PRISM, None),
    "radial first": (ARIA, None),
    "panorama": (Projection("equirectangular"), None),
    "orthographic": (Projection("orthographic"), None),
    "pinhole, moving": (Projection(), MOVING),
    "opencv, moving up": (OPENCV, RollingShutter(MOVING.turn, MOVING.shift, "up")),
    "pincushion, moving": (PINCUSHION, RollingShutter(MOVING.turn, MOVING.shift, "right")),
    "fisheye, moving": (FISHEYE, RollingShutter(MOVING.turn, MOVING.shift, "left")),
    "orthographic, moving": (Projection("orthographic"), RollingShutter(MOVING.turn, MOVING.shift, "right")),
    "panorama, moving": (Projection("equirectangular"), RollingShutter(MOVING.turn, MOVING.shift, "up")),
    "pinhole, blurred": (Projection(), RollingShutter(MOVING.turn, MOVING.shift, AT_ONCE, 1.5)),
    "pincushion, blurred": (PINCUSHION, RollingShutter(MOVING.turn, MOVING.shift, "left", 1.2)),
    "fisheye, blurred": (FISHEYE, RollingShutter(MOVING.turn, MOVING.shift, "down", 2.5)),
    "panorama, blurred": (
        Projection("equirectangular"),
        RollingShutter(MOVING.turn, MOVING.shift, "up", 0.8),
    ),
}
"""Projections and shutters by name: at least one of every kind, and of every direction of the readout; with motion blur
and without."""

LIMIT = 1.2
"""Of the Jacobian, in tests of the clamp; many Gaussians of `around` are beyond it."""

CLAMPED = (
    *("prism", "pinhole, moving", "pincushion, moving", "pinhole, blurred", "pincushion, blurred"),
    "opencv, moving up",
)
"""Perspective lenses and shutters. The image of the last turns back within its edges, so that no mean is beyond."""

ROTATION = quat_to_R_batch([(1.0, 0.05, -0.08, 0.1)])[0]
CENTRE = (0.1, -0.05, -0.2)


def lens_camera(name: str, W: int = 45, H: int = 37) -> Camera:
    """Return a camera of a lens amid the scenes below."""
    projection, shutter = LENSES[name]
    if projection.kind == "equirectangular":
        panorama = Camera.panorama(ROTATION, CENTRE, H, W)
        return panorama if shutter is None else moved(panorama, shutter)
    focal = {"fisheye": 0.24, "orthographic": 0.3}.get(projection.kind, 0.6) * W
    return Camera(ROTATION, CENTRE, focal, 1.1 * focal, 0.52 * W, 0.47 * H, H, W).through(projection, shutter)


def moved(camera: Camera, shutter: RollingShutter) -> Camera:
    """Return a camera with a rolling shutter."""
    return Camera.posed(camera.R, camera.eye, camera.intrinsics, shutter)


def around(n: int, seed: int = 0) -> Scene:
    """Return n Gaussians in all directions of `CENTRE`, at distinct distances, with harmonics of degree 3."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance = 0.8 + 2.2 * rng.permutation(n) / n
    return Scene(
        lens_camera("fisheye"),
        means=CENTRE + directions * distance[:, None],
        quats=rng.normal(size=(n, 4)),
        log_scales=rng.normal(size=(n, 3)) * 0.5 - 2.2,
        sh=rng.normal(size=(n, 16, 3)) * np.where(np.arange(16) == 0, 1.0, 0.2)[None, :, None],
        logits=rng.normal(size=n),
    )


def smooth_around(n: int = 4, seed: int = 0) -> Scene:
    """Return a few Gaussians ahead, each wider than a small image, so that alpha is above the floor everywhere."""
    rng = np.random.default_rng(seed)
    scene = around(n, seed)
    distance = 2.0 + 0.15 * rng.permutation(n)
    side = rng.uniform(-0.25, 0.25, (n, 2))
    along = np.concatenate([side, np.ones((n, 1))], axis=1)
    sh = rng.normal(size=(n, 16, 3)) * 0.05
    sh[:, 0] += 0.5
    return dataclasses.replace(
        scene,
        means=CENTRE + along * distance[:, None],
        log_scales=rng.uniform(0.4, 0.9, (n, 3)),
        sh=sh,
        logits=rng.uniform(-0.5, 1.0, n),
    )


LOST = 49
"""The Gaussian of `lost` whose row is not found."""


def lost() -> tuple[Scene, Camera]:
    """Return a scene and a camera with one Gaussian at x/z = 2.0 and y/z = 5.6, far beside the image.

    Three steps of Newton's method for its row end within the lens, at no solution.
    """
    strong = Projection(distortion=Distortion.of(k1=0.03, k2=0.01, p1=0.002, s1=0.003, s4=0.001))
    shutter = RollingShutter(MOVING.turn, MOVING.shift, "left")
    return around(60, seed=3), lens_camera("opencv").through(strong, shutter)


def beyond(scene: Scene, camera: Camera, limit: float = LIMIT) -> np.ndarray:
    """Return which Gaussians the lens sees and whose ellipses the limit changes."""
    free, bounded = (camera.sight(scene.means, 0.05, jacobian_limit=each) for each in (None, limit))
    return bounded.valid & (np.array(free.jacobian) != np.array(bounded.jacobian)).any(axis=(0, 1))


def lens_truth(
    scene: Scene, camera: Camera, limit: float | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return image, transmittance and expected depth of the reference, with exact extents and tile stops."""
    covs = build_cov3d_batch(np.exp(scene.log_scales), quat_to_R_batch(scene.quats))
    seen = camera.sight(scene.means)
    toward = np.stack(np.broadcast_arrays(*seen.direction), axis=-1)
    colors = eval_sh(3, scene.sh, toward / np.linalg.norm(toward, axis=-1, keepdims=True))
    opacities = 1 / (1 + np.exp(-scene.logits))
    exact = {"extent": "exact", "stop": "tile", "jacobian_limit": limit}
    image, T = render_gaussians(camera, scene.means, covs, colors, opacities, bg=BACKGROUND, **exact)
    depths = np.repeat(np.where(seen.valid, seen.depth, 0.0)[:, None], 3, axis=1)
    depth, _ = render_gaussians(camera, scene.means, covs, depths, opacities, **exact)
    return image, T, depth[..., 0]


STEPS = torch.tensor([4.0**-k for k in (1, 2, 3, 4, 5, 6, 1, 2, 3, 0, 0, 0, 1, 0, 1)], dtype=torch.float64)
"""Units in which coefficients are varied: past 90 degrees, k6 multiplies an angle to the power of 13."""

NAMES = ("means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities")


def differentiable(scene, camera):
    """Return the raw parameters and the tensors of a camera, which require gradients."""
    gaussians = scene.gaussians()
    tensors = CameraTensors.of(camera)
    raw = [getattr(gaussians, name).requires_grad_() for name in NAMES]
    R, eye, intrinsics, coefficients, motion = tensors.pose()
    units = None if coefficients is None else coefficients / STEPS
    pose = [tensor.requires_grad_() for tensor in (R, eye, intrinsics, units, motion) if tensor is not None]
    return raw, pose, tensors


def rebuilt(template, tensors):
    """Return a camera of other tensors."""
    parts = list(tensors)
    R, eye, intrinsics = parts[:3]
    rest = parts[3:]
    coefficients = STEPS * rest.pop(0) if template.coefficients is not None else None
    motion = rest.pop(0) if template.motion is not None else None
    return CameraTensors(
        R,
        eye,
        intrinsics,
        template.H,
        template.W,
        template.projection,
        coefficients,
        motion,
        template.readout,
        template.exposure,
    )
