"""Load the pixels of a view: decode, undistort, downscale and mask image files, and cache them within a budget."""

from __future__ import annotations

import functools
import math
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt8
from PIL import ExifTags, Image

from gsplat_edu.base.errors import DatasetError, NotEnoughMemoryError, SplatError
from gsplat_edu.data.colors import conversion_of, to_srgb
from gsplat_edu.data.deep_pixels import DEEP_BYTES_PER_PIXEL, is_deep, rounded_image
from gsplat_edu.data.lens import Lens, bands, undistortion
from gsplat_edu.data.native_lens import native_intrinsics, pixels_with_rays
from gsplat_edu.data.panorama import FaceLens, cut_face
from gsplat_edu.data.watch import FileWatch
from gsplat_edu.photos.image_files import (
    BYTES_PER_PIXEL,
    HEIF,
    SPELLED,
    UNDECODABLE,
    bytes_per_pixel,
    opened_image,
    quiet_decoders,
    require_room,
)
from gsplat_edu.photos.resizing import area_mean, premultiplied, smaller_mask, unweighted
from gsplat_edu.scene.views import Photo

AT_ONCE = 64_000_000
"""Pixels to decode at once; decoding takes about 10 bytes per pixel, and 25 more if alpha is resampled."""

LOSSY, LOSSY_THRESHOLD = ("JPEG", HEIF), 128
"""Formats in which a mask's zeros are noisy near its edges, and the smallest value that counts in them."""

UPRIGHT = 1
"""EXIF orientation of a photo that is stored upright."""

TURNS = {1: 0, 2: 0, 3: 2, 4: 2, 5: 3, 6: 1, 7: 1, 8: 3}
"""Quarter turns clockwise that bring a photo upright, by EXIF orientation; mirrored photos are mirrored first."""

MIRRORED = (2, 4, 5, 7)
"""EXIF orientations of photos whose stored columns are reversed."""

BACK = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}
"""EXIF orientation that undoes another one."""


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


@dataclass(frozen=True)
class ImageHeader:
    """Facts from an image file's header.

    Args:
        size: Width and height as stored, px. A HEIC's are upright, because its container turns it.
        problem: Why the colours are taken as sRGB although the file declares others; empty if they are converted.
        decoding: Bytes per pixel that decoding takes.
        alpha: Whether pixels may be transparent.
    """

    size: tuple[int, int]
    problem: str
    decoding: int = BYTES_PER_PIXEL
    alpha: bool = False


def image_header(path: Path) -> ImageHeader:
    """Read a file's header.

    Raises:
        DatasetError: the file is not an image, or is HEIC and pillow-heif is not installed.
    """
    try:
        with opened_image(path) as file:
            decoding = DEEP_BYTES_PER_PIXEL if is_deep(file) else bytes_per_pixel(file)
            problem = conversion_of(file.info).problem
            return ImageHeader(stored_size(file), problem, decoding, file.has_transparency_data)
    except UNDECODABLE as error:
        raise _undecodable(path, error) from None


def image_size(path: Path) -> tuple[int, int]:
    """Read width and height from a file's header, px. EXIF orientation is ignored, as in COLMAP.

    Raises:
        DatasetError: as for `image_header`.
    """
    try:
        with opened_image(path) as file:
            return stored_size(file)
    except UNDECODABLE as error:
        raise _undecodable(path, error) from None


def image_orientation(path: Path) -> int:
    """Read the EXIF orientation, 1 to 8; 1 if a file has none. Always 1 for HEIC: see `stored_orientation`.

    Raises:
        DatasetError: as for `image_header`.
    """
    try:
        with quiet_decoders(), opened_image(path) as file:
            return stored_orientation(file)
    except UNDECODABLE as error:
        raise _undecodable(path, error) from None


def recorded_exposure(path: Path) -> float | None:
    """Read how bright EXIF says a photo is: log2(t ISO / N²) with exposure time t in s and f-number N, stops.

    Returns:
        A number to compare with that of other photos; None unless the file records all three.

    Raises:
        DatasetError: as for `image_header`.
    """
    tags = (ExifTags.Base.ExposureTime, ExifTags.Base.ISOSpeedRatings, ExifTags.Base.FNumber)
    try:
        with quiet_decoders(), opened_image(path) as file:
            # Pillow decodes a PNG to look for EXIF behind its pixels, where cameras do not write it
            late = file.format == "PNG" and "exif" not in file.info
            details = {} if late else file.getexif().get_ifd(ExifTags.IFD.Exif)
    except UNDECODABLE as error:
        raise _undecodable(path, error) from None
    time, iso, number = (_positive(details.get(tag)) for tag in tags)
    return math.log2(time * iso / number**2) if time and iso and number else None


