"""What counts in a block: the pixels of its views that show its cell or the margin around it.

A photo at a border shows two cells. The other block learns the pixels that show its cell, which it sees in more photos.
A block that learned them too would spend its Gaussians on what merging removes.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from gsplat_edu.blocks.plan import Area, Cell
from gsplat_edu.blocks.views import SIDE, Renderer, in_any_view
from gsplat_edu.paths.orbits import resized
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.photo import Photo, resized_mask
from gsplat_edu.scene.views import View

SHARE = 0.25
"""A pixel counts if at least this share of the light of its Gaussians comes from the cell and its margin."""

KNOWN = 0.25
"""Pixels whose Gaussians weigh less than this in all count in every block: the coarse model does not know them."""

MASK_SIDE = 256
"""Longer side of the masks, px; they are enlarged for larger photos."""

AROUND = 2
"""px of a mask: this far around the pixels that count, pixels count too, because the coarse model is blurred."""

LEAST_LIGHT = 0.25
"""A Gaussian outside the cell belongs to the start if it weighs more than this in all counted pixels of a view of
`SIDE` px together."""

Mask = Bool[np.ndarray, "H W"]


class Counted:
    """Finds the pixels that count in a block, by renders of Gaussians of the coarse model.

    Args:
        area: The ground.
        core: The block's cell.
        gaussians: The coarse model, or the part of it from which the block starts.
        render: Renders them with features.
    """

    def __init__(self, area: Area, core: Cell, gaussians: Gaussians, render: Renderer) -> None:
        self._gaussians, self._render = gaussians, render
        places = area.ground.coordinates(gaussians.means.numpy(force=True))
        self.inside: Bool[np.ndarray, " N"] = core.enlarged(area.low, area.high).holds(places)
        columns = torch.from_numpy(np.stack([self.inside, np.ones_like(self.inside)], axis=1))
        self._columns = columns.to(gaussians.means)  # their sums over a pixel: of the cell, and of all

    def mask(self, camera: Camera) -> Mask:
        """Return the pixels of a view that count, or all if none does.

        Args:
            camera: The view's camera.

        Returns:
            (H, W) of the camera, reduced to a longer side of `MASK_SIDE` if it is larger.
        """
        with torch.no_grad():
            shown = self._render(self._gaussians, _reduced(camera, MASK_SIDE), self._columns)
        assert shown.features is not None
        return _counting(shown.features)

    def start(self, cameras: Sequence[Camera]) -> Bool[np.ndarray, " N"]:
        """Return the Gaussians that a block needs: those in the cell and its margin, and what else counted pixels show.

        Args:
            cameras: Those of the block's views.
        """
        near = torch.from_numpy(np.flatnonzero(self.inside | in_any_view(self._gaussians, cameras)))
        part = self._gaussians.map(functools.partial(torch.index_select, dim=0, index=near))
        columns = self._columns[near]
        seen = np.zeros(len(part), dtype=bool)
        for camera in cameras:
            # The gradient of a channel, summed over pixels, in its features is the sum of a Gaussian's weights there.
            marks = torch.zeros_like(columns[:, :1]).requires_grad_()
            shown = self._render(part, _reduced(camera, SIDE), torch.cat([columns, marks], dim=1)).features
            assert shown is not None
            counts = torch.from_numpy(_counting(shown.detach())).to(shown)
            upstream = torch.stack([torch.zeros_like(counts)] * 2 + [counts], dim=2)
            shown.backward(upstream)  # type: ignore[no-untyped-call]
            assert marks.grad is not None
            seen |= marks.grad[:, 0].numpy(force=True) > LEAST_LIGHT
        needed = self.inside.copy()
        needed[near.numpy()] |= seen
        return needed


def counted_views(views: Sequence[View], counted: Counted) -> tuple[View, ...]:
    """Return views in whose photos only the pixels count that count in a block, and in their own masks.

    Args:
        views: Training views of the block.
        counted: Finds the pixels.
    """
    return tuple(_masked(view, counted.mask(view.camera)) for view in views)


def _masked(view: View, mask: Mask) -> View:
    bits, columns = np.packbits(mask, axis=1), mask.shape[1]

    read = partial(_read_masked, view, bits, columns)
    return View.stored(view.camera, read, view.name).with_depth(view.depth)


def _read_masked(view: View, bits: UInt8[np.ndarray, "h w"], columns: int) -> Photo:
    small = np.unpackbits(bits, axis=1, count=columns)
    return view.read().counting(resized_mask(small.view(np.bool_), view.camera.H, view.camera.W))


def _reduced(camera: Camera, longest: int) -> Camera:
    return resized(camera, longest) if max(camera.W, camera.H) > longest else camera


def _counting(shown: Tensor) -> Mask:
    """Return the pixels that count, by the weights of the Gaussians inside and of all, (H, W, 2 or more)."""
    of_cell, of_all = (shown[..., k].double().numpy(force=True) for k in range(2))
    counts = (of_cell >= SHARE * of_all) | (of_all < KNOWN)
    side = 2 * AROUND + 1
    around = cv2.dilate(counts.astype(np.uint8), np.ones((side, side), np.uint8))
    found: Mask = around.astype(bool)
    return found if found.any() else np.ones_like(found)
