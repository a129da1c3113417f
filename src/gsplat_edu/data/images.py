"""Load the pixels of a view: decode, undistort, downscale and mask image files, and cache them within a budget."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from gsplat_edu.data.lens import Lens, bands, undistortion
from gsplat_edu.data.watch import FileWatch
from gsplat_edu.errors import DatasetError, NotEnoughMemoryError, SplatError
from gsplat_edu.image_files import SPELLED, UNDECODABLE, opened_image, require_room
from gsplat_edu.resizing import area_mean, premultiplied, smaller_mask, unweighted
from gsplat_edu.views import Photo

AT_ONCE = 64_000_000
"""Pixels to decode at once; decoding takes about 10 bytes per pixel, and 25 more if alpha is resampled."""


@dataclass(frozen=True)
class PhotoFile:
    """Everything that determines a view's pixels.

    Args:
        path: The image file.
        mask: An image of the same size, zero for pixels that do not count; None if all count.
        lens: Its camera, at the file's size.
        W: Width after downscaling, px.
        H: Height after downscaling, px.
        background: (r, g, b), 0 to 1, behind transparent pixels; None keeps the alpha.
    """

    path: Path
    mask: Path | None
    lens: Lens
    W: int
    H: int
    background: tuple[float, float, float] | None


def image_size(path: Path) -> tuple[int, int]:
    """Read width and height from a file's header, px. EXIF orientation is ignored, as in COLMAP.

    Raises:
        DatasetError: the file is not an image.
    """
    try:
        with opened_image(path) as file:
            return file.size
    except UNDECODABLE as error:
        raise _undecodable(path, error) from None


def decode(path: Path) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"] | None]:
    """Decode an image file in one of `gsplat_edu.image_files.FORMATS` to 8 bits.

    Returns:
        RGB and alpha; alpha is None if the photo is opaque.

    Raises:
        DatasetError: the file is truncated, corrupt or not an image.
        NotEnoughMemoryError: the pixels need more memory than is free.
    """
    try:
        with opened_image(path) as file:
            require_room(path, file)
            if file.mode.startswith("I"):  # 16-bit gray
                gray = np.clip(np.asarray(file, dtype=np.int64), 0, 65535)
                return np.repeat(((gray + 128) // 257).astype(np.uint8)[..., None], 3, axis=2), None
            if file.mode == "F":
                raise ValueError("its pixels are floats")
            if not file.has_transparency_data:
                return np.array(file.convert("RGB")), None
            pixels = np.array(file.convert("RGBA"))
    except UNDECODABLE as error:
        raise _undecodable(path, error) from None
    rgb, alpha = np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])
    return rgb, None if alpha.min() == 255 else alpha


def decode_mask(path: Path) -> Bool[np.ndarray, "H W"]:
    """Decode a mask: true for nonzero pixels.

    Raises:
        DatasetError: the file is truncated, corrupt or not an image.
        NotEnoughMemoryError: the pixels need more memory than is free.
    """
    try:
        with opened_image(path) as file:
            require_room(path, file)
            plain = file if file.mode[0] in "IF" else file.convert("L")
            mask: Bool[np.ndarray, "H W"] = np.asarray(plain) != 0
            return mask
    except UNDECODABLE as error:
        raise _undecodable(path, error) from None


def load_photo(source: PhotoFile) -> Photo:
    """Decode a photo and convert it to the view's camera: composite, undistort, downscale.

    Raises:
        DatasetError: the photo or its mask cannot be decoded, or its size differs from the header read before.
    """
    image, alpha = decode(source.path)
    mask = None if source.mask is None else decode_mask(source.mask)
    for path, plane in ((source.path, image), (source.mask, mask)):
        if plane is not None and plane.shape[:2] != (source.lens.H, source.lens.W):
            raise DatasetError(f"{path}: its size changed while it was in use; load the capture again")
    if alpha is not None and source.background is not None:
        image, alpha = np.asarray(Photo(image, alpha).over(source.background)), None
    if not source.lens.distorts and (source.W, source.H) == (source.lens.W, source.lens.H):
        return Photo(image, alpha, mask)
    if alpha is not None:
        image = premultiplied(image, alpha)
    if source.lens.distorts:
        try:
            image, mask = _undistorted(image, mask, source.lens)
        except DatasetError as error:
            raise DatasetError(f"{source.path}: {error}") from None
    image = area_mean(image, source.W, source.H)
    if alpha is not None:
        image, alpha = unweighted(image)
    return Photo(image, alpha, None if mask is None else smaller_mask(mask, source.W, source.H))


class ImageStore:
    """The photos of a dataset: a cache within a memory budget; other photos are decoded again on each use.

    The pixels are the same either way. Thread-safe.

    Args:
        budget: Bytes of decoded photos to keep.
        sources: The photos that will be read.
    """

    def __init__(self, budget: int, sources: Sequence[PhotoFile]) -> None:
        self.budget = budget
        self.needed = sum(source.W * source.H * _planes(source) for source in sources)
        """Bytes that all photos take at most; whether a photo that may have alpha does is known once it is decoded."""
        largest = max((source.lens.W * source.lens.H for source in sources), default=1)
        self.workers = max(1, min(os.cpu_count() or 1, AT_ONCE // largest))
        """Number of photos to decode at once."""
        self.watch = FileWatch()
        self._kept: dict[PhotoFile, Photo] = {}
        self._nbytes = 0
        self._lock = threading.Lock()

    @property
    def nbytes(self) -> int:
        """Bytes of the cached photos."""
        return self._nbytes

    def __len__(self) -> int:
        """Return the number of cached photos."""
        return len(self._kept)

    def read(self, source: PhotoFile) -> Photo:
        """Return a photo, from the cache if possible.

        Raises:
            DatasetError: as for `load_photo`, or a file has changed since it was first read.
        """
        with self._lock:
            kept = self._kept.get(source)
        if kept is not None:
            return kept
        with self.watch.unchanged(source.path, source.mask):
            photo = load_photo(source)  # outside the lock because it is slow
        with self._lock:
            if source not in self._kept and self._nbytes + photo.nbytes <= self.budget:
                self._kept[source] = photo
                self._nbytes += photo.nbytes
        return photo


def _planes(source: PhotoFile) -> int:
    """Return the bytes that a pixel of a photo takes: its colour, its mask and, if it is kept, its alpha."""
    alpha = source.background is None and source.path.suffix.lower() not in (".jpg", ".jpeg")
    return 3 + (source.mask is not None) + alpha


def _undistorted(
    pixels: UInt8[np.ndarray, "H W c"] | Float32[np.ndarray, "H W c"],
    mask: Bool[np.ndarray, "H W"] | None,
    lens: Lens,
) -> tuple[UInt8[np.ndarray, "H W c"] | Float32[np.ndarray, "H W c"], Bool[np.ndarray, "H W"] | None]:
    """Undistort a photo and its mask band by band. The maps cost less than decoding, so they are not cached.

    Raises:
        DatasetError: as for `undistortion`.
    """
    image, counts = np.empty_like(pixels), np.empty(pixels.shape[:2], dtype=np.bool_)
    for band in bands(lens.H):
        columns, rows, counts[band] = undistortion(lens, band)
        image[band] = cv2.remap(pixels, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if mask is not None:
            counts[band] &= cv2.remap(mask.view(np.uint8), columns, rows, cv2.INTER_NEAREST) != 0
    if mask is not None:
        return image, counts
    return image, None if counts.all() else counts


def _undecodable(path: Path, error: BaseException) -> SplatError:
    reason = getattr(error, "strerror", None) or str(error).split("\n")[0] or type(error).__name__
    if "out of memory" in reason:  # Pillow's decoders say so in an OSError
        return NotEnoughMemoryError(f"{path}: ran out of memory while decoding; close other programs")
    if "cannot identify" in reason:
        reason = f"it is not a {SPELLED} image"
    return DatasetError(
        f"{path}: cannot be decoded ({reason}); replace the file, or take it out of the capture", reason
    )
