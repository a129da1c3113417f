"""Turn a model of the working copies into a capture: upright photos and a matching model.

Photos are undistorted, so that every program can read the capture. Fisheyes and panoramas stay whole, because no
pinhole shows all of them.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import parse_json, read_text
from gsplat_edu.data.colmap import read_cameras, read_images, read_points
from gsplat_edu.data.images import PhotoFile, load_photo
from gsplat_edu.data.lens import FISHEYE, Lens
from gsplat_edu.data.panorama import FaceLens
from gsplat_edu.data.scale import SCALE_FILE, Scale, write_scale
from gsplat_edu.io.edit import Similarity
from gsplat_edu.photos.decoding import AT_ONCE, decode_mask, upright_image_size
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussian_math import quat_to_R
from gsplat_edu.scene.intrinsics import Intrinsics
from gsplat_edu.sfm.circle import Circle
from gsplat_edu.sfm.colmap import call
from gsplat_edu.sfm.photos import HEIC_ENDINGS, JPEG_ENDINGS, PhotoFacts
from gsplat_edu.sfm.scale import Sight
from gsplat_edu.sfm.whole_photos import (
    DIM,
    WholePhotos,
    copy_or_encode,
    save,
    write_counting,
    write_panorama,
)
from gsplat_edu.sfm.wide_lenses import rim_line

PARTS = ("images", "masks", SCALE_FILE, "sparse")
"""Parts of a capture. The model comes last: its presence means that the capture is complete."""

PUBLISHED = "published.json"
"""File in the work folder that names the parts of the capture written by this program."""

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Effect of a clockwise quarter turn of the image on camera coordinates: right becomes down."""


Placing = Callable[
    [Sequence[Camera], Float64[np.ndarray, "N 3"], Sequence[Sight]], tuple[Similarity, Scale | None]
]
"""Chooses the world of a capture from its cameras and points, such as `gsplat_edu.sfm.scale.placed`: the transform into
it, and its scale if known."""


@dataclass(frozen=True, eq=False)
class NewPhoto:
    """A photo of the capture.

    Args:
        photo: The original photo, or a face of a panorama.
        name: Its name in images/; faces have the name of their panorama.
        lens: Its lens, at the size of the file.
        pinhole: Intrinsics of the undistorted, upright photo.
        rotation: From the axes of the original camera to those of the new photo's.
        circle: The round image of a fisheye at the size of the file; None if it has none.
    """

    photo: PhotoFacts
    name: str
    lens: Lens
    pinhole: Intrinsics
    rotation: Float64[np.ndarray, "3 3"]
    circle: Circle | None = None

    def entry(self) -> dict[str, Any]:
        """Return the photo's entry for `gsplat_edu.sfm.engine.jobs.finish`."""
        p, turns = self.pinhole, self.photo.turns
        params = [p.fx, p.fy, p.cx + 0.5, p.cy + 0.5]  # formats put the first pixel's centre at (0.5, 0.5)
        model = "PINHOLE"
        if isinstance(self.lens, FaceLens):
            model, p, params = "EQUIRECTANGULAR", self.lens, [self.lens.W, self.lens.H]
        elif self.lens.model == FISHEYE:
            missing = 4 - len(self.lens.coefficients)
            model, p = "OPENCV_FISHEYE", self.lens.turned(turns)
            params = [p.fx, p.fy, p.cx + 0.5, p.cy + 0.5, *self.lens.coefficients, *[0.0] * missing]
        sizes = {"name": self.name, "W": p.W, "H": p.H, "rotation": self.rotation.tolist()}
        return sizes | {"model": model, "params": params}


