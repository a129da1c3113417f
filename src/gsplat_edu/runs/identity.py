"""Checks that a resumed run matches its configuration and capture."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.images import PhotoFile
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.scene.camera import Camera
from gsplat_edu.train.config import ONLY_FOR
from gsplat_edu.train.part import parts

SAME = ("train", "render", "data")
"""Sections of config.json that must be equal in a resumed run."""

MAY_DIFFER = {"data": ("path", "points", "scene", "image_memory"), "train": ("iterations",)}
"""Keys of these sections that may differ: files with the same contents may have moved, and a run may be extended."""

DIGESTS = "digests"
"""Key of config.json: digests of what parts of the training added to the views, by part."""

MOVED = 1e-9
"""Tolerance of camera coordinates, relative and absolute: subtracting an origin and adding it back rounds."""


def check_options(folder: RunFolder, new: dict[str, Any]) -> None:
    """Compare the options of a resumed run with those it was started with.

    Settings of strategies that the run does not use may differ.

    Raises:
        CheckpointError: an option differs, or config.json is damaged; the message names the option.
    """
    old = folder.read_config()
    length, wanted = (_section(folder, config, "train").get("iterations") for config in (old, new))
    if not isinstance(length, int) or not isinstance(wanted, int):
        raise CheckpointError(f"{folder.config}: train: iterations: is not a whole number; fix the file")
    if wanted < length:
        raise CheckpointError(
            f"--resume: {folder.path} was started with iterations = {length}, not {wanted}: a run can be extended,"
            " not shortened; give at least as many, or stop it earlier with --time-limit"
        )
    used = _section(folder, old, "train").get("strategy")
    idle = {name for strategy, names in ONLY_FOR.items() if strategy != used for name in names}
    for section in SAME:
        before, now = (_section(folder, config, section) for config in (old, new))
        names = {*before, *now} - idle - set(MAY_DIFFER.get(section, ()))
        if section == "data":
            names -= {key for part in parts().values() for key in part.recorded(None)}
        # The strategy first: it explains other differences.
        for key in sorted(names, key=lambda name: (name != "strategy", name)):
            a, b = (_plain(values.get(key)) for values in (before, now))
            if a != b:
                problem = f"--resume: {folder.path} was started with {key} = {a}, not {b}"
                raise CheckpointError(f"{problem}; give the same options or another --out")


def fingerprint(dataset: Dataset) -> str:
    """Return a digest of the start points and of the first and the last training photo."""
    digest = hashlib.sha256()
    photos = [view.read().image for view in (dataset.train[0], dataset.train[-1])]
    for array in (dataset.points, dataset.colors, *photos):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def photo_digests(dataset: Dataset) -> dict[str, Any]:
    """Return the contents of photos.json: by view, size and digest of the photo's file and of its mask's.

    Files that have not been read yet are hashed in parallel.
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
    """Describe how a capture differs from the one a run was started with; None if it does not.

    The comparison covers the views, their splits and cameras, and the photos' files. Paths and file times do not
    matter, so a moved or copied capture is the same. Runs of older versions store less, so less is compared.

    Raises:
        CheckpointError: a file of the run is damaged.
    """
    here = [(view.name, "train") for view in dataset.train] + [(view.name, "test") for view in dataset.test]
    if folder.cameras.is_file():
        known = [(name, split) for name, split, _ in folder.read_cameras(dataset.origin)]
        if len(known) != len(here):
            return f"the run was started with {len(known)} views, but this capture has {len(here)}"
        if changed := [
            name for (name, split), view in zip(known, here, strict=True) if (name, split) != view
        ]:
            return f"different cameras: {changed[0]} differs"
    if (found := views_difference(folder, dataset)) is not None:
        return found
    if folder.photos.is_file() or not _comparable(config := folder.read_config()):
        return None
    return "different photos or start points" if config.get("fingerprint") != fingerprint(dataset) else None


def views_difference(folder: RunFolder, dataset: Dataset) -> str | None:
    """Describe how the cameras and photos of a dataset differ from those that a folder knows; None if they do not.

    The folder may know more views than the dataset has, and may have split them otherwise.

    Raises:
        CheckpointError: a file of the folder is damaged.
    """
    if folder.cameras.is_file():
        known = {name: camera for name, _, camera in folder.read_cameras(dataset.origin)}
        for view in (*dataset.train, *dataset.test):
            if view.name not in known or not _alike(known[view.name], view.camera):
                return f"different cameras: {view.name} differs"
    then = folder.read_photos()
    if then is not None:
        now = photo_digests(dataset)
        if changed := [name for name in now if then.get(name) != now[name]]:
            return f"different photos: {len(changed)} of {len(now)} changed since the run started, first {changed[0]}"
    return None


def check_capture(folder: RunFolder, dataset: Dataset) -> None:
    """Compare the capture with the one a run was started on: views, splits, cameras, photos and start points.

    Raises:
        CheckpointError: they differ, and the message names the first such view; or a file of the run is damaged.
    """
    if not folder.cameras.is_file():
        folder.read_cameras()  # raises an error that names the missing file
    found = capture_difference(folder, dataset)
    if found is None and folder.read_config().get("fingerprint") != fingerprint(dataset):
        found = "different start points" if folder.photos.is_file() else "different photos or start points"
    if found is not None:
        raise CheckpointError(
            f"--resume: {folder.path} was started with another capture: {found}; "
            "resume with the original capture, or give another --out"
        )


def check_digests(folder: RunFolder, digests: Mapping[str, str]) -> None:
    """Compare what parts of a resumed training add to the views with what they added when the run was started.

    Args:
        folder: The run's folder.
        digests: By part.

    Raises:
        CheckpointError: they differ.
    """
    stored = folder.read_config().get(DIGESTS, {})
    for name in {**digests, **stored}:
        if stored.get(name) != digests.get(name):
            what = name.replace("_", " ")
            was = f"with other {what}" if name in stored else f"without {what}"
            raise CheckpointError(
                f"--resume: {folder.path} was started {was}; give the same options with the same files, or another"
                " --out"
            )


def _comparable(config: dict[str, Any]) -> bool:
    """Return whether the fingerprint covers only the capture; start points from a separate file are part of it."""
    data = config.get("data")
    return "fingerprint" in config and isinstance(data, dict) and data.get("points") is None


def _alike(a: Camera, b: Camera) -> bool:
    one, other = (np.array([*c.R.ravel(), *c.eye, c.fx, c.fy, c.cx, c.cy, c.H, c.W]) for c in (a, b))
    kinds = [(c.projection, c.readout, c.exposure, c.motion is None) for c in (a, b)]
    if kinds[0] != kinds[1]:
        return False
    moving = a.motion is None or b.motion is None or np.allclose(a.motion, b.motion, rtol=MOVED, atol=MOVED)
    return bool(moving and np.allclose(one, other, rtol=MOVED, atol=MOVED))


def _section(folder: RunFolder, config: dict[str, Any], name: str) -> dict[str, Any]:
    value = config.get(name, {})
    if not isinstance(value, dict):
        raise CheckpointError(
            f"{folder.config}: {name}: is not an object; fix the file or give another --out"
        )
    return value


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value
