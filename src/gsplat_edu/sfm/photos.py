"""Find photos, read their EXIF, and write the working copies for feature extraction."""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import unreadable, written_aside
from gsplat_edu.base.reading import open_file
from gsplat_edu.data.capture import PHOTO_ENDINGS, PHOTO_FOLDERS, is_file
from gsplat_edu.photos.colors import conversion_of
from gsplat_edu.photos.decoding import (
    AT_ONCE,
    MIRRORED,
    TURNS,
    UPRIGHT,
    decode,
    stored_orientation,
    stored_size,
)
from gsplat_edu.photos.image_files import HEIF, SPELLED, UNDECODABLE, is_image, opened_image, quiet_decoders
from gsplat_edu.scene.photo import Photo, area_mean
from gsplat_edu.sfm.masks import MASK_ENDING, counting, find_masks, turn_mask, upright_masks, write_mask

PASSED_OVER = frozenset(("masks", *PHOTO_FOLDERS[1:]))
"""Folders that are skipped: their images are masks or smaller copies of the photos."""

PEEK = 65536
"""Bytes at the start and end of a file that go into its fingerprint."""

FULL_FRAME = math.hypot(36.0, 24.0)
"""Film diagonal that 35 mm equivalent focal lengths refer to, mm (CIPA DCG-001)."""

COUNTER = {0: UPRIGHT, 1: 8, 2: 3, 3: 6}
"""EXIF orientation that undoes a number of clockwise quarter turns."""

COPY_QUALITY = 97
"""JPEG quality of the working copies."""

JPEG_ENDINGS = (".jpg", ".jpeg")
"""Endings of photos that are written as JPEG again."""

HEIC_ENDINGS = (".heic", ".heif", ".hif")
"""Endings of lossy photos that become .jpg; photos of all other formats are written as PNG."""

FISHEYE_NAME = re.compile("fish.?eye", re.IGNORECASE)
"""Name of a lens or camera in EXIF that makes its photos fisheyes."""

SHORTEST, SHORTEST_FISHEYE = 0.3, 0.1
"""Shortest plausible focal length in EXIF, of the longer side."""

GRAY = (0.5, 0.5, 0.5)
"""Background of transparent photos in the working copies."""


@dataclass(frozen=True)
class PhotoFacts:
    """A photo, without its pixels.

    Args:
        name: Path below the source, with slashes.
        copy: Name of the working copy.
        W: Width of the sensor's picture, px.
        H: Height of the sensor's picture, px.
        turns: Quarter turns clockwise that bring the sensor's picture upright.
        focal: Focal length from EXIF, px; None if unknown.
        camera: A key that is equal for photos taken by one camera with one lens and zoom.
        place: Latitude and longitude in degrees and height in m from EXIF; None if unknown.
        mask: File of the mask, oriented like the sensor's picture; empty if there is none.
        sensor: EXIF orientation that makes the sensor's picture of the decoded pixels: 2 for a mirrored photo, and for
            HEIC, which is decoded upright, the one that turns it back. Photos of one camera then share a lens.
        problem: `gsplat_edu.photos.decoding.ImageHeader.problem`.
        taken: When it was taken, from EXIF, as a text that sorts by time; empty if unknown.
        fisheye: Whether EXIF names the lens or camera a fisheye.
    """

    name: str
    copy: str
    W: int
    H: int
    turns: int = 0
    focal: float | None = None
    camera: str = ""
    place: tuple[float, float, float] | None = None
    mask: str = ""
    sensor: int = UPRIGHT
    problem: str = ""
    taken: str = ""
    fisheye: bool = False

    def copy_size(self, longest: int) -> tuple[int, int]:
        """Return width and height of the working copy, px.

        Args:
            longest: Longest side of working copies, px.
        """
        factor = min(1.0, longest / max(self.W, self.H))
        return max(1, round(factor * self.W)), max(1, round(factor * self.H))


