"""Equirectangular panoramas, cut into pinhole faces.

The column of a panorama is the longitude, its row the latitude. With the panorama's axes +x right, +y down and +z
forward, towards its middle, a ray (x, y, z) is seen at longitude atan2(x, z) and latitude -asin(y / |(x, y, z)|):

u = W (longitude / 2 pi + 1/2) - 1/2,   v = H (1/2 - latitude / pi) - 1/2      (pixel centres have integer coordinates)

Source: COLMAP's documentation, "Camera Models", EQUIRECTANGULAR; Google's Photo Sphere XMP.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from gsplat_edu.base.errors import DatasetError, ShapeError
from gsplat_edu.data.lens import MAX_REMAPPED, Lens, bands
from gsplat_edu.scene.intrinsics import Intrinsics
from gsplat_edu.scene.photo import area_mean, premultiplied, smaller_mask, unweighted

PITCHES = (33.0, -33.0)
"""Pitch of the two rings of faces, degrees; positive looks up. A face of 90 degrees reaches from 12 degrees across the
horizon to 78 degrees. At 34 degrees and more, the faces leave gaps near the horizon."""

PER_RING = 4
"""Faces of a ring, a quarter turn apart. The rings are turned by half of that against each other, so that the middles
of one overlap the edges of the other."""

FACES = len(PITCHES) * PER_RING
"""Faces of a panorama: 4/3 of the sphere's area. Everything up to 73 degrees from the horizon is in at least one; the
poles, with the sky above and the tripod below, are not used."""

LARGEST_FACE = 1600
"""Longest side of a face unless the user gives one, px: the size at which features are detected."""

FINER = 1.0
"""Smallest number of samples per panorama pixel at the horizon, along each axis. Samples are averaged to a face's
pixels; twice as many change a face by 0.05 dB at most."""

MARGIN = 4
"""Columns repeated on each side of the panorama, so that no interpolation sees a border at +-180 degrees."""

PANORAMIC = "equirectangular"
"""Model of `FaceLens`; it has no formula on the plane."""


@dataclass(frozen=True)
class FaceLens(Lens):
    """The lens of one face of a panorama. Its sizes are those of the panorama.

    Args:
        number: Index in `face_rotations`.
    """

    number: int = 0

    @classmethod
    def of(cls, W: int, H: int, number: int) -> FaceLens:
        """Return the lens of a face of a panorama.

        Raises:
            DatasetError: the size is not a panorama's.
        """
        if not is_panorama_size(W, H):
            raise DatasetError(
                f"size {W}x{H} is not a panorama's, which is 2:1 and narrower than {MAX_REMAPPED} px"
            )
        focal = W / (2.0 * math.pi)  # px per radian
        return cls(W, H, focal, focal, (W - 1) / 2, (H - 1) / 2, (), PANORAMIC, number)

    @property
    def described(self) -> str:
        """The model in words."""
        return "equirectangular panorama"

    @property
    def cropped(self) -> bool:
        """False: other faces show the rest of the panorama."""
        return False

    @property
    def R(self) -> Float64[np.ndarray, "3 3"]:
        """Rotation from the panorama's axes to the face's."""
        return face_rotations()[self.number]

    def undistorted(self) -> Intrinsics:
        """Return the pinhole of the face; its size differs from the panorama's."""
        return face_pinhole(face_side(self.W))


def face_rotations() -> list[Float64[np.ndarray, "3 3"]]:
    """Return the rotations from the panorama's axes to those of each face, OpenCV axes. None of the faces is rolled."""
    found = []
    for ring, pitch in enumerate(PITCHES):
        for number in range(PER_RING):
            yaw = math.radians(360.0 / PER_RING * (number + ring / len(PITCHES)))
            up = math.radians(pitch)
            turn = np.array(
                [[math.cos(yaw), 0, -math.sin(yaw)], [0, 1, 0], [math.sin(yaw), 0, math.cos(yaw)]]
            )
            tilt = np.array([[1, 0, 0], [0, math.cos(up), math.sin(up)], [0, -math.sin(up), math.cos(up)]])
            found.append(tilt @ turn)
    return found