def build_capture(
    model: Mapping[str, Any],
    photos: Sequence[PhotoFacts],
    source: Path,
    folder: Path,
    progress: Callable[[str, int, int], None],
    place: Placing,
    say: Callable[[str], None] = lambda sentence: None,
    whole: WholePhotos = WholePhotos(),  # noqa: B008
) -> dict[str, Any]:
    """Write images/, masks/ (if a photo has a mask), scale.json (if it is known) and sparse/0 into folder/result.

    Args:
        model: The result of `gsplat_edu.sfm.mapping.map_photos`.
        photos: All photos.
        source: Their folder.
        folder: Work folder; result/ in it is recreated.
        progress: Called with the number of photos written.
        place: Chooses the world of the capture.
        say: Receives how far a fisheye sees.
        whole: What is known of photos that keep their lens.

    Returns:
        "points", their number; "error" in px of the photos written; "left_out", the names of photos without a pose;
        "unclear", photos of another size with an ambiguous focal length; and "doubtful", other photos whose pose did
        not count. "scale" is the scale as JSON, or None.

    Raises:
        ArgumentError: a mark of the scale cannot be used.
        DatasetError: a photo can no longer be decoded, or COLMAP failed.
    """
    result = folder / "result"
    shutil.rmtree(result, ignore_errors=True)
    found, placed = folder / model["folder"], set(model["names"])
    entries, cameras, sights = _views(found, [photo for photo in photos if photo.copy in placed], whole)
    cloud = read_points(found)
    if cloud is None:
        raise DatasetError(f"{found}: contains no points; the photos show too little in common")
    move, known = place(cameras, cloud.points, sights)
    for line in _rims(entries):
        say(line)
    _write_photos(entries, source, result, whole, progress)
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
    return facts | {"scale": None if known is None else known.json()} | _without_pose(model, photos)


def _without_pose(model: Mapping[str, Any], photos: Sequence[PhotoFacts]) -> dict[str, list[str]]:
    """Return the names of the photos without a pose that counts, by the reason."""
    placed = set(model["names"])
    unclear = set(model["unclear"]) - placed
    doubtful = set(model["doubtful"]) - placed - unclear
    others = {photo.copy for photo in photos} - placed - unclear - doubtful
    kinds = {"left_out": others, "unclear": unclear, "doubtful": doubtful}
    return {kind: [photo.name for photo in photos if photo.copy in copies] for kind, copies in kinds.items()}


def _views(
    model: Path, photos: Sequence[PhotoFacts], whole: WholePhotos
) -> tuple[list[NewPhoto], list[Camera], list[Sight]]:
    """Return the photos of the capture, pinholes in the model's world, and the photos with their own lenses."""
    poses = {pose.name: pose for pose in read_images(model / "images.bin")}
    lenses = read_cameras(model / "cameras.bin")
    entries, cameras, sights = list[NewPhoto](), list[Camera](), list[Sight]()
    faces = {} if not whole.panoramas else _panorama_faces(whole)
    names = [faces[photo.name].name for photo in photos] if faces else output_names(photos)
    for photo, name in zip(photos, names, strict=True):
        pose = poses[photo.copy]
        R = quat_to_R(pose.quat)
        eye = -R.T @ np.array(pose.shift)
        if faces:
            face = faces[photo.name]
            entries.append(NewPhoto(photo, name, face.lens, face.lens.undistorted(), face.lens.R.T))
            cameras.append(Camera.posed(R, eye, lenses[pose.camera]))
            if face.lens.number == 0:
                sights.append(Sight(face.panorama, face.lens, face.lens.R.T @ R, eye))
            continue
        lens = lenses[pose.camera].scaled(photo.W, photo.H)
        pinhole = lens.undistorted().turned(photo.turns)
        turn = np.linalg.matrix_power(QUARTER, photo.turns)
        circle = whole.circles.get(photo.copy)
        if circle is not None:
            circle = circle.scaled(photo.W / lenses[pose.camera].W)
        entries.append(NewPhoto(photo, name, lens, pinhole, turn, circle))
        cameras.append(Camera.posed(turn @ R, eye, pinhole))
        sights.append(Sight(photo, lens, R, eye))
    return entries, cameras, sights


class _Face(NamedTuple):
    """A face of a panorama."""

    panorama: PhotoFacts
    name: str  # of the panorama in images/
    lens: FaceLens