def photo_files(source: Path, besides: Path | None = None) -> list[Path]:
    """List the photos of one folder, recognised by their contents.

    The folder is `source` if it contains at least two photos, else images/ in it, else the only folder below it with
    photos. Hidden files and folders, masks, smaller copies of the photos, and captures and runs of this program are
    skipped.

    Args:
        source: The folder.
        besides: A folder to skip, resolved.

    Returns:
        The photos, sorted by path. Files with a photo's ending are included even if they are not photos.

    Raises:
        DatasetError: several folders contain photos, and none of them is named images.
    """
    here = _photos_in(source)
    if len(here) > 1:
        return here
    below = {Path(place): found for place in _folders_below(source, besides) if (found := _photos_in(place))}
    if source / "images" in below:
        return below[source / "images"]
    several = {folder: found for folder, found in below.items() if len(found) > 1}
    if several or (below and not here):
        return _only(source, several or below)
    return here


def _only(source: Path, folders: dict[Path, list[Path]]) -> list[Path]:
    """Return the photos of the only folder.

    Raises:
        DatasetError: there are several.
    """
    if len(folders) == 1:
        return next(iter(folders.values()))
    shown = [f"{folder.relative_to(source).as_posix()} ({len(found)})" for folder, found in folders.items()]
    more = f" and {len(shown) - 3} more" if len(shown) > 3 else ""
    raise DatasetError(
        f"{source}: its photos are in {len(shown)} folders: {', '.join(shown[:3])}{more}; give one of them, or put the "
        "photos of one place into one folder"
    )


def _folders_below(source: Path, besides: Path | None) -> Iterator[Path]:
    """Yield the folders below a folder, sorted, without those to skip."""
    for place, folders, _ in os.walk(source):
        here = Path(place)
        folders[:] = [
            name
            for name in sorted(folders)
            if name[0] not in "._" and name not in PASSED_OVER
            if (here / name).resolve() != besides and not _made_here(here / name)
        ]
        yield from (here / name for name in folders)


def _photos_in(folder: Path) -> list[Path]:
    """List the photos directly in a folder; empty if it cannot be read."""
    try:
        paths = sorted(folder.iterdir())
    except OSError:
        return []
    visible = [path for path in paths if path.name[0] != "." and not path.name.lower().endswith(MASK_ENDING)]
    return [path for path in visible if is_file(path) and is_photo(path)]  # no pipes, no broken links


def is_run(folder: Path) -> bool:
    """Return whether a folder is that of a run."""
    return all(is_file(folder / name) for name in ("config.json", "cameras.json"))


def _made_here(folder: Path) -> bool:
    """Return whether a folder is a capture written by structure from motion, or a run."""
    return is_file(folder / "sfm" / "stages.json") or is_run(folder)


def is_photo(path: Path) -> bool:
    """Return whether a file has a photo's ending or a photo's contents."""
    if path.suffix.lower() in PHOTO_ENDINGS:
        return True
    return is_image(path)


def fingerprint(files: Sequence[Path], source: Path) -> str:
    """Return a digest of files: their names below the source, their sizes, and their first and last bytes.

    Raises:
        DatasetError: a file cannot be read.
    """
    digest = hashlib.sha256()
    for path in files:
        try:
            size = path.stat().st_size
            with open_file(path) as file:
                ends = file.read(PEEK)
                file.seek(max(0, size - PEEK))
                ends += file.read(PEEK)
        except OSError as error:
            raise DatasetError(unreadable(path, error)) from None
        name = Path(os.path.relpath(path, source)).as_posix()
        digest.update(f"{name}\0{size}\0".encode("utf-8", "surrogateescape") + ends)
    return digest.hexdigest()


