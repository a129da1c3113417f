"""Turn a model of the working copies into a capture: upright, undistorted photos and a matching model."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from gsplat_edu.base.constants import AUTO
from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import parse_json, read_text
from gsplat_edu.data.colmap import read_cameras, read_images, read_points
from gsplat_edu.data.images import AT_ONCE, UPRIGHT, PhotoFile, load_photo
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.scale import SCALE_FILE, write_scale
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussian_math import quat_to_R
from gsplat_edu.scene.intrinsics import Intrinsics
from gsplat_edu.sfm.colmap import call
from gsplat_edu.sfm.masks import turn_mask
from gsplat_edu.sfm.photos import HEIC_ENDINGS, JPEG_ENDINGS, PhotoFacts
from gsplat_edu.sfm.scale import Sight, placed as placed_world

QUALITY = 95
"""JPEG quality of undistorted photos."""

PARTS = ("images", "masks", SCALE_FILE, "sparse")
"""Parts of a capture. The model comes last: its presence means that the capture is complete."""

PUBLISHED = "published.json"
"""File in the work folder that names the parts of the capture written by this program."""

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Effect of a clockwise quarter turn of the image on camera coordinates: right becomes down."""


@dataclass(frozen=True, eq=False)
class Undistorted:
    """A photo of the capture.

    Args:
        photo: The original photo.
        name: Its name in images/.
        lens: Its lens, at the size of the file.
        pinhole: Intrinsics of the undistorted, upright photo.
    """

    photo: PhotoFacts
    name: str
    lens: Lens
    pinhole: Intrinsics

    def entry(self) -> dict[str, Any]:
        """Return the photo's entry for `gsplat_edu.sfm.engine.jobs.finish`."""
        p = self.pinhole  # formats put the first pixel's centre at (0.5, 0.5)
        sizes = {"name": self.name, "W": p.W, "H": p.H, "turns": self.photo.turns}
        return sizes | {"fx": p.fx, "fy": p.fy, "cx": p.cx + 0.5, "cy": p.cy + 0.5}


def build_capture(
    model: Mapping[str, Any],
    photos: Sequence[PhotoFacts],
    source: Path,
    folder: Path,
    progress: Callable[[str, int, int], None],
    scale: str = AUTO,
    say: Callable[[str], None] = lambda sentence: None,
) -> dict[str, Any]:
    """Write images/, masks/ (if a photo has a mask), scale.json (if it is known) and sparse/0 into folder/result.

    Args:
        model: The result of `gsplat_edu.sfm.mapping.map_photos`.
        photos: All photos.
        source: Their folder.
        folder: Work folder; result/ in it is recreated.
        progress: Called with the number of undistorted photos.
        scale: As for `gsplat_edu.sfm.scale.placed`.
        say: As for `gsplat_edu.sfm.scale.placed`.

    Returns:
        "points", their number; "error" in px of the undistorted photos; "left_out", the names of photos without a pose;
        "unclear", photos of another size with an ambiguous focal length; and "doubtful", other photos whose pose did
        not count. "scale" is the scale as JSON, or None.

    Raises:
        ArgumentError: a mark of the scale cannot be used.
        DatasetError: a photo can no longer be decoded, or COLMAP failed.
    """
    result = folder / "result"
    shutil.rmtree(result, ignore_errors=True)
    found, placed = folder / model["folder"], set(model["names"])
    entries, cameras, sights = _views(found, [photo for photo in photos if photo.copy in placed])
    cloud = read_points(found)
    if cloud is None:
        raise DatasetError(f"{found}: contains no points; the photos show too little in common")
    move, known = placed_world(cameras, cloud.points, sights, scale, say)
    _write_photos(entries, source, result, progress)
    if known is not None:
        write_scale(result, known)
    facts = call(
        "finish",
        folder / "log.txt",
        model=str(found),
        out=str(result / "sparse" / "0"),
        rotation=move.R.tolist(),
        move=move.t.tolist(),
        scale=move.s,
        photos={entry.photo.copy: entry.entry() for entry in entries},
    )
    unclear = set(model["unclear"]) - placed
    doubtful = set(model["doubtful"]) - placed - unclear
    others = {photo.copy for photo in photos} - placed - unclear - doubtful
    kinds = {"left_out": others, "unclear": unclear, "doubtful": doubtful}
    return (
        facts
        | {"scale": None if known is None else known.json()}
        | {kind: [photo.name for photo in photos if photo.copy in copies] for kind, copies in kinds.items()}
    )


def _views(model: Path, photos: Sequence[PhotoFacts]) -> tuple[list[Undistorted], list[Camera], list[Sight]]:
    """Return the photos of the capture, their cameras in the model's world, and the photos before undistortion."""
    poses = {pose.name: pose for pose in read_images(model / "images.bin")}
    lenses = read_cameras(model / "cameras.bin")
    entries, cameras, sights = list[Undistorted](), list[Camera](), list[Sight]()
    for photo, name in zip(photos, output_names(photos), strict=True):
        pose = poses[photo.copy]
        lens = lenses[pose.camera].scaled(photo.W, photo.H)
        pinhole = lens.undistorted().turned(photo.turns)
        entries.append(Undistorted(photo, name, lens, pinhole))
        R, turn = quat_to_R(pose.quat), np.linalg.matrix_power(QUARTER, photo.turns)
        eye = -R.T @ np.array(pose.shift)
        cameras.append(Camera.posed(turn @ R, eye, pinhole))
        sights.append(Sight(photo, lens, R, eye))
    return entries, cameras, sights