def _positive(value: object) -> float:
    """Convert an EXIF value, the first if there are several, to a number; 0 if it is none, or not positive."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, IndexError):
        return 0.0
    return number if 1e-9 < number < 1e9 else 0.0


class PhotoHeaders:
    """Headers of image files, cached; each file is opened once for its header and once for its orientation.

    Attributes:
        of: `image_header`, cached.
        orientation: `image_orientation`, cached.
    """

    def __init__(self) -> None:
        self.of = functools.cache(image_header)
        self.orientation = functools.cache(image_orientation)

    def size(self, path: Path) -> tuple[int, int]:
        """Return width and height as stored, px; see `image_header`."""
        return self.of(path).size


def stored_size(file: Image.Image) -> tuple[int, int]:
    """Return width and height of an opened image as stored, px; Pillow exchanges those of a TIFF that EXIF turns."""
    W, H = file.size
    return (H, W) if file.format == "TIFF" and TURNS[stored_orientation(file)] % 2 else (W, H)


def stored_orientation(file: Image.Image) -> int:
    """Return the EXIF orientation of an opened image that is not decoded, 1 to 8.

    A HEIC's container has its own rotation, which the decoder applies; ISO 23008-12 says to ignore the rotation in
    EXIF.
    """
    if file.format == HEIF:
        return UPRIGHT
    orientation = file.getexif().get(ExifTags.Base.Orientation, UPRIGHT)
    return orientation if orientation in TURNS else UPRIGHT


def upright_size(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """Return the size of a photo after it is turned.

    Args:
        size: Width and height as stored, px.
        orientation: EXIF orientation.
    """
    return size[::-1] if TURNS[orientation] % 2 else size


def decode(
    path: Path, orientation: int = UPRIGHT, smaller: int | None = None
) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"] | None]:
    """Decode an image file in one of `gsplat_edu.photos.image_files.FORMATS` to 8-bit sRGB.

    Every reader of photos calls this. 16 bits are rounded to 8, and colours of another profile are converted; all other
    pixels are as the file stores them.

    Args:
        path: The file.
        orientation: EXIF orientation by which the stored pixels are turned. The orientation in the file is ignored.
        smaller: Decode JPEGs at 1/2, 1/4 or 1/8 of their size, if both sides stay this long, px; None for full size.

    Returns:
        RGB and alpha; alpha is None if the photo is opaque.

    Raises:
        DatasetError: the file is truncated, corrupt or not an image.
        NotEnoughMemoryError: the pixels need more memory than is free.
    """
    try:
        with opened_image(path) as file:
            if smaller is not None and file.format == "JPEG":
                file.draft("RGB", (smaller, smaller))
            require_room(path, file)
            if file.mode == "F":
                raise ValueError("its pixels are floats")
            info, already = file.info, _turned_by_pillow(file)
            image = rounded_image(path, file) if is_deep(file) else file
            converted = image.convert("RGBA" if image.has_transparency_data else "RGB")
            to_srgb(converted, info)
            pixels = turned(turned(np.array(converted), BACK[already]), orientation)
    except UNDECODABLE as error:
        raise _undecodable(path, error) from None
    if pixels.shape[2] == 3:
        return pixels, None
    rgb, alpha = np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])
    return rgb, None if alpha.min() == 255 else alpha


def turned(pixels: Shaped[np.ndarray, "h w *c"], orientation: int) -> Shaped[np.ndarray, "H W *c"]:
    """Turn stored pixels upright.

    Args:
        pixels: The stored pixels, of a photo or a mask.
        orientation: EXIF orientation.
    """
    if orientation == UPRIGHT:
        return pixels
    plain = pixels[:, ::-1] if orientation in MIRRORED else pixels
    return np.ascontiguousarray(np.rot90(plain, -TURNS[orientation]))


def decode_mask(path: Path) -> Bool[np.ndarray, "H W"]:
    """Decode a mask: true for nonzero pixels, or for those of at least `LOSSY_THRESHOLD` in a lossy format.

    Raises:
        DatasetError: the file is truncated, corrupt or not an image.
        NotEnoughMemoryError: the pixels need more memory than is free.
    """
    try:
        with opened_image(path) as file:
            require_room(path, file)
            already = _turned_by_pillow(file)
            least = LOSSY_THRESHOLD if file.format in LOSSY else 0
            plain = np.asarray(file if file.mode[0] in "IF" else file.convert("L"))
            mask: Bool[np.ndarray, "H W"] = turned(plain >= least if least else plain != 0, BACK[already])
            return mask
    except UNDECODABLE as error:
        raise _undecodable(path, error) from None


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
    if source.native:
        return _through_own_lens(source, Photo(image, alpha, mask, lens_only=source.mask is None))
    if isinstance(source.lens, FaceLens):
        return Photo(*cut_face(image, alpha, mask, source.lens.R, source.W))
    if not source.lens.distorts and (source.W, source.H) == (source.lens.W, source.lens.H):
        return Photo(image, alpha, mask)
    if alpha is not None:
        image = premultiplied(image, alpha)
    outside = None if mask is None else ~mask
    if source.lens.distorts:
        try:
            image, mask, outside = _undistorted(image, mask, source.lens)
        except DatasetError as error:
            raise DatasetError(f"{source.path}: {error}") from None
    image = area_mean(image, source.W, source.H)
    if alpha is not None:
        image, alpha = unweighted(image)
    counts, excluded = (
        None if plane is None else smaller_mask(plane, source.W, source.H) for plane in (mask, outside)
    )
    return Photo(image, alpha, counts, excluded, lens_only=source.mask is None)


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

    The pixels are the same either way. Thread-safe.

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


def _turned_by_pillow(file: Image.Image) -> int:
    """Return the EXIF orientation by which Pillow will turn an image while it decodes it: it does so for TIFF only."""
    return stored_orientation(file) if file.format == "TIFF" else UPRIGHT


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


def _undecodable(path: Path, error: BaseException) -> SplatError:
    reason = getattr(error, "strerror", None) or str(error).split("\n")[0] or type(error).__name__
    if "out of memory" in reason:  # Pillow's decoders say so in an OSError
        return NotEnoughMemoryError(f"{path}: ran out of memory while decoding; close other programs")
    if "cannot identify" in reason:
        reason = f"it is not a {SPELLED} image"
    return DatasetError(
        f"{path}: cannot be decoded ({reason}); replace the file, or take it out of the capture", reason
    )
