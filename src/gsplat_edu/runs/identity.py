"""Checks that a resumed run matches its configuration and capture."""

from __future__ import annotations

import dataclasses
import hashlib
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from gsplat_edu.camera import Camera
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.images import PhotoFile
from gsplat_edu.errors import CheckpointError
from gsplat_edu.runs.folder import RunFolder

SAME = ("train", "render", "data")
"""What of config.json a resumed run has to share with the one it goes on from."""

MAY_DIFFER = {"data": ("path", "points", "scene", "image_memory"), "train": ("iterations",)}
"""What may differ all the same: files may have been moved, if their contents are equal, and a run may be extended."""

MOVED = 1e-9
"""Tolerance of camera coordinates, relative and absolute: subtracting an origin and adding it again rounds."""


def check_options(folder: RunFolder, new: dict[str, Any]) -> None:
    """Compare the options that a run was begun with and those it is resumed with.

    Raises:
        CheckpointError: they differ, or config.json is damaged; names the option.
    """
    old = folder.read_config()
    length, wanted = (_section(folder, config, "train").get("iterations") for config in (old, new))
    if not isinstance(length, int) or not isinstance(wanted, int):
        raise CheckpointError(f"{folder.config}: train: iterations: is no whole number; mend the file")
    if wanted < length:
        raise CheckpointError(
            f"--resume: {folder.path} was begun with iterations = {length}, not {wanted}: a run can be extended,"
            " not shortened; give as many or more, or end it earlier with --time-limit"
        )
    for section in SAME:
        before, now = (_section(folder, config, section) for config in (old, new))
        for key in sorted({*before, *now} - set(MAY_DIFFER.get(section, ()))):
            a, b = (_plain(values.get(key)) for values in (before, now))
            if a != b:
                begun = f"--resume: {folder.path} was begun with {key} = {a}, not {b}"
                raise CheckpointError(f"{begun}; give the same options, or another --out")


def fingerprint(dataset: Dataset) -> str:
    """Return a digest of the start points and of the first and the last training photo."""
    digest = hashlib.sha256()
    photos = [view.read().image for view in (dataset.train[0], dataset.train[-1])]
    for array in (dataset.points, dataset.colors, *photos):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def photo_digests(dataset: Dataset) -> dict[str, Any]:
    """Return what photos.json holds: by view, size and digest of the photo's file, and of its mask's.

    Files that were not read yet are hashed, several at a time.
    """
    used = {view.name for view in (*dataset.train, *dataset.test)}
    files = [(name, source) for name, source in dataset.files if name in used]

    def entry(source: PhotoFile) -> dict[str, Any] | None:
        photo = dataset.images.watch.digest(source.path)
        mask = None if source.mask is None else dataset.images.watch.digest(source.mask)
        facts = None if photo is None else dataclasses.asdict(photo)
        return facts if facts is None or mask is None else facts | {"mask": dataclasses.asdict(mask)}

    with ThreadPoolExecutor(dataset.images.workers) as pool:
        entries = pool.map(entry, [source for _, source in files])
        return {name: facts for (name, _), facts in zip(files, entries, strict=True)}


def capture_difference(folder: RunFolder, dataset: Dataset) -> str | None:
    """Say how a capture differs from the one that a run was begun with; None if nothing does.

    Compared are the views, their splits and cameras, and the files of the photos. A capture that was moved or copied
    is the same: places and times do not count. Runs of older versions keep less, and then less is compared.

    Raises:
        CheckpointError: a file of the run is damaged.
    """
    here = [(view, "train") for view in dataset.train] + [(view, "test") for view in dataset.test]
    known = folder.read_cameras(dataset.origin) if folder.cameras.is_file() else None
    if known is not None and len(known) != len(here):
        return f"the run was begun with {len(known)} views, this capture has {len(here)}"
    for (name, split, camera), (view, part) in zip(known or (), here, strict=known is not None):
        if (name, split) != (view.name, part) or not _alike(camera, view.camera):
            return f"other cameras: {view.name} differs"
    then = folder.read_photos()
    if then is not None:
        now = photo_digests(dataset)
        if changed := [name for name in now if then.get(name) != now[name]]:
            return f"other photos: {len(changed)} of {len(now)} have changed since the run began, first {changed[0]}"
    elif _comparable(config := folder.read_config()) and config.get("fingerprint") != fingerprint(dataset):
        return "other photos or start points"
    return None


def check_capture(folder: RunFolder, dataset: Dataset) -> None:
    """Compare the capture with the one a run was begun on: views, splits, cameras, photos and start points.

    Raises:
        CheckpointError: they differ; names the first view that does. Or a file of the run is damaged.
    """
    if not folder.cameras.is_file():
        folder.read_cameras()  # says what is missing
    found = capture_difference(folder, dataset)
    if found is None and folder.read_config().get("fingerprint") != fingerprint(dataset):
        found = "other start points" if folder.photos.is_file() else "other photos or start points"
    if found is not None:
        raise CheckpointError(
            f"--resume: {folder.path} was begun with another capture: {found}; "
            "resume with the capture it was begun with, or name another --out"
        )


def _comparable(config: dict[str, Any]) -> bool:
    """Say whether the fingerprint is of the capture alone: it covers the start points, which may be given apart."""
    data = config.get("data")
    return "fingerprint" in config and isinstance(data, dict) and data.get("points") is None


def _alike(a: Camera, b: Camera) -> bool:
    one, other = (np.array([*c.R.ravel(), *c.eye, c.fx, c.fy, c.cx, c.cy, c.H, c.W]) for c in (a, b))
    return bool(np.allclose(one, other, rtol=MOVED, atol=MOVED))


def _section(folder: RunFolder, config: dict[str, Any], name: str) -> dict[str, Any]:
    value = config.get(name, {})
    if not isinstance(value, dict):
        raise CheckpointError(f"{folder.config}: {name}: is no object; mend the file or name another --out")
    return value


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value
