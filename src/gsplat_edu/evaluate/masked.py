"""Pictures of masked parts for a report: a photo with its mask outlined, beside the render."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8
from scipy import ndimage

from gsplat_edu.evaluate.images import small_jpeg

OUTLINE = (255, 30, 30)
"""Colour of the outline; the masked pixels are tinted with it."""

TINT = 0.35
"""Weight of that colour inside the outline."""

THICKNESS = 300
"""The outline is this fraction of the photo's longer side thick: a pixel or two in a report."""


@dataclass(frozen=True)
class MaskedPicture:
    """A photo with a masked part, and its render, as JPEG.

    Args:
        name: The view's name in the capture.
        share: Fraction of the photo that is masked.
        photo: The photo with its mask outlined.
        render: The render.
    """

    name: str
    share: float
    photo: bytes
    render: bytes

    @classmethod
    def of(
        cls,
        name: str,
        photo: UInt8[np.ndarray, "H W 3"],
        masked: Bool[np.ndarray, "H W"],
        render: UInt8[np.ndarray, "H W 3"],
    ) -> MaskedPicture:
        """Make the pictures of a view, as small as those of a report.

        Args:
            name: The view's name in the capture.
            photo: (H, W, 3) photo.
            masked: (H, W) true for masked pixels.
            render: (H, W, 3) rendered.
        """
        return cls(name, float(masked.mean()), small_jpeg(outlined(photo, masked)), small_jpeg(render))


def outlined(
    photo: UInt8[np.ndarray, "H W 3"], masked: Bool[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Return a photo with its masked pixels tinted and outlined.

    Args:
        photo: (H, W, 3) photo.
        masked: (H, W) true for masked pixels.
    """
    color = np.array(OUTLINE, dtype=np.float32)
    tinted = np.where(masked[..., None], photo + TINT * (color - photo), photo)
    width = max(1, round(max(masked.shape) / THICKNESS))
    border = masked & ~ndimage.binary_erosion(masked, iterations=width)
    return np.round(np.where(border[..., None], color, tinted)).astype(np.uint8)


def masked_figures(pictures: Sequence[MaskedPicture]) -> str:
    """Return the pictures as HTML; empty if there are none."""
    return "".join(_figure(picture) for picture in pictures)


def _figure(picture: MaskedPicture) -> str:
    name = html.escape(picture.name)
    panels = "".join(
        f'<div class="difference"><img alt="{title}" src="data:image/jpeg;base64,'
        f'{base64.b64encode(data).decode("ascii")}"></div>'
        for title, data in (("photo with its mask", picture.photo), ("render", picture.render))
    )
    caption = f"{name}: {100 * picture.share:.1f} % masked"
    return f"<figure><div>{panels}</div><figcaption>{caption}</figcaption></figure>\n"