def face_side(width: int, largest: int | None = None) -> int:
    """Return the side of the faces of a panorama, px.

    At the middle of a face of 90 degrees, side / 2 px are one radian; of the panorama, W / (2 pi) px are. The side at
    which both are equal keeps all detail.

    Args:
        width: The panorama's width, px.
        largest: Largest side, px; None means `LARGEST_FACE`.
    """
    return max(2, min(round(width / math.pi), LARGEST_FACE if largest is None else largest))


def face_pinhole(side: int) -> Intrinsics:
    """Return the intrinsics of a face of 90 degrees.

    Args:
        side: Its width and height, px.
    """
    return Intrinsics(side, side, side / 2, side / 2, (side - 1) / 2, (side - 1) / 2)


def is_panorama_size(W: int, H: int) -> bool:
    """Return whether a photo has the shape of a whole panorama, 2:1 up to rounding, and can be resampled."""
    return abs(W - 2 * H) <= 2 and 8 <= W < MAX_REMAPPED - 2 * MARGIN


def cut_face(
    image: UInt8[np.ndarray, "H W 3"],
    alpha: UInt8[np.ndarray, "H W"] | None,
    mask: Bool[np.ndarray, "H W"] | None,
    R: Float64[np.ndarray, "3 3"],
    side: int,
) -> tuple[UInt8[np.ndarray, "s s 3"], UInt8[np.ndarray, "s s"] | None, Bool[np.ndarray, "s s"] | None]:
    """Resample one face: sample more densely than the panorama's pixels, then average.

    Args:
        image: The panorama.
        alpha: Its opacity; colours are averaged in proportion to it.
        mask: True for pixels that count; a face's pixel counts if all its samples do.
        R: Rotation from the panorama's axes to the face's.
        side: Side of the face, px.

    Returns:
        The face, its alpha and its mask.

    Raises:
        ShapeError: the panorama is not twice as wide as high, or is too large.
    """
    H, W = image.shape[:2]
    if not is_panorama_size(W, H):
        raise ShapeError(
            f"image: is {W}x{H}, but a panorama has to be 2:1 and narrower than {MAX_REMAPPED} px"
        )
    finer = max(1, math.ceil(FINER * W / (math.pi * side) - 1e-6))
    source = image if alpha is None else premultiplied(image, alpha)
    wrapped = np.concatenate([source[:, -MARGIN:], source, source[:, :MARGIN]], axis=1)
    bits = None if mask is None else np.concatenate([mask[:, -MARGIN:], mask, mask[:, :MARGIN]], axis=1)
    # A cubic kernel is sharper, but overshoots, which makes edges of alpha opaque.
    kernel = cv2.INTER_CUBIC if alpha is None else cv2.INTER_LINEAR
    face = np.empty((side, side, wrapped.shape[2]), wrapped.dtype)
    counts = None if bits is None else np.empty((side, side), np.bool_)
    for band in bands(side):
        u, v = _maps(R, side, finer, band, W, H)
        size = (side, band.stop - band.start)
        dense = cv2.remap(wrapped, u, v, kernel, borderMode=cv2.BORDER_REPLICATE)
        face[band] = area_mean(dense, *size)
        if bits is not None and counts is not None:
            near = cv2.remap(bits.view(np.uint8), u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
            counts[band] = smaller_mask(near != 0, *size)
    if alpha is None:
        return face, None, counts
    colours, opacity = unweighted(face)
    return colours, opacity, counts


def _maps(
    R: Float64[np.ndarray, "3 3"], side: int, finer: int, band: slice, W: int, H: int
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Return columns, in the panorama with margins, and rows of the samples of some rows of a face."""
    dense = face_pinhole(finer * side)
    x = (np.arange(finer * side) - dense.cx) / dense.fx
    y = (np.arange(finer * band.start, finer * band.stop) - dense.cy) / dense.fy
    X, Y = np.meshgrid(x, y)
    a, b, c = (R[0, i] * X + R[1, i] * Y + R[2, i] for i in range(3))  # the rows of R' times (X, Y, 1)
    u = W * (np.arctan2(a, c) / (2 * np.pi) + 0.5) - 0.5
    v = H * (0.5 + np.arctan2(b, np.hypot(a, c)) / np.pi) - 0.5
    return (u + MARGIN).astype(np.float32), v.astype(np.float32)
