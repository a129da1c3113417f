"""A term that makes neighbouring photos agree when they are seen through the rendered surface."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.ops.patches import GreyPhoto, Grid, patch_error
from gsplat_edu.render.camera_tensors import split_camera
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.views import View
from gsplat_edu.train.rendered import Needs, Rendered, Turns
from gsplat_edu.train.view_model import ViewModel

PATCHES = "patches"
"""Name of the term."""

PATCH_COUNT = 4_000
"""About how many patches of a photo are compared in a step."""

NEIGHBOURS = 8
"""Most neighbours of a view."""

WIDEST = 30.0
"""Largest angle between the directions of view of neighbours, degrees, as in Chen et al. 2024 (PGSR)."""

WIDEST_FISHEYE = 60.0
"""The same of two fisheyes, which see much more than a photo."""

AROUND = 2 * NEIGHBOURS
"""A panorama's neighbours are spread over this many of the nearest panoramas, since the angle excludes none."""

SHORTEST = 0.01
"""Smallest distance between neighbours, as a fraction of the scene's size: from nearer ones, depth can't be told."""

PHOTO_ROOM = 1 << 28
"""Bytes of photos without colours that are kept in memory; others are read again."""

PATCH_STREAM = 5
"""Tells the random choices of the term apart from others of the same seed."""


def neighbours_of(cameras: Sequence[Camera], extent: float) -> list[tuple[int, ...]]:
    """Return for each camera those that see its subject from elsewhere: at most `NEIGHBOURS`, from near to far.

    They are spread evenly over all cameras within `WIDEST` and beyond `SHORTEST`, ordered by distance; among cameras at
    the same distance the lower index comes first. Two fisheyes may differ by `WIDEST_FISHEYE`, and two panoramas by any
    angle, of which the nearest `AROUND` count.

    Args:
        cameras: The cameras.
        extent: Size of the scene, world units.
    """
    eyes = np.array([camera.eye for camera in cameras])
    directions = np.array([camera.R[2] for camera in cameras])
    kinds = np.array([camera.projection.kind for camera in cameras])
    found = []
    for eye, direction, kind in zip(eyes, directions, kinds, strict=True):
        distances = np.linalg.norm(eyes - eye, axis=1)
        least = np.where(kinds == kind, _least_cosine(kind), math.cos(math.radians(WIDEST)))
        near = (directions @ direction >= least) & (distances >= SHORTEST * extent)
        count = min(int(near.sum()), AROUND) if kind == "equirectangular" else int(near.sum())
        ordered = np.argsort(np.where(near, distances, np.inf), kind="stable")[:count]
        places = np.linspace(0, len(ordered) - 1, min(NEIGHBOURS, len(ordered)))
        found.append(tuple(ordered[np.round(places).astype(int)].tolist()))
    return found


def _least_cosine(kind: str) -> float:
    """Return the smallest cosine between the directions of view of neighbours with this kind of projection."""
    if kind == "equirectangular":
        return -math.inf
    return math.cos(math.radians(WIDEST_FISHEYE if kind == "fisheye" else WIDEST))


class Neighbourhood:
    """The photos of a training without colours, and which of them are neighbours.

    Args:
        views: The training's views, at full size.
        model: Says where a view's camera is now.
        extent: Size of the scene, world units.
    """

    def __init__(self, views: Sequence[View], model: ViewModel, extent: float) -> None:
        self.views, self._model = tuple(views), model
        self.neighbours = neighbours_of([view.camera for view in views], extent)
        self._kept: OrderedDict[tuple[int, int, int], GreyPhoto] = OrderedDict()
        self._bytes, self._factor = 0, 1.0

    def photos(self, index: int, view: View, other: int) -> tuple[GreyPhoto, GreyPhoto]:
        """Return a view's photo and another one's of the same scale, with the cameras of the view model.

        Args:
            index: The view.
            view: The view in the size that the step renders.
            other: The other view.
        """
        factor = self.views[index].camera.W / view.camera.W
        if factor != self._factor:
            self._kept.clear()
            self._bytes, self._factor = 0, factor
        return self._photo(index, view), self._photo(other, self.views[other].scaled(factor))

    def _photo(self, index: int, view: View) -> GreyPhoto:
        camera, _ = split_camera(self._model.camera(index, view.camera))
        key = index, camera.H, camera.W  # rounded sides may differ by a pixel
        found = self._kept.pop(key, None)
        if found is None:
            found = GreyPhoto.of(view.read(), camera)
            self._bytes += found.nbytes
        self._kept[key] = found  # the last one used
        while self._bytes > PHOTO_ROOM and len(self._kept) > 1:
            self._bytes -= self._kept.popitem(last=False)[1].nbytes
        return GreyPhoto(camera, found.pixels, found.counts)


class PatchTerm:
    """Makes patches of a photo agree with a neighbouring photo: `gsplat_edu.ops.patches.patch_error`.

    In each step that evaluates it, one neighbour of the view and the grid's first pixel are drawn from the seed and the
    iteration, so a resumed training draws the same.

    Args:
        weight: Factor of the value, on the average of all steps.
        turns: The steps that compare patches.
        around: The photos and their neighbours.
        seed: The training's seed.
    """

    def __init__(self, weight: float, turns: Turns, around: Neighbourhood, seed: int) -> None:
        self.weight, self._turns, self._around, self._seed = weight, turns, around, seed

    @property
    def needs(self) -> Needs:
        """Depth and normals, in its turns."""
        return Needs(normals=True, turns=self._turns)

    def __call__(self, rendered: Rendered) -> Float[Tensor, ""]:
        """Return weight every mean min(1 - ncc, MOST), 0 if the view has no neighbour.

        Raises:
            ArgumentError: the normals or the depth were not rendered.
        """
        index = rendered.draw.index
        neighbours = self._around.neighbours[index]
        if not neighbours or not self._turns.due(rendered.iteration):
            return rendered.output.image.new_zeros(())
        surface = rendered.surface
        if surface.normals is None or surface.depth is None:
            raise ArgumentError(
                "patches: needs the depth, and `facing_normals` composited as `output.features`"
            )
        rng = np.random.default_rng((self._seed, PATCH_STREAM, rendered.iteration, index))
        neighbour = neighbours[int(rng.integers(len(neighbours)))]
        photo, other = self._around.photos(index, rendered.draw.view, neighbour)
        stride = max(1, math.isqrt(photo.pixels.size // PATCH_COUNT))
        grid = Grid(stride, *rng.integers(stride, size=2).tolist())
        weight = self.weight * self._turns.every
        return patch_error(surface.normals, surface.depth, surface.alpha, photo, other, grid, weight).value
