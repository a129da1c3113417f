"""A dataset's views as a torch Dataset: images as tensors, with their cameras, whole or cropped."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, float64_array, whole_number
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.views import View


class ViewTensors(NamedTuple):
    """A photo, or a part of it, and its camera.

    Args:
        image: (H, W, 3) colour, float32, 0 to 1, over the background if the photo is transparent.
        camera: The camera; that of a part has its principal point moved.
        mask: (H, W) true for pixels that count.
        name: The view's name in the capture.
    """

    image: Float[Tensor, "H W 3"]
    camera: Camera
    mask: Bool[Tensor, "H W"]
    name: str


class ViewBatch(NamedTuple):
    """B views of one size. `gsplat_edu.render` draws a sequence of cameras in one call.

    Args:
        images: (B, H, W, 3) colours, float32, 0 to 1.
        cameras: The B cameras.
        masks: (B, H, W) true for pixels that count.
        names: The B names.
    """

    images: Float[Tensor, "B H W 3"]
    cameras: tuple[Camera, ...]
    masks: Bool[Tensor, "B H W"]
    names: tuple[str, ...]


class ViewDataset(torch.utils.data.Dataset[ViewTensors]):
    """Views for a `torch.utils.data.DataLoader`, with `collate_fn=ViewDataset.collate`.

    Random crops depend on the seed, the epoch and the view only: any number of workers gives the same bytes.

    Args:
        views: The views.
        crop: (height, width) of the crops, px; None for whole photos.
        corner: (row, column) of the first pixel of every crop; None draws one at random for each view and epoch.
        background: (3,) colour behind transparent photos, 0 to 1.
        seed: Seed of the random corners.

    Raises:
        ArgumentError: a number is out of range, a photo is smaller than the crop, or a camera cannot be cropped.
        ShapeError: crop, corner or background has another number of entries.
    """

    def __init__(
        self,
        views: Sequence[View],
        *,
        crop: tuple[int, int] | None = None,
        corner: tuple[int, int] | None = None,
        background: ArrayLike = (0.0, 0.0, 0.0),
        seed: int = 0,
    ) -> None:
        self.views = tuple(views)
        self.crop = None if crop is None else _pair("crop", crop, 1)
        self.corner = None if corner is None else _pair("corner", corner, 0)
        self.background = float64_array("background", background, (3,))
        self.seed = whole_number("seed", seed, 0)
        self._epoch = torch.zeros((), dtype=torch.int64)
        self._epoch.share_memory_()  # type: ignore[no-untyped-call]  # workers that live on see it change
        if self.corner is not None and self.crop is None:
            raise ArgumentError("corner: is that of a crop; give crop=(height, width) as well")
        if self.crop is not None:
            for view in self.views:
                view.camera.cropped(*(self.corner or (0, 0)), *self.crop)

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.views)

    def __repr__(self) -> str:
        """Return one line: the number of views, and the size of their crops."""
        parts = "" if self.crop is None else f", crops of {self.crop[1]}x{self.crop[0]} px"
        return f"ViewDataset({len(self)} views{parts})"

    def set_epoch(self, epoch: int) -> None:
        """Draw other random corners. Call it before each pass over the views.

        Args:
            epoch: Number of the pass, at least 0.

        Raises:
            ArgumentError: it is not a whole number of at least 0.
        """
        self._epoch.fill_(whole_number("epoch", epoch, 0))

    def __getitem__(self, index: int) -> ViewTensors:
        """Read a view.

        Args:
            index: Its number.

        Raises:
            IndexError: there is no such view.
            DatasetError: its photo cannot be read.
        """
        view = self.views[index]
        photo, camera = view.read(), view.camera
        pixels = np.asarray(photo.over(self.background))
        mask = np.ones(pixels.shape[:2], bool) if photo.mask is None else photo.mask
        if self.crop is not None:
            (H, W), (top, left) = self.crop, self._corner(index % len(self), camera)
            camera = camera.cropped(top, left, H, W)
            rows, columns = slice(top, top + H), slice(left, left + W)
            pixels, mask = pixels[rows, columns], mask[rows, columns]
        image = torch.tensor(pixels, dtype=torch.float32)
        if pixels.dtype == np.uint8:
            image /= 255.0
        return ViewTensors(image, camera, torch.tensor(mask), view.name)

    def _corner(self, index: int, camera: Camera) -> tuple[int, int]:
        """Return row and column of the first pixel of a view's crop."""
        if self.corner is not None or self.crop is None:
            return self.corner or (0, 0)
        random = np.random.default_rng((self.seed, int(self._epoch), index))
        H, W = self.crop
        return int(random.integers(camera.H - H + 1)), int(random.integers(camera.W - W + 1))

    @staticmethod
    def collate(items: Sequence[ViewTensors]) -> ViewBatch:
        """Join views of one size to a batch: the `collate_fn` of a DataLoader.

        Args:
            items: The views; at least one.

        Raises:
            ArgumentError: their sizes differ.
        """
        images, cameras, masks, names = zip(*items, strict=True)
        if len({image.shape for image in images}) > 1:
            raise ArgumentError(
                "batch: its photos differ in size; give crop=(height, width), or batch_size=1"
            )
        return ViewBatch(torch.stack(images), cameras, torch.stack(masks), names)


def _pair(name: str, pair: tuple[int, int], least: int) -> tuple[int, int]:
    """Check two whole numbers."""
    float64_array(name, pair, (2,))
    return whole_number(f"{name}[0]", pair[0], least), whole_number(f"{name}[1]", pair[1], least)
