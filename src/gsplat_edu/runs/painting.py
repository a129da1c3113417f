"""A mesh painted with the photos of its scene's capture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.mesh.depths import DepthView, Progress
from gsplat_edu.mesh.faces import drawn_in
from gsplat_edu.mesh.texture import TextureSettings, TextureView, textured
from gsplat_edu.parts.transients.files import mask_path
from gsplat_edu.photos.decoding import decode_mask
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.scene.mesh import Mesh
from gsplat_edu.scene.photo import Photo, area_mean, resized_mask
from gsplat_edu.scene.views import View

HALF_OPAQUE = 128
"""Pixels of photos with a smaller alpha paint nothing."""


def painted(
    mesh: Mesh,
    dataset: Dataset,
    views: Sequence[DepthView],
    run: RunFolder | None = None,
    settings: TextureSettings | None = None,
    progress: Progress = lambda what, done, total: None,
) -> Mesh:
    """Give a mesh a texture from the training photos.

    What masks exclude, what a training with `transients` found to have moved, and what photos with alpha show less than
    half opaque, paints nothing.

    Args:
        mesh: The mesh, in the frame of the dataset's cameras.
        dataset: The capture; photos at the scene's exposure, as `gsplat_edu.runs.cleaning.open_subject` gives them.
        views: Depth maps of the scene, by the names of the photos; photos without one are not used.
        run: The scene's run, whose masks of things that move count; None for none.
        settings: Size and blending; None for the defaults.
        progress: Called before the mesh is laid out, "layout", and after every photo, "painting".

    Raises:
        ArgumentError: no photo has a depth map, or as for `textured`.
        DatasetError: a photo or a mask cannot be read.
    """
    photos = {view.name: view for view in dataset.train}
    used = [view for view in views if view.name in photos]
    if not used:
        raise ArgumentError("--texture: none of the depth maps is of a photo of the capture; check --dataset")
    progress("layout", 0, 1)
    return textured(mesh, _views(used, photos, run, progress), settings)


def _views(
    views: Sequence[DepthView], photos: Mapping[str, View], run: RunFolder | None, progress: Progress
) -> Iterator[TextureView]:
    """Yield the photos one by one, at the size of their depth maps, or drawn in the faces of their lens."""
    for done, view in enumerate(views):
        progress("painting", done, len(views))
        photo = photos[view.name].read()
        camera = view.camera if view.lens is None else view.lens
        H, W = camera.H, camera.W
        image = _bytes(photo)
        counts = np.ones(image.shape[:2], dtype=bool)
        if photo.mask is not None:
            counts &= photo.mask
        if photo.alpha is not None:
            counts &= photo.alpha >= HALF_OPAQUE
        if image.shape[:2] != (H, W):
            image = area_mean(image, W, H)
            counts = resized_mask(counts, H, W)
        if run is not None and (path := mask_path(run.path, view.name)).is_file():
            counts &= resized_mask(decode_mask(path), H, W)
        if view.lens is not None:
            image, inside = drawn_in(view.camera, view.depth, camera, image)
            shown, _ = drawn_in(view.camera, view.depth, camera, counts.astype(np.uint8), cv2.INTER_NEAREST)
            counts = inside & (shown > 0)
        yield TextureView(view.camera, image, np.where(counts, view.depth, np.float32(0)))
    progress("painting", len(views), len(views))


def _bytes(photo: Photo) -> UInt8[np.ndarray, "H W 3"]:
    if photo.image.dtype == np.uint8:
        return np.ascontiguousarray(photo.image)
    return np.rint(255.0 * np.clip(photo.image, 0.0, 1.0)).astype(np.uint8)