def published(folder: Path) -> tuple[str, ...]:
    """Return the parts of the capture that earlier runs wrote; the others belong to the user.

    Args:
        folder: Work folder.

    Raises:
        DatasetError: the file that lists them is damaged.
    """
    path = folder / PUBLISHED
    if not path.is_file():
        return _published_before(folder / "stages.json")
    try:
        named = parse_json(read_text(path))["parts"]
        return tuple(part for part in PARTS if part in named)
    except (ValueError, KeyError, TypeError):
        raise DatasetError(f"{path}: is damaged; give another folder, or remove the capture") from None


def _published_before(stages: Path) -> tuple[str, ...]:
    """Return the parts of a capture that an earlier version, without published.json, wrote."""
    try:
        finished = parse_json(read_text(stages))["stages"]["capture"]["facts"] is not None
    except (OSError, ValueError, KeyError, TypeError):
        return ()
    return ("images", "sparse") if finished else ()


def publish(folder: Path, out: Path) -> None:
    """Move the result of `build_capture` into the capture, replacing only parts written by an earlier run.

    Args:
        folder: Work folder.
        out: The capture.

    Raises:
        ArgumentError: a part exists that no run wrote.
    """
    new = [part for part in PARTS if (folder / "result" / part).exists()]
    ours = published(folder)
    for part in new:
        if part not in ours and (out / part).exists():
            raise ArgumentError(
                f"OUT: {out / part} was not written by this command; move it away and run the same command to resume"
            )
    note_published(folder, {*ours, *new})
    old = folder / "old"
    shutil.rmtree(old, ignore_errors=True)
    old.mkdir()
    for part in reversed(ours):
        if (out / part).exists():
            (out / part).replace(old / part)
    for part in new:
        (folder / "result" / part).replace(out / part)
    note_published(folder, set(new))
    shutil.rmtree(old, ignore_errors=True)
    shutil.rmtree(folder / "result", ignore_errors=True)


def note_published(folder: Path, parts: Iterable[str]) -> None:
    """Record which parts of the capture were written by this program.

    Args:
        folder: Work folder.
        parts: Some of `PARTS`.
    """
    with written_aside(folder / PUBLISHED) as aside:
        aside.write_text(json.dumps({"parts": sorted(parts)}) + "\n", encoding="utf-8")


def output_names(photos: Sequence[PhotoFacts]) -> list[str]:
    """Give the undistorted photos distinct names after the photos, with the endings of their formats.

    Args:
        photos: The photos.

    Returns:
        Paths below images/: JPEGs keep their names, HEIC becomes .jpg, others end in .png. Characters that
        COLMAP's files cannot store become "_".
    """
    paths = [PurePosixPath(re.sub("[\\\\\x00-\x1f\ud800-\udfff]", "_", photo.name)) for photo in photos]
    names = list[str]()
    taken = {str(folder).lower() for path in paths for folder in path.parents}  # folders' names are taken too
    for path in paths:
        kind = path.suffix.lower()
        base, ending = (
            path.with_suffix(""),
            path.suffix if kind in JPEG_ENDINGS else ".jpg" if kind in HEIC_ENDINGS else ".png",
        )
        name, number = f"{base}{ending}", 2
        while name.lower() in taken:  # some file systems ignore case
            name, number = f"{base}_{number}{ending}", number + 1
        taken.add(name.lower())
        names.append(name)
    return names


def _write_photos(
    entries: Sequence[Undistorted], source: Path, result: Path, progress: Callable[[str, int, int], None]
) -> None:
    """Undistort and turn photos in parallel."""
    largest = max(entry.lens.W * entry.lens.H for entry in entries)
    pool = ThreadPoolExecutor(max(1, min(os.cpu_count() or 1, AT_ONCE // largest)))
    futures = [pool.submit(_write_photo, entry, source, result) for entry in entries]
    try:
        for done, future in enumerate(futures, 1):
            future.result()
            progress("undistorting", done, len(entries))
    finally:
        pool.shutdown(cancel_futures=True)


def _write_photo(entry: Undistorted, source: Path, result: Path) -> None:
    lens, target = entry.lens, result / "images" / entry.name
    target.parent.mkdir(parents=True, exist_ok=True)
    if entry.photo.final:
        shutil.copyfile(source / entry.photo.name, target)
        if entry.photo.mask:
            mask = result / "masks" / f"{entry.name}.png"
            mask.parent.mkdir(parents=True, exist_ok=True)
            given = Path(entry.photo.mask)
            if given.suffix.lower() == ".png":
                shutil.copyfile(given, mask)
            else:
                turn_mask(given, UPRIGHT, mask)
        return
    counts = Path(entry.photo.mask) if entry.photo.mask else None
    photo = load_photo(
        PhotoFile(source / entry.photo.name, counts, lens, lens.W, lens.H, None, entry.photo.sensor)
    )
    pixels = np.asarray(photo.image)
    if photo.alpha is not None:
        pixels = np.concatenate([pixels, photo.alpha[..., None]], axis=2)
    jpeg = target.suffix.lower() in JPEG_ENDINGS and pixels.shape[2] == 3
    options: dict[str, Any] = {"quality": QUALITY, "subsampling": 0} if jpeg else {"compress_level": 3}
    upright_pixels = np.ascontiguousarray(np.rot90(pixels, -entry.photo.turns))
    Image.fromarray(upright_pixels).save(target, format="JPEG" if jpeg else "PNG", **options)
    if photo.mask is not None:
        mask = result / "masks" / f"{entry.name}.png"
        mask.parent.mkdir(parents=True, exist_ok=True)
        upright_mask = np.where(np.rot90(photo.mask, -entry.photo.turns), 255, 0).astype(np.uint8)
        Image.fromarray(upright_mask).save(mask)
