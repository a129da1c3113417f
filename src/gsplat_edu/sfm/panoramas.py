"""360-degree panoramas among the input: recognise them, and cut each into the faces of a rig.

The faces of one panorama share its centre, and their rotations are known. COLMAP maps them as one frame of a rig, whose
intrinsics and rotations stay fixed: a panorama has six unknowns, as a photo does.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import written_aside
from gsplat_edu.data.masks import MASKS
from gsplat_edu.data.panorama import FACES, cut_face, face_rotations, face_side, is_panorama_size
from gsplat_edu.photos.decoding import (
    decode,
    decode_mask,
    image_header,
    image_orientation,
    turned,
    upright_image_size,
)
from gsplat_edu.photos.image_files import UNDECODABLE, opened_image
from gsplat_edu.scene.photo import area_mean
from gsplat_edu.sfm.masks import find_masks
from gsplat_edu.sfm.photos import HEIC_ENDINGS, JPEG_ENDINGS, PhotoFacts, taken_at

EQUIRECTANGULAR = re.compile(rb"GPano:ProjectionType\s*(?:=\s*[\"']|>)\s*equirectangular", re.IGNORECASE)
"""XMP entry of a panorama, as attribute or as element (Google's Photo Sphere XMP)."""

EXAMINED = 12
"""Most photos whose edges are compared."""

MOST = 0.8
"""Photos are panoramas if at least this fraction of those examined are."""

SEAM_WIDTH = 512
"""Largest width at which the edges of a picture are compared, px."""

SEAM = 2.0
"""Largest difference of the left and right edge, in those of neighbouring columns."""

CONTRAST = 6.0
"""Smallest mean difference of columns a quarter turn apart, 0 to 255. Without it, a picture's edges always fit."""

POLE = 0.5
"""Largest standard deviation of the first and last row, in that of the rows between them."""

LEAST_MOVING = 0.2
"""Panoramas are warned of if a smaller fraction of their matches moves by more than a turn. Of a garden under a sky,
whose positions came out wrong, 0.1 does, of a room 0.85."""

FACE_QUALITY = 95
"""JPEG quality of the faces of lossy panoramas; faces of other panoramas are PNG."""


@dataclass(frozen=True)
class Panorama:
    """A panorama that was cut.

    Args:
        name: Name of its file.
        faces: Names of its faces, in the order of `face_rotations`.
        place: Latitude and longitude in degrees and height in m from EXIF; None if unknown.
    """

    name: str
    faces: tuple[str, ...]
    place: tuple[float, float, float] | None


def are_panoramas(files: Sequence[Path], choice: str, say: Callable[[str], None]) -> bool:
    """Decide whether photos are panoramas: by the user's choice, by XMP, or by their pictures.

    The shape alone is not enough, because a plain photo may be cropped to 2:1. A picture of the whole sphere continues
    from its right edge at its left edge, and its first and last rows show one direction each.

    Args:
        files: The photos, or some frames of a video; files that cannot be read do not count.
        choice: "yes", "no", or "auto".
        say: Receives what the photos were taken for, and why, unless the choice decides or they are not 2:1.

    Raises:
        DatasetError: the choice is "yes", and a photo is not 2:1; or it is "auto", and there are panoramas among other
            photos.
    """
    if choice == "no":
        return False
    sizes = dict[Path, tuple[int, int]]()
    for path in files:
        try:
            sizes[path] = upright_image_size(path)
        except DatasetError:
            continue
    others = [path for path, size in sizes.items() if not is_panorama_size(*size)]
    if choice == "yes":
        if others:
            W, H = sizes[others[0]]
            raise DatasetError(
                f"{others[0]}: is {W}x{H}, but a 360-degree panorama is twice as wide as high (equirectangular, below "
                "32,759 px); export it so, or give --panorama no"
            )
        return bool(sizes)
    wide = [path for path in sizes if path not in others]
    marked = [path for path in wide if _has_panorama_xmp(path)]
    if marked and len(marked) == len(sizes):
        say(
            f"{len(sizes)} photos taken for 360-degree panoramas: their XMP says so; otherwise give --panorama no"
        )
        return True
    some = wide[:: max(1, math.ceil(len(wide) / EXAMINED))]
    closed = [path for path in some if path in marked or _shows_sphere(path)]
    if others and closed:
        raise DatasetError(
            f"{len(marked) or len(wide)} of {len(sizes)} photos are 360-degree panoramas, first {closed[0].name}, and "
            f"others are not, first {others[0].name}; put the panoramas into a folder of their own, or give "
            "--panorama no"
        )
    if some and not others and len(closed) >= MOST * len(some):
        say(
            f"{len(sizes)} photos taken for 360-degree panoramas: they are 2:1, their left and right edges fit, and "
            "their first and last rows show one point each; otherwise give --panorama no"
        )
        return True
    if sizes and not others:
        say(
            f"{len(sizes)} photos taken for plain photos, although they are twice as wide as high: their left and "
            "right edges do not fit; if they are 360-degree panoramas, give --panorama yes"
        )
    return False


def _shows_sphere(path: Path) -> bool:
    """Return whether a picture that is 2:1 shows a whole sphere, by its edges; False if it cannot be decoded."""
    try:
        image, _ = decode(path, image_orientation(path))
    except DatasetError:
        return False
    width = min(SEAM_WIDTH, image.shape[1])
    small = area_mean(image, width, width // 2).astype(np.float32)
    band = small[width // 16 : width // 2 - width // 16]  # without the poles, where all columns are alike
    columns = [float(np.abs(band - np.roll(band, shift, axis=1)).mean()) for shift in (1, width // 4)]
    seam = float(np.abs(band[:, 0] - band[:, -1]).mean())
    if columns[1] < CONTRAST or seam > SEAM * columns[0] + 1.0 or seam > 0.5 * columns[1]:
        return False
    middle = float(band.std(axis=1).mean())
    return all(float(row.std(axis=0).mean()) < POLE * middle for row in (small[0], small[-1]))


def cut_panoramas(
    files: Sequence[Path], folder: Path, largest: int | None, progress: Callable[[str, int, int], None]
) -> tuple[list[Panorama], int, list[str]]:
    """Cut panoramas, with their masks and alpha, into faces. Faces that exist are kept.

    Args:
        files: The panoramas.
        folder: Folder for the faces; their masks go to masks/ in it.
        largest: Largest side of a face, px; None for the default.
        progress: Called with the number of panoramas done.

    Returns:
        The panoramas; the side of all faces, px; and name and reason for each panorama that cannot be decoded.

    Raises:
        DatasetError: the size of a mask differs from its panorama's.
    """
    sizes = dict[Path, tuple[int, int]]()
    found, unreadable, masks = list[Panorama](), list[str](), find_masks(files)
    for path in files:
        try:
            sizes[path] = upright_image_size(path)
        except DatasetError as error:
            unreadable.append(f"{path.name}: {error.reason or error}")
    side = face_side(max((W for W, _ in sizes.values()), default=2), largest)
    folder.mkdir(parents=True, exist_ok=True)
    stems, taken = dict[Path, str](), set[str]()
    for path in sizes:
        stem = path.stem if path.stem.lower() not in taken else path.name.replace(".", "_")
        taken.add(stem.lower())
        stems[path] = stem
    for number, path in enumerate(sizes, 1):
        lossy = path.suffix.lower() in (*JPEG_ENDINGS, *HEIC_ENDINGS)
        ending = ".jpg" if lossy else ".png"
        names = tuple(f"{stems[path]}_{face}{ending}" for face in range(FACES))
        try:
            if not (folder / names[-1]).is_file():
                _cut(path, masks.get(path), [folder / name for name in names], side)
            found.append(Panorama(path.name, names, taken_at(path)))
        except DatasetError as error:
            unreadable.append(f"{path.name}: {error.reason or error}")
        progress("cutting panoramas", number, len(sizes))
    return found, side, unreadable


def color_problems(files: Sequence[Path]) -> list[tuple[str, str]]:
    """Return name and `gsplat_edu.photos.decoding.ImageHeader.problem` of panoramas, whose faces are sRGB."""
    found = []
    for path in files:
        try:
            found.append((path.name, image_header(path).problem))
        except DatasetError:
            continue
    return found


def face_facts(photos: Sequence[PhotoFacts], panoramas: Sequence[Panorama]) -> list[PhotoFacts]:
    """Complete the facts of the faces: where they were taken.

    Args:
        photos: The faces, as found by `copy_photos`.
        panoramas: Their panoramas.

    Raises:
        DatasetError: a face is missing.
    """
    by_name = {photo.name: photo for photo in photos}
    for panorama in panoramas:
        if missing := [name for name in panorama.faces if name not in by_name]:
            raise DatasetError(
                f"{missing[0]}: a face of {panorama.name} is damaged; remove the work folder sfm/"
            )
    return [
        PhotoFacts(**asdict(by_name[name]) | {"place": panorama.place})
        for panorama in panoramas
        for name in panorama.faces
    ]


def face_groups(photos: Sequence[PhotoFacts], longest: int) -> list[dict[str, Any]]:
    """Group faces by number, a camera per face of the rig, as for `gsplat_edu.sfm.engine.jobs.features`."""
    width, height = photos[0].copy_size(longest)
    focal = width / 2  # 90 degrees
    sizes = {"kind": "", "focal": focal, "width": width, "height": height}
    return [sizes | {"names": [photo.copy for photo in photos[face::FACES]]} for face in range(FACES)]


def rig_of(photos: Sequence[PhotoFacts]) -> dict[str, Any]:
    """Return the rig of the faces, as for `gsplat_edu.sfm.mapping.Cameras`."""
    copies = [photo.copy for photo in photos]
    panoramas = [copies[start : start + FACES] for start in range(0, len(copies), FACES)]
    return {"rotations": [R.tolist() for R in face_rotations()], "panoramas": panoramas}


def _has_panorama_xmp(path: Path) -> bool:
    """Return whether a file's XMP says that it is an equirectangular panorama."""
    try:
        with opened_image(path) as file:
            said = file.info.get("xmp") or file.info.get("XML:com.adobe.xmp") or b""
    except UNDECODABLE:
        return False
    raw = said.encode("utf-8", "replace") if isinstance(said, str) else bytes(said)
    return EQUIRECTANGULAR.search(raw) is not None


def _cut(path: Path, mask: Path | None, targets: Sequence[Path], side: int) -> None:
    """Write the faces of one panorama, the last one last.

    Raises:
        DatasetError: the panorama or its mask cannot be decoded, or their sizes differ.
    """
    orientation = image_orientation(path)
    image, alpha = decode(path, orientation)
    counts = None if mask is None else decode_mask(mask)
    if counts is not None and counts.shape != image.shape[:2]:
        counts = turned(counts, orientation)
    if counts is not None and counts.shape != image.shape[:2]:
        H, W = counts.shape
        raise DatasetError(
            f"{mask}: the mask is {W}x{H} but its panorama {image.shape[1]}x{image.shape[0]}; make them the same size"
        )
    for R, target in zip(face_rotations(), targets, strict=True):
        face, opacity, seen = cut_face(image, alpha, counts, R, side)
        if seen is not None:
            place = target.parent / "masks" / f"{target.name}.png"
            place.parent.mkdir(exist_ok=True)
            _write(Image.fromarray(np.where(seen, 255, 0).astype(np.uint8)), place, ".png")
        pixels = face if opacity is None else np.concatenate([face, opacity[..., None]], axis=2)
        _write(Image.fromarray(pixels), target, target.suffix)


def _write(image: Image.Image, target: Path, ending: str) -> None:
    options: dict[str, Any] = {"quality": FACE_QUALITY, "subsampling": 0} if ending == ".jpg" else {}
    with written_aside(target) as aside:
        image.save(aside, format="JPEG" if ending == ".jpg" else "PNG", **options)


def moving_line(share: float) -> str:
    """Return a warning if too few matches tell where panoramas stood; empty otherwise.

    Args:
        share: Fraction of the matches that move by more than a turn.
    """
    if share >= LEAST_MOVING:
        return ""
    return (
        f"only {100 * share:.0f} % of the matches move between the panoramas by more than a turn; the rest is far away,"
        f" as sky is, and says little of where they stood: check the poses, mask the sky ({MASKS}/), or take more"
        " panoramas near things"
    )