def copy_photos(
    files: Sequence[Path],
    source: Path,
    folder: Path,
    longest: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[list[PhotoFacts], list[str]]:
    """Write a working copy of every photo that can be decoded. Existing copies are kept.

    Copies have names without spaces, as COLMAP's pair lists require, and are 8-bit RGB, because pycolmap reads fewer
    formats than Pillow. A photo with a mask or transparent parts gets a mask masks/COPY.png in the neighbouring folder.
    If the mask is not oriented like the sensor's picture, one that is goes to masks/stored/COPY.png, or to
    masks/mirrored/COPY.png if the mask was mirrored like its photo.

    Args:
        files: The photos.
        source: Folder that their names are relative to.
        folder: Folder for the copies.
        longest: Longest side of a copy, px; smaller photos keep their size.
        progress: Called from the calling thread with the number of photos done and the total.

    Returns:
        facts: The photos that can be decoded, in the order of the files.
        unreadable: Name and reason for each of the others.

    Raises:
        DatasetError: the size of a mask fits neither its photo nor its upright photo, or a photo is HEIC and
            pillow-heif is not installed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    headers, remade, unreadable = _headers(files, source, folder)
    facts = list[PhotoFacts]()
    largest = max((photo.W * photo.H for _, photo in headers), default=1)
    pool = ThreadPoolExecutor(max(1, min(os.cpu_count() or 1, AT_ONCE // largest)))
    futures = [pool.submit(_copy, path, photo, folder, longest, remade.get(path)) for path, photo in headers]
    try:
        for done, ((_, photo), future) in enumerate(zip(headers, futures, strict=True), 1):
            try:
                future.result()
                facts.append(photo)
            except DatasetError as error:
                reason = str(error).partition(": ")[2].partition("; ")[0]
                unreadable.append(f"{photo.name}: {reason}")
            progress(done, len(headers))
    finally:
        pool.shutdown(cancel_futures=True)
    masked = mask_folder(folder)
    # If any photo has a mask, COLMAP skips the photos without one.
    for photo in facts if masked.is_dir() else ():
        if not (target := masked / f"{photo.copy}.png").is_file():
            write_mask(np.ones((1, 1), np.bool_), target, photo.copy_size(longest))
    return facts, unreadable


def photo_facts(files: Sequence[Path], source: Path, folder: Path) -> list[PhotoFacts]:
    """Read the facts of photos from their headers, as `copy_photos` does, including those that cannot be decoded.

    Args:
        files: The photos.
        source: Folder that their names are relative to.
        folder: Folder of the copies.

    Raises:
        DatasetError: as for `copy_photos`.
    """
    return [photo for _, photo in _headers(files, source, folder)[0]]


def camera_kinds(photos: Sequence[PhotoFacts]) -> str:
    """Describe the number of cameras that took the photos.

    A camera whose portraits were stored upright without a note in EXIF counts once. Its portraits and landscapes are
    calibrated separately, because the principal point and the tangential distortion depend on whether the camera was
    turned left or right, which is unknown.
    """
    keys = {photo.camera for photo in photos}
    turned = set[str]()
    for key in keys:
        size, named, kind = key.partition(" ")
        W, _, H = size.partition("x")
        if named and int(W) < int(H) and f"{H}x{W} {kind}" in keys:
            turned.add(key)
    count = len(keys) - len(turned)
    said = "one camera" if count == 1 else f"{count} kinds of camera or zoom"
    if turned:
        said += ", some photos upright without EXIF's orientation, which are calibrated apart"
    return said


def _headers(
    files: Sequence[Path], source: Path, folder: Path
) -> tuple[list[tuple[Path, PhotoFacts]], dict[Path, tuple[Path, int]], list[str]]:
    """Read the headers of photos.

    Returns:
        The facts of each photo; the masks to be turned, each with an EXIF orientation; and name and reason for each
        file that is not a photo.

    Raises:
        DatasetError: the size of a mask fits neither its photo nor its upright photo.
    """
    found, unreadable, masks = list[tuple[Path, PhotoFacts]](), list[str](), find_masks(files)
    shapes = dict[Path, tuple[int, int, int]]()
    for number, path in enumerate(files):
        try:
            photo, shapes[path] = _facts(path, path.relative_to(source).as_posix(), f"{number:06d}.jpg")
            found.append((path, replace(photo, mask=str(masks.get(path, "")))))
        except ValueError as error:
            unreadable.append(f"{path.relative_to(source).as_posix()} ({error})")
    upright = upright_masks(masks, shapes)
    headers, remade = list[tuple[Path, PhotoFacts]](), dict[Path, tuple[Path, int]]()
    for path, photo in found:
        as_stored = (
            shapes[path][2] != UPRIGHT and path not in upright
        )  # a HEIC's mask is upright like the HEIC
        back = photo.sensor if as_stored else COUNTER[photo.turns]
        if path not in masks or (back == UPRIGHT and path not in upright):
            headers.append((path, photo))
            continue
        remade[path] = masks[path], back
        target = mirrored_mask(folder, photo.copy) if as_stored else stored_mask(folder, photo.copy)
        headers.append((path, replace(photo, mask=str(target))))
    return headers, remade, unreadable


def _facts(path: Path, name: str, copy: str) -> tuple[PhotoFacts, tuple[int, int, int]]:
    """Read a header.

    Returns:
        The facts; and width, height and EXIF orientation of the decoded pixels.

    Raises:
        ValueError: the file is not a photo; the message says why.
        DatasetError: it is HEIC, and pillow-heif is not installed.
    """
    try:
        with quiet_decoders(), opened_image(path) as file:
            (W, H), exif = stored_size(file), file.getexif()
            orientation, heif = stored_orientation(file), file.format == HEIF
            taken = file.info.get("original_orientation") if heif else orientation
            problem = conversion_of(file.info).problem
            details = exif.get_ifd(ExifTags.IFD.Exif)
            place = _place(exif.get_ifd(ExifTags.IFD.GPSInfo))
    except UNDECODABLE as error:
        reason = f"not a {SPELLED} image" if "cannot identify" in str(error) else str(error).split("\n")[0]
        raise ValueError(reason) from None
    decoded, turns = (W, H, orientation), TURNS.get(taken or UPRIGHT, 0)
    sensor = COUNTER[turns] if heif else 2 if orientation in MIRRORED else UPRIGHT
    if heif and turns % 2:
        W, H = H, W
    said = [exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model)]
    said += [details.get(tag) for tag in (ExifTags.Base.LensModel, ExifTags.Base.FocalLength)]
    said += [details.get(ExifTags.Base.FocalLengthIn35mmFilm), details.get(ExifTags.Base.DigitalZoomRatio)]
    camera = " ".join([f"{W}x{H}", *(str(value).strip("\0 ") for value in said if value is not None)])
    fisheye = FISHEYE_NAME.search(camera) is not None
    focal = _focal(details, W, H, SHORTEST_FISHEYE if fisheye else SHORTEST)
    photo = PhotoFacts(name, copy, W, H, turns, focal, camera, place, sensor=sensor, problem=problem)
    return replace(photo, taken=_taken(details), fisheye=fisheye), decoded


def _taken(details: dict[int, object]) -> str:
    """Read the time: "2024:02:12 00:39:19", and the digits of the fraction of a second; empty if it is invalid."""
    said, fraction = (
        str(details.get(tag, "")).strip("\0 ")
        for tag in (ExifTags.Base.DateTimeOriginal, ExifTags.Base.SubsecTimeOriginal)
    )
    if not re.fullmatch(r"[0-9]{4}:[0-9]{2}:[0-9]{2} [0-9]{2}:[0-9]{2}:[0-9]{2}", said) or said[:4] == "0000":
        return ""
    return f"{said}.{fraction}" if re.fullmatch("[0-9]+", fraction) else said


def _number(value: object) -> float:
    """Convert an EXIF value, perhaps 0/0, to a number; NaN if that is impossible."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan


def _focal(details: dict[int, object], W: int, H: int, shortest: float) -> float | None:
    """Compute the focal length in px from the 35 mm equivalent, f / 43.27 mm = f_px / diagonal, or the sensor's pitch.

    Reject a focal length outside `shortest` to 20 times the longer side.
    """
    equivalent = _number(details.get(ExifTags.Base.FocalLengthIn35mmFilm))
    focal = equivalent / FULL_FRAME * math.hypot(W, H)
    if not focal > 0:  # NaN, too
        unit = {2: 25.4, 3: 10.0, 4: 1.0}.get(details.get(ExifTags.Base.FocalPlaneResolutionUnit, 2), 25.4)  # type: ignore[call-overload]
        per_mm = _number(details.get(ExifTags.Base.FocalPlaneXResolution)) / unit
        stored = _number(details.get(ExifTags.Base.ExifImageWidth))
        shrunk = W / stored if stored > 0 else 1.0
        focal = _number(details.get(ExifTags.Base.FocalLength)) * per_mm * shrunk
    return float(focal) if shortest * max(W, H) < focal < 20.0 * max(W, H) else None


def _place(gps: dict[int, object]) -> tuple[float, float, float] | None:
    """Read latitude, longitude and height."""
    angles = []
    for tag, side, negative in (
        (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLatitudeRef, "S"),
        (ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLongitudeRef, "W"),
    ):
        parts = gps.get(tag)
        if not isinstance(parts, tuple) or len(parts) != 3:
            return None
        degrees, minutes, seconds = (_number(part) for part in parts)
        angle = degrees + minutes / 60.0 + seconds / 3600.0
        angles.append(-angle if str(gps.get(side, "")).upper().startswith(negative) else angle)
    height = _number(gps.get(ExifTags.GPS.GPSAltitude))
    if not all(math.isfinite(angle) for angle in angles) or not any(angles):
        return None
    return angles[0], angles[1], height if math.isfinite(height) else 0.0


def taken_at(path: Path) -> tuple[float, float, float] | None:
    """Read latitude and longitude in degrees and height in m from a photo's EXIF; None if it has none."""
    try:
        with quiet_decoders(), opened_image(path) as file:
            return _place(file.getexif().get_ifd(ExifTags.IFD.GPSInfo))
    except UNDECODABLE:
        return None


def _copy(path: Path, photo: PhotoFacts, folder: Path, longest: int, remade: tuple[Path, int] | None) -> None:
    """Write the mask and then the working copy, unless the copy exists; a mask is turned first if necessary.

    Raises:
        DatasetError: the photo or its mask cannot be decoded.
    """
    target = folder / photo.copy
    if target.is_file():
        return
    size = photo.copy_size(longest)
    pixels, alpha = decode(path, photo.sensor, smaller=min(size))
    try:
        if remade is not None:
            turn_mask(*remade, Path(photo.mask))
        counts = counting(Path(photo.mask) if photo.mask else None, alpha)
    except DatasetError as error:
        raise DatasetError(f"{path}: its mask {error}") from None
    if counts is not None:
        write_mask(counts, mask_folder(folder) / f"{photo.copy}.png", size)
    image = area_mean(Photo(pixels, alpha).over(GRAY), *size)
    with written_aside(target) as aside:
        Image.fromarray(image).save(aside, format="JPEG", quality=COPY_QUALITY)


def mask_folder(folder: Path) -> Path:
    """Return the folder of the working copies' masks, given the folder of the copies."""
    return folder.with_name("masks")


def stored_mask(folder: Path, copy: str) -> Path:
    """Return the file for an upright mask turned like the sensor's picture, given the folder of the working copies."""
    return mask_folder(folder) / "stored" / f"{copy}.png"


def mirrored_mask(folder: Path, copy: str) -> Path:
    """Return the file for a mask that was stored mirrored like its photo, given the folder of the working copies."""
    return mask_folder(folder) / "mirrored" / f"{copy}.png"
