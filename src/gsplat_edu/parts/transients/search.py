"""Masks of things that move, found several times while the scene is trained.

`gsplat_edu.parts.transients.masks` says how. Masked pixels do not count in the loss, as those that the capture's own
masks exclude. Masks are found anew each time: where other views have explained a pixel by then, it counts again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.parts.transients.masks import Compared, FeatureRenderer, find_masks
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.photo import resized_mask
from gsplat_edu.scene.views import View
from gsplat_edu.train.feed import Target
from gsplat_edu.train.saved import check_entries, check_tensor_kind

WHEN = (0.1, 0.2, 0.35, 0.5)
"""Shares of the run after which masks are found: early, before the scene shows passers-by as floaters, and until most
of the scene is there to compare with."""

LONGEST = 192
"""Photos are compared at a size whose longer side is at most this, px, and at most that of the step's photos."""

FEWEST = 5
"""Fewest training views; with fewer, there is too little to compare a photo with."""

MASKS, TOO_LARGE = "masks", "too_large"
"""Names of the state's tensors."""


class Transients:
    """Which pixels of the training photos do not count because they show what other photos do not.

    Args:
        views: The training views, at their full size.
        iterations: Length of the schedule.
        render: Renders features; see `gsplat_edu.render.api.render`.

    Raises:
        ArgumentError: there are fewer than `FEWEST` views.

    Attributes:
        masks: For each view, (h, w) true for the pixels that do not count, at a reduced size; None if all count.
        too_large: (views,) whether a view is left alone because too much of it differs.
    """

    def __init__(self, views: Sequence[View], iterations: int, render: FeatureRenderer) -> None:
        check_enough(len(views))
        self._views, self._render = tuple(views), render
        self._when = {max(round(share * iterations), 1) for share in WHEN}
        self._sizes = [(small.camera.H, small.camera.W) for small in (reduced(view) for view in views)]
        self.masks: list[Bool[np.ndarray, "h w"] | None] = [None] * len(views)
        self.too_large: Bool[np.ndarray, " views"] = np.zeros(len(views), dtype=bool)

    def is_due(self, iteration: int, batch: int = 1) -> bool:
        """Return whether masks are found before the step of `batch` images whose first is `iteration`."""
        return any(iteration <= when < iteration + batch for when in self._when)

    def find(
        self,
        gaussians: Gaussians,
        settings: RenderSettings,
        camera: Callable[[int, Camera], Camera | CameraTensors],
        factor: float,
    ) -> None:
        """Find the masks of all views.

        Args:
            gaussians: The scene.
            settings: Render settings of the step.
            camera: Returns the camera to render a view from, from its index and its camera.
            factor: Divisor of the size of the step's photos.

        Raises:
            DatasetError: a photo cannot be read. The masks are unchanged.
        """
        small = [reduced(view, factor) for view in self._views]
        found = find_masks(gaussians, small, Compared(self._render, settings, camera))
        self.masks = [
            resized_mask(one.mask, *size) if one.mask.any() else None
            for one, size in zip(found, self._sizes, strict=True)
        ]
        self.too_large = np.array([one.too_large for one in found])

    def applied(self, index: int, target: Target) -> Target:
        """Return a target without the pixels that are masked in its view."""
        mask = self.masks[index]
        if mask is None:
            return target
        counts = torch.from_numpy(~resized_mask(mask, *target.image.shape[:2])).to(target.image.device)
        counts = counts if target.mask is None else counts & target.mask
        return replace(target, mask=counts)

    def state(self) -> dict[str, Tensor]:
        """Return the state for a checkpoint: the bits of all masks, and which views are left alone."""
        planes = [
            np.packbits(np.zeros(size, dtype=bool) if mask is None else mask)
            for mask, size in zip(self.masks, self._sizes, strict=True)
        ]
        return {
            MASKS: torch.from_numpy(np.concatenate(planes)),
            TOO_LARGE: torch.from_numpy(self.too_large.astype(np.uint8)),
        }

    def check_state(self, state: Mapping[str, Tensor]) -> None:
        """Check a state before `load_state` uses it.

        Raises:
            ArgumentError: the state does not fit these views; the message names the entry.
        """
        given = check_entries("transients", dict(state), (MASKS, TOO_LARGE))
        length = sum(-(-H * W // 8) for H, W in self._sizes)
        for name, count in ((MASKS, length), (TOO_LARGE, len(self._sizes))):
            check_tensor_kind(f"transients.{name}", given[name], torch.uint8, (count,))
        if bool((given[TOO_LARGE] > 1).any()):
            raise ArgumentError(f"transients.{TOO_LARGE}: has to be 0 or 1")

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self.check_state(state)
        packed, at = state[MASKS].numpy(), 0
        masks: list[Bool[np.ndarray, "h w"] | None] = []
        for H, W in self._sizes:
            length = -(-H * W // 8)
            mask = np.unpackbits(packed[at : at + length], count=H * W).reshape(H, W).astype(bool)
            masks.append(mask if mask.any() else None)
            at += length
        self.masks, self.too_large = masks, state[TOO_LARGE].numpy().astype(bool)


def check_enough(count: int) -> None:
    """Check the number of training views.

    Raises:
        ArgumentError: there are fewer than `FEWEST`.
    """
    if count < FEWEST:
        raise ArgumentError(
            f"transients: {count} training photos are too few to tell what moved; give at least {FEWEST}, or"
            " none"
        )


def reduced(view: View, factor: float = 1.0) -> View:
    """Return a view at the size at which it is compared, if the step divides the sides of photos by a factor."""
    return view.scaled(max(factor, max(view.camera.W, view.camera.H) / LONGEST))
