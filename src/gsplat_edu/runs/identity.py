"""Whether a run that is taken up again is the run that was begun."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from gsplat_edu.camera import Camera
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.errors import CheckpointError
from gsplat_edu.runs.folder import RunFolder

SAME = ("train", "render", "data")
"""What of config.json a resumed run has to share with the one it goes on from."""

MAY_DIFFER = {"data": ("path", "points", "image_memory")}
"""What in them may be another all the same: files may have been moved, if they hold the same."""

MOVED = 1e-9
"""Part of a coordinate by which a camera may differ where an origin was subtracted and added again."""


def check_options(folder: RunFolder, new: dict[str, Any]) -> None:
    """Compare what a run was begun with and what it is to go on with.

    Raises:
        CheckpointError: they differ, or config.json is damaged; names the option.
    """
    old = folder.read_config()
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


def check_capture(folder: RunFolder, dataset: Dataset) -> None:
    """Compare the capture with the one a run was begun on: views, splits, cameras, and the fingerprint.

    Raises:
        CheckpointError: they differ; names the first view that does.
    """
    advice = "resume with the capture it was begun with, or name another --out"
    known = folder.read_cameras(dataset.origin)
    here = [(view, "train") for view in dataset.train] + [(view, "test") for view in dataset.test]
    if len(known) != len(here):
        raise CheckpointError(
            f"--resume: {folder.path} was begun with {len(known)} views, the capture has {len(here)}; {advice}"
        )
    for (name, split, camera), (view, part) in zip(known, here, strict=True):
        if (name, split) != (view.name, part) or not _alike(camera, view.camera):
            raise CheckpointError(
                f"--resume: {folder.path} was begun with other cameras: {view.name} differs; {advice}"
            )
    if folder.read_config().get("fingerprint") != fingerprint(dataset):
        raise CheckpointError(
            f"--resume: {folder.path} was begun with other photos or start points; {advice}"
        )


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