def _panorama_faces(whole: WholePhotos) -> dict[str, _Face]:
    """Return the panorama of each face, by the face's name."""
    facts = []
    for one in whole.panoramas:
        path = whole.folder / one.name
        W, H = upright_image_size(path)
        facts.append(PhotoFacts(one.name, one.name, W, H, place=one.place))
    return {
        face: _Face(panorama, name, FaceLens.of(panorama.W, panorama.H, number))
        for panorama, name, one in zip(facts, output_names(facts), whole.panoramas, strict=True)
        for number, face in enumerate(one.faces)
    }


def _rims(entries: Sequence[NewPhoto]) -> Iterator[str]:
    """Say how far each fisheye sees."""
    seen = set[tuple[Lens, Circle | None]]()
    for entry in entries:
        if entry.lens.model == FISHEYE and (entry.lens, entry.circle) not in seen:
            seen.add((entry.lens, entry.circle))
            yield rim_line(entry.lens, entry.circle)


def published(folder: Path) -> tuple[str, ...]:
    """Return the parts of the capture that earlier runs wrote; the others belong to the user.

    Args:
        folder: Work folder.

    Raises:
        DatasetError: the file that lists them is damaged.
    """
    path = folder / PUBLISHED
    if not path.is_file():
        return ()
    try:
        named = parse_json(read_text(path))["parts"]
        return tuple(part for part in PARTS if part in named)
    except (ValueError, KeyError, TypeError):
        raise DatasetError(f"{path}: is damaged; give another folder, or remove the capture") from None


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
    entries: Sequence[NewPhoto],
    source: Path,
    result: Path,
    whole: WholePhotos,
    progress: Callable[[str, int, int], None],
) -> None:
    """Write the photos in parallel, each panorama once."""
    entries = list({entry.name: entry for entry in entries}.values())
    largest = max(entry.lens.W * entry.lens.H for entry in entries)
    pool = ThreadPoolExecutor(max(1, min(os.cpu_count() or 1, AT_ONCE // largest)))
    panoramas = {face: one.name for one in whole.panoramas for face in one.faces}
    futures = []
    for entry in entries:
        target, mask = result / "images" / entry.name, result / "masks" / f"{entry.name}.png"
        if entry.photo.name in panoramas and isinstance(entry.lens, FaceLens):
            futures.append(pool.submit(write_panorama, whole, panoramas[entry.photo.name], target, mask))
        elif entry.lens.model == FISHEYE:
            futures.append(pool.submit(_write_fisheye, entry, source, target, mask))
        else:
            futures.append(pool.submit(_write_undistorted, entry, source, target, mask))
    try:
        for done, future in enumerate(futures, 1):
            future.result()
            progress("writing photos", done, len(entries))
    finally:
        pool.shutdown(cancel_futures=True)


def _write_fisheye(entry: NewPhoto, source: Path, target: Path, mask: Path) -> None:
    photo, lens = entry.photo, entry.lens
    copy_or_encode(source / photo.name, target, photo.sensor, photo.turns)
    counts = None if entry.circle is None else entry.circle.inside(lens.W, lens.H, DIM)
    if photo.mask:
        own = decode_mask(Path(photo.mask))
        counts = own if counts is None else own & counts
    if counts is not None:
        write_counting(np.rot90(counts, -photo.turns), mask)


def _write_undistorted(entry: NewPhoto, source: Path, target: Path, mask: Path) -> None:
    lens = entry.lens
    target.parent.mkdir(parents=True, exist_ok=True)
    counts = Path(entry.photo.mask) if entry.photo.mask else None
    photo = load_photo(
        PhotoFile(source / entry.photo.name, counts, lens, lens.W, lens.H, None, entry.photo.sensor)
    )
    pixels = np.asarray(photo.image)
    if photo.alpha is not None:
        pixels = np.concatenate([pixels, photo.alpha[..., None]], axis=2)
    save(np.rot90(pixels, -entry.photo.turns), target)
    if photo.mask is not None:
        write_counting(np.rot90(photo.mask, -entry.photo.turns), mask)
