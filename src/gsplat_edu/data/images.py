"""Load the pixels of a view: masked, undistorted and downscaled photos, and a cache of them within a budget."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.locks import ThreadLock
from gsplat_edu.data.lens import Lens, bands, undistortion
from gsplat_edu.data.native_lens import native_intrinsics, pixels_with_rays
from gsplat_edu.data.panorama import FaceLens, cut_face
from gsplat_edu.data.watch import FileWatch
from gsplat_edu.photos.decoding import AT_ONCE, UPRIGHT, decode, decode_mask
from gsplat_edu.photos.image_files import BYTES_PER_PIXEL
from gsplat_edu.scene.photo import Photo

Plane = Bool[np.ndarray, "H W"] | None


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
        orientation: EXIF orientation by which the stored photo is turned; lens and mask refer to the turned photo.
        native: Whether the photo keeps its lens: it is not undistorted.
    """

    path: Path
    mask: Path | None
    lens: Lens
    W: int
    H: int
    background: tuple[float, float, float] | None
    orientation: int = UPRIGHT
    native: bool = False

    @property
    def resampled(self) -> bool:
        """Whether the photo is undistorted or cut from a panorama."""
        return self.lens.distorts and not self.native


def load_photo(source: PhotoFile) -> Photo:
    """Decode a photo and convert it to the view's camera: composite, undistort, downscale.

    Raises:
        DatasetError: the photo or its mask cannot be decoded, or its size differs from the header read before.
    """
    image, alpha = decode(source.path, source.orientation)
    mask = None if source.mask is None else decode_mask(source.mask)
    for path, plane in ((source.path, image), (source.mask, mask)):
        if plane is not None and plane.shape[:2] != (source.lens.H, source.lens.W):
            raise DatasetError(f"{path}: its size changed while it was in use; load the capture again")
    if alpha is not None and source.background is not None:
        image, alpha = np.asarray(Photo(image, alpha).over(source.background)), None
    photo = Photo(image, alpha, mask, lens_only=mask is None)
    if source.native:
        return _through_own_lens(source, photo)
    if isinstance(source.lens, FaceLens):
        return Photo(*cut_face(image, alpha, mask, source.lens.R, source.W))
    if not source.lens.distorts:
        return photo.scaled(source.W, source.H)
    try:
        pixels, counts, outside = _undistorted(photo.weighted, mask, source.lens)
    except DatasetError as error:
        raise DatasetError(f"{source.path}: {error}") from None
    return Photo.averaged(pixels, counts, outside, source.W, source.H, lens_only=mask is None)


def _through_own_lens(source: PhotoFile, photo: Photo) -> Photo:
    """Downscale a photo that keeps its lens. Pixels without a ray, as around a fisheye's circle, do not count."""
    small = photo.scaled(source.W, source.H)
    intrinsics = native_intrinsics(source.lens)
    rays = None if intrinsics is None else pixels_with_rays(intrinsics.scaled(source.W, source.H))
    if rays is None:
        return small
    counts = rays if small.mask is None else small.mask & rays
    return Photo(small.image, small.alpha, counts, small.excluded, small.lens_only)


class ImageStore:
    """The photos of a dataset: a cache within a memory budget; other photos are decoded again on each use.

    The pixels are the same either way. Thread-safe. A pickled copy, as in a worker, begins with an empty cache.

    Args:
        budget: Bytes of decoded photos to keep.
        sources: The photos that will be read.
        decoding: Largest `ImageHeader.decoding` of them.
        watch: Digests of the files that were read; stores of one capture share them.
    """

    def __init__(
        self,
        budget: int,
        sources: Sequence[PhotoFile],
        decoding: int = BYTES_PER_PIXEL,
        watch: FileWatch | None = None,
    ) -> None:
        self.budget = budget
        self.decoding = decoding
        self.needed = sum(source.W * source.H * _planes(source) for source in sources)
        """Upper bound of the bytes of all photos; only decoding shows whether a photo with an alpha channel is
        transparent."""
        largest = max((source.lens.W * source.lens.H for source in sources), default=1)
        self.workers = max(1, min(os.cpu_count() or 1, AT_ONCE // largest))
        """Number of photos to decode at once."""
        self.watch = FileWatch() if watch is None else watch
        self._kept: dict[PhotoFile, Photo] = {}
        self._nbytes = 0
        self._lock = ThreadLock()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kept": {}, "_nbytes": 0}

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
    made = source.lens.distorts or (source.W, source.H) != (source.lens.W, source.lens.H)
    return 3 + (source.mask is not None) * (1 + made) + alpha


def _undistorted(
    pixels: UInt8[np.ndarray, "H W c"] | Float32[np.ndarray, "H W c"],
    mask: Bool[np.ndarray, "H W"] | None,
    lens: Lens,
) -> tuple[UInt8[np.ndarray, "H W c"] | Float32[np.ndarray, "H W c"], Plane, Plane]:
    """Undistort a photo and its mask band by band. The maps cost less than decoding, so they are not cached.

    Returns:
        The photo; the pixels that count, None for all; and the pixels that the mask excludes, None without a mask.

    Raises:
        DatasetError: as for `undistortion`.
    """
    image, counts = np.empty_like(pixels), np.empty(pixels.shape[:2], dtype=np.bool_)
    outside = None if mask is None else np.empty_like(mask)
    for band in bands(lens.H):
        columns, rows, counts[band] = undistortion(lens, band)
        image[band] = cv2.remap(pixels, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if mask is not None and outside is not None:
            inside = cv2.remap(mask.view(np.uint8), columns, rows, cv2.INTER_NEAREST) != 0
            outside[band] = counts[band] & ~inside
            counts[band] &= inside
    if outside is not None:
        return image, counts, outside
    return image, None if counts.all() else counts, None
