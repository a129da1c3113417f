"""A traced capture with exact depth, written as COLMAP or transforms.json, and its depth maps in any form."""

import functools

import numpy as np
from PIL import Image

from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.scene.camera import Camera
from lab.captures.solids_photos import scan_solids, solids_capture

SIZE = (128, 96)
"""Width and height of the maps, px: twice the photos'."""


@functools.cache
def traced():
    """Ten photos of the solids, 64x48, with 3,000 start points."""
    return solids_capture("textured", 64, 10, start=3_000)


@functools.cache
def exact_depths(size=SIZE):
    """Return the exact camera depth at the pixels of a sensor of this size, for each view; 0 where nothing is."""
    made = traced()
    return [scan_solids(made.scene, small_camera(view.camera, size))[0] for view in made.views]


def small_camera(camera, size=SIZE):
    """Return the camera of a sensor that sees what the photo sees."""
    return Camera.posed(camera.R, camera.eye, camera.intrinsics.scaled(*size))


def ray_lengths(camera, size=SIZE):
    """Return the length of each pixel's ray at z = 1."""
    small = small_camera(camera, size)
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.sqrt(1 + ((u - small.cx) / small.fx) ** 2 + ((v - small.cy) / small.fy) ** 2)


def write_capture(folder, layout="colmap"):
    """Write the capture, without maps."""
    made = traced()
    write = write_colmap if layout == "colmap" else write_transforms
    write(folder, made.views, made.points, made.colors)
    return folder


def write_maps(folder, change=lambda depth, view: depth, scale=1000.0):
    """Write 16-bit PNGs of depth times a scale, one per photo.

    Args:
        folder: The folder of maps.
        change: Returns the map to write from the exact depth and the view.
        scale: Units of the files for a world unit.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for depth, view in zip(exact_depths(), traced().views, strict=True):
        values = np.clip(np.round(scale * change(depth, view)), 0, 65535).astype(np.uint16)
        Image.fromarray(values).save(folder / view.name)
    return folder


def views_of(dataset):
    """Return the views with depth, by name."""
    return {view.name: view for view in dataset.train if view.depth is not None}
