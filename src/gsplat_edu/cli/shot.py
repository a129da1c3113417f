"""What `gsplat-edu render` draws: a scene, cameras and maps, and the lens of --camera-model in front of them."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.evaluate.images import VIDEO_SUFFIX
from gsplat_edu.options.render import FISHEYE_DEGREES, LensChoice, lens_choice
from gsplat_edu.paths.lenses import (
    LEVEL,
    PANORAMA_SIDES,
    Plan,
    circle,
    fisheye,
    floor_plan,
    orthographic,
    panorama,
)
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import WORLD_UP, Camera
from gsplat_edu.scene.frame import ORIGIN
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.shells import far_shell

PLAN = "plan"
"""Name of the folder and the image of a floor plan."""


@dataclass(frozen=True)
class Shot:
    """The images to render.

    Args:
        gaussians: The scene.
        cameras: One per image.
        names: File names of the images in a folder; None numbers them.
        settings: Render settings.
        path: The kind of camera path and the reason for it; "" for the dataset's cameras and for keyframes.
        maps: Names of the maps to write beside the images.
        origin: Position of the zero of splats and cameras in the capture's coordinates.
        up: The scene's up direction.
        unit: What one unit of the coordinates is, "m", "cm" or "mm"; None if unknown.
        sphere: Whether the images are equirectangular.
        inside: (H, W) which pixels are drawn, of every image; None for all.
        through_lenses: Whether the scene was trained through lenses; pinholes then show `within_field`.
    """

    gaussians: Gaussians
    cameras: Sequence[Camera]
    names: Sequence[str] | None
    settings: RenderSettings
    path: str = ""
    maps: Sequence[str] = ()
    origin: Sequence[float] = ORIGIN
    up: Sequence[float] = WORLD_UP
    unit: str | None = None
    sphere: bool = False
    inside: Bool[np.ndarray, "H W"] | None = None
    through_lenses: bool = False

    def within(
        self, image: Float[np.ndarray, "H W 3"], maps: Mapping[str, np.ndarray]
    ) -> tuple[Float[np.ndarray, "H W 3"], dict[str, np.ndarray]]:
        """Return an image with the background, and maps with 0, where nothing is drawn."""
        if self.inside is None:
            return image, dict(maps)
        kept = self.inside[..., None]
        background = np.asarray(self.settings.background, image.dtype)
        cut = {
            name: np.where(kept if a.ndim == 3 else self.inside, a, a.dtype.type(0))
            for name, a in maps.items()
        }
        return np.where(kept, image, background), cut


def plan_asked_for(arguments: argparse.Namespace, has_path: bool) -> bool:
    """Say whether a floor plan is asked for: an orthographic lens and no path."""
    elsewhere = has_path or arguments.orbit or arguments.dataset is not None
    return lens_choice(arguments.camera_model).kind == "orthographic" and not elsewhere


def check_lens(arguments: argparse.Namespace, maps: Sequence[str], planned: bool) -> None:
    """Check --camera-model with the other options, before anything is rendered.

    Raises:
        ArgumentError: it does not go with one of them.
    """
    choice, size = lens_choice(arguments.camera_model), arguments.size
    if choice.kind == "equirectangular" and size is not None and size % PANORAMA_SIDES:
        raise ArgumentError(
            f"--size: is {size}, but an equirectangular image is twice as wide as high, and videos have even sides;"
            f" give a multiple of {PANORAMA_SIDES}"
        )
    if choice.kind == "orthographic" and "planar-depth" in maps:
        raise ArgumentError(
            "--maps: planar-depth needs rays from one point, which an orthographic lens has not; use depth"
        )
    if choice.kind == "orthographic" and choice.value is not None and not planned:
        raise ArgumentError(
            "--camera-model: a height is only for a plan, without --orbit, --path and --dataset"
        )
    if planned and arguments.frames is not None:
        raise ArgumentError("--frames: a plan is one image; remove it, or give --orbit")
    if planned and arguments.out is not None and arguments.out.suffix.lower() == VIDEO_SUFFIX:
        raise ArgumentError(
            f"--out: a plan is one image; give a folder instead of {arguments.out}, or --orbit"
        )


def through_lens(shot: Shot, choice: LensChoice, size: int | None, planned: bool) -> Shot:
    """Return the shot through a lens.

    Args:
        shot: Through a pinhole.
        choice: The lens.
        size: Longer side of the images, px; None for that of the cameras.
        planned: Whether a floor plan takes the place of the cameras.
    """
    first = shot.cameras[0]
    size = size or max(first.W, first.H)
    if planned:
        plan = floor_plan(shot.gaussians, shot.up, size, shot.settings.z_near, choice.value)
        return replace(shot, cameras=[plan.camera], names=[f"{PLAN}.png"], path=described(plan, shot.unit))
    if choice.kind == "fisheye":
        cameras = [fisheye(camera, choice.value or FISHEYE_DEGREES, size) for camera in shot.cameras]
        return replace(shot, cameras=cameras, inside=circle(size))
    if choice.kind == "equirectangular":
        width = max(size // PANORAMA_SIDES, 1) * PANORAMA_SIDES
        return replace(
            shot, cameras=[panorama(camera, shot.up, width) for camera in shot.cameras], sphere=True
        )
    if choice.kind == "orthographic":
        depth = median_depth(shot.gaussians, first)
        return replace(shot, cameras=[orthographic(camera, depth) for camera in shot.cameras])
    return shot


def described(plan: Plan, unit: str | None) -> str:
    """Return a sentence about a floor plan: its scale and size."""
    units, one = (unit, unit) if unit else ("world units", "world unit")
    north = "+z" if -plan.camera.R[1, 2] > LEVEL / 2 else "+x"
    cut = "" if plan.cut is None else f", drawn up to {plan.cut:.4g}"
    return (
        f"floor plan: {plan.camera.fx:.5g} px per {one}, {plan.width:.4g} x {plan.height:.4g} {units}"
        f" with {north} at the top; the scene is {plan.top:.4g} high{cut}"
    )


def median_depth(gaussians: Gaussians, camera: Camera) -> float:
    """Return the median depth of the Gaussians in front of a camera, without a sky: about its subject's distance."""
    means = gaussians.means.numpy(force=True)
    depths = camera.world_to_cam(means[~far_shell(means)])[:, 2]
    ahead = depths[depths > 0]
    return float(np.median(ahead)) if ahead.size else 1.0
