"""From matches to poses: one way after the other, until most photos have one."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gsplat_edu.data.colmap import read_cameras, read_images
from gsplat_edu.data.lens import straightened
from gsplat_edu.errors import DatasetError
from gsplat_edu.sfm.colmap import COLMAP_SEED, call

ENOUGH = 0.8
"""Share of the photos that hang together by matches that have to have a pose for the first way to be the last."""

FEW_PHOTOS = 10
"""Photos of one camera from which its model is OPENCV: fewer do not fix eight numbers."""

MANY_PHOTOS = 400
"""Photos beyond which the global mapper comes first: the incremental one's time grows with their square."""

FEWEST = 3
"""Photos of a model that is worth having. Two photos alone get no pose: no mapper makes a model of so few here."""


@dataclass(frozen=True)
class Attempt:
    """One way of mapping.

    Args:
        mapper: "incremental" (Schönberger and Frahm 2016) or "global" (Pan et al. 2024, GLOMAP).
        model: COLMAP's camera model.
        per_photo: Every photo has a camera of its own.
        loose: Lower thresholds.
    """

    mapper: str
    model: str
    per_photo: bool = False
    loose: bool = False

    def __str__(self) -> str:
        """Say what it does."""
        words = [f"{self.mapper} mapper", self.model]
        words += ["a camera per photo"] * self.per_photo + ["lower thresholds"] * self.loose
        return ", ".join(words)


def attempts(mapper: str, model: str, photos: int, cameras: int, one_lens: bool) -> list[Attempt]:
    """List the ways in the order in which they are tried.

    Args:
        mapper: What the user asked for, or "auto".
        model: What the user asked for, or "auto".
        photos: How many there are.
        cameras: By how many cameras, as far as EXIF and sizes tell.
        one_lens: They are known to be of one camera, as the frames of a video are.
    """
    first_model = (
        model if model != "auto" else "OPENCV" if photos >= FEW_PHOTOS * cameras else "SIMPLE_RADIAL"
    )
    simple = model if model != "auto" else "SIMPLE_RADIAL"
    order = ["incremental", "global"] if photos <= MANY_PHOTOS else ["global", "incremental"]
    order = order if mapper == "auto" else [mapper]
    ways = [Attempt(name, first_model) for name in order]
    steady = "incremental" if mapper == "auto" else mapper
    ways.append(Attempt(steady, simple, loose=True))
    if not one_lens and cameras < photos:
        ways.append(Attempt(steady, simple, per_photo=True, loose=True))
    return ways


def map_photos(
    folder: Path,
    ways: Sequence[Attempt],
    total: int,
    connected: int,
    threads: int,
    say: Callable[[str], None],
    progress: Callable[[str, int, int], None],
) -> dict[str, Any]:
    """Try ways until one gives most of the photos a pose; keep the model with the most.

    Args:
        folder: Holds database.db and photos/; models/ is made anew.
        ways: In this order.
        total: How many photos there are.
        connected: How many of them hang together by matches.
        threads: For COLMAP.
        say: Told what each way gave, if it was not enough.
        progress: Told how many photos have a pose.

    Returns:
        The model: its "folder" below `folder`, the "names" of the photos with a pose, "points", "error" in px, and the
        "way" that gave it.

    Raises:
        DatasetError: no way gives enough photos a pose to be a model, or the last one failed and none gave any.
    """
    models = folder / "models"
    shutil.rmtree(models, ignore_errors=True)
    best: dict[str, Any] = {"names": []}
    for number, way in enumerate(ways, 1):
        out = models / str(number)
        out.mkdir(parents=True)
        try:
            largest = _largest(
                folder, out, way, threads, lambda done: progress("mapping", min(done, total), total)
            )
        except DatasetError as error:
            if number == len(ways) and not best["names"]:
                raise
            say(f"{way}: {error}")
            continue
        if len(largest["names"]) > len(best["names"]):
            best = largest | {"folder": f"models/{number}/{largest['folder']}", "way": str(way)}
        if len(best["names"]) >= ENOUGH * connected:
            break
        say(f"{way}: {len(largest['names'])} of {total} photos have a pose")
    if len(best["names"]) < min(FEWEST, total):
        raise DatasetError(no_overlap(f"of {total} photos, {len(best['names'])} could be given a pose"))
    return best


def _largest(
    folder: Path, out: Path, way: Attempt, threads: int, progress: Callable[[int], None]
) -> dict[str, Any]:
    """Map in one way, and return the model with the most photos; without "names" where there is none."""
    found = call(
        "mapping",
        folder / "log.txt",
        progress,
        database=str(folder / "database.db"),
        photos=str(folder / "photos"),
        out=str(out),
        attempt=asdict(way),
        threads=threads,
        seed=COLMAP_SEED,
    )["models"]
    usable = [_usable(out, model) for model in found]
    return max(usable, key=lambda model: (len(model["names"]), -model["error"]), default={"names": []})


def no_overlap(what: str) -> str:
    """Say what is wrong, and how to photograph."""
    return (
        f"{what}: the photos show too little in common; walk around the subject in small steps, each photo showing two "
        "thirds of the one before, sharp and in even light (plain walls, glass and mirrors give nothing to hold on to)"
    )


def _usable(out: Path, model: dict[str, Any]) -> dict[str, Any]:
    """Leave out photos whose lens came out so odd that they cannot be undistorted."""
    folder, good = out / model["folder"], dict[int, bool]()
    for number, lens in read_cameras(folder / "cameras.bin").items():
        try:
            straightened(lens)
            good[number] = True
        except DatasetError:
            good[number] = False
    names = [pose.name for pose in read_images(folder / "images.bin") if good[pose.camera]]
    return model | {"names": sorted(names)}
