"""From matches to poses: one way after the other, until most photos have one."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from gsplat_edu.data.colmap import read_cameras, read_images
from gsplat_edu.errors import DatasetError
from gsplat_edu.sfm.colmap import COLMAP_SEED, call
from gsplat_edu.sfm.source import FEWEST

ENOUGH = 0.8
"""Stop once this share of the photos that are connected by matches has a pose that counts."""

MANY_PHOTOS = 400
"""Photos beyond which the global mapper comes first: the incremental one's time grows with their square."""

ENOUGH_FOR_FREE = 20
"""Photos per camera from which placing them with a freer lens is tried: fewer are not divided into halves that judge a
lens (`gsplat_edu.sfm.engine.lenses.WITNESSES`)."""

MAIN = 0.5
"""Share of the photos that have one size from which the others follow their lens (`gsplat_edu.sfm.engine.kin`)."""

OWN = 10
"""Photos of one size from which they have a camera of their own, as in `gsplat_edu.sfm.engine.kin`."""

SAME = 0.5
"""Share of the connected photos from which two ways that agree are believed."""

NEARLY = 0.97
"""Models whose worth is at least this share of the best one's are compared by their points as well."""

PER_PHOTO = 6 / 8
"""Worth of a photo with a camera of its own: its points have to fix eight numbers, the pose, a focal length and a
coefficient of distortion, instead of six."""


@dataclass(frozen=True)
class Attempt:
    """One way of mapping.

    Args:
        mapper: "incremental" (Schönberger and Frahm 2016) or "global" (Pan et al. 2024, GLOMAP).
        model: COLMAP's camera model.
        free: Photos are placed with a freer lens; it is then dropped, and held-out photos judge what is refined.
        per_photo: Every photo has a camera of its own.
        loose: Lower thresholds.
    """

    mapper: str
    model: str
    free: bool = False
    per_photo: bool = False
    loose: bool = False

    def __str__(self) -> str:
        """Say what it does."""
        words = [f"{self.mapper} mapper"] + [self.model] * (self.model != "auto")
        words += ["a freer lens at first"] * self.free
        words += ["a camera per photo"] * self.per_photo + ["lower thresholds"] * self.loose
        return ", ".join(words)


def attempts(mapper: str, model: str, photos: int, cameras: int, one_lens: bool) -> list[Attempt]:
    """List the ways in the order in which they are tried.

    Args:
        mapper: What the user asked for, or "auto".
        model: What the user asked for, or "auto".
        photos: How many there are.
        cameras: How many cameras they are mapped with.
        one_lens: They are known to be of one camera, as the frames of a video are.
    """
    order = ["incremental", "global"] if photos <= MANY_PHOTOS else ["global", "incremental"]
    order = order if mapper == "auto" else [mapper]
    ways = [Attempt(name, model) for name in order]
    steady = "incremental" if mapper == "auto" else mapper
    if model == "auto" and photos >= ENOUGH_FOR_FREE * cameras:
        ways.append(Attempt(steady, model, free=True))
    ways.append(Attempt(steady, model, loose=True))
    if not one_lens and cameras < photos:
        ways.append(Attempt(steady, model, per_photo=True, loose=True))
    return ways


def shared_cameras(groups: Sequence[Mapping[str, Any]]) -> dict[int, int]:
    """Find cameras of several sizes that are mapped as one: photos scaled, each to another size.

    A camera of one or two photos fixes its focal length badly, and if most photos are of such cameras, there is no main
    one to compare with. Photos of the same kind, by EXIF, and of the same aspect then share a camera. Photos of one
    camera that were cropped, each to another aspect, still have one each.

    Args:
        groups: Of photos that share a size: "names", "width" and "height", px, and their "kind" by EXIF.

    Returns:
        The number of the camera that replaces another one, from 1 in the order of the groups. Empty where most photos
        are of one size.
    """
    total = sum(len(group["names"]) for group in groups)
    if max((len(group["names"]) for group in groups), default=0) >= MAIN * total:
        return {}
    few = [number for number, group in enumerate(groups, 1) if len(group["names"]) < OWN]
    few.sort(key=lambda number: (-groups[number - 1]["width"], number))  # scaled to the largest
    shared, leaders = dict[int, int](), list[int]()
    for number in few:
        group = groups[number - 1]
        alike = (other for other in leaders if _scaled(groups[other - 1], group))
        if (leader := next(alike, None)) is None:
            leaders.append(number)
        else:
            shared[number] = leader
    return shared


def _scaled(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Say whether photos may be of one camera, scaled: each side is off by half a pixel of rounding at most."""
    W, H, w, h = one["width"], one["height"], other["width"], other["height"]
    return bool(one["kind"] == other["kind"] and abs(W * h - H * w) <= 0.5 * (W + H + w + h))


def map_photos(
    folder: Path,
    ways: Sequence[Attempt],
    shared: Mapping[int, int],
    total: int,
    connected: int,
    threads: int,
    say: Callable[[str], None],
    progress: Callable[[str, int, int], None],
) -> dict[str, Any]:
    """Try ways until one gives most of the photos a pose that counts; keep the best model.

    Args:
        folder: Holds database.db and photos/; models/ is made anew.
        ways: In this order.
        shared: Cameras that are replaced by a camera of the same aspect, by their numbers.
        total: How many photos there are.
        connected: How many of them hang together by matches.
        threads: For COLMAP.
        say: Told what each way gave, if it was not enough.
        progress: Told how many photos have a pose.

    Returns:
        The model: its "folder" below `folder`, the "names" of the photos whose pose counts, "doubtful", those with a
        pose that does not, "unclear", those of them whose focal length is why, "points", "error" in px, and the "way"
        that gave it; the rest is as the job "mapping" returns it.

    Raises:
        DatasetError: no way gives enough photos a pose to be a model, or the last one failed and none gave any.
    """
    models = folder / "models"
    shutil.rmtree(models, ignore_errors=True)
    found = list[dict[str, Any]]()
    for number, way in enumerate(ways, 1):
        out = models / str(number)
        out.mkdir(parents=True)
        try:
            made = _mapped(
                folder, out, way, shared, threads, lambda done: progress("mapping", min(done, total), total)
            )
        except DatasetError as error:
            if number == len(ways) and not found:
                raise
            say(f"{way}: {error}")
            continue
        found += [
            model
            | {"folder": f"models/{number}/{model['folder']}", "way": f"{way}, {model['lens']}"}
            | {"per_photo": way.per_photo}
            for model in made
            if model["names"]
        ]
        counting = max((len(model["names"]) for model in made), default=0)
        if counting >= ENOUGH * connected or _agreed(found, connected):
            break
        say(f"{way}: {counting} of {total} photos have a pose that counts")
    best = best_model(found) if found else {"names": []}
    if len(best["names"]) < min(FEWEST, total):
        raise DatasetError(_without_poses(total, connected))
    return best


def _agreed(found: Sequence[dict[str, Any]], connected: int) -> bool:
    """Say whether two ways gave the same photos a pose that counts, most of the connected ones.

    The others then share too little with them, and no further way is tried.
    """
    sets = [set(model["names"]) for model in found if len(model["names"]) > SAME * connected]
    return any(len(one & other) >= NEARLY * len(one | other) for one, other in combinations(sets, 2))


def best_model(models: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Choose a model.

    The worth of a model is the number of photos whose pose counts, times the share of all their matches that agree with
    their poses, times `PER_PHOTO` if every photo has a camera of its own. Of models of nearly equal worth, those with
    the most points that three photos see are taken, and of these the one with the smallest reprojection error; one with
    a camera per photo last.

    Args:
        models: At least one, as the job "mapping" returns them, and whether they have a camera "per_photo".
    """
    worth = [
        len(model["names"]) * model["agreement"] * (PER_PHOTO if model["per_photo"] else 1.0)
        for model in models
    ]
    good = [model for model, w in zip(models, worth, strict=True) if w >= NEARLY * max(worth)]
    most = max(model["steady"] for model in good)
    return min(
        (model for model in good if model["steady"] >= NEARLY * most),
        key=lambda model: (model["per_photo"], model["error"]),
    )


def _without_poses(total: int, connected: int) -> str:
    """Say why there is no model."""
    if connected < FEWEST:
        return no_overlap(f"of {total} photos, no {FEWEST} match one another")
    return (
        f"{connected} of {total} photos match one another, but no poses follow from their matches; photos from one "
        "spot show no depth: walk around the subject in small steps, and photograph something that is not flat"
    )


def _mapped(
    folder: Path,
    out: Path,
    way: Attempt,
    shared: Mapping[int, int],
    threads: int,
    progress: Callable[[int], None],
) -> list[dict[str, Any]]:
    """Map in one way, and return the models."""
    found = call(
        "mapping",
        folder / "log.txt",
        progress,
        database=str(folder / "database.db"),
        photos=str(folder / "photos"),
        out=str(out),
        attempt=asdict(way),
        shared=dict(shared),
        threads=threads,
        seed=COLMAP_SEED,
    )["models"]
    return [_usable(out, model) for model in found]


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
            lens.undistorted()
            good[number] = True
        except DatasetError:
            good[number] = False
    names = [pose.name for pose in read_images(folder / "images.bin") if good[pose.camera]]
    return model | {"names": sorted(names)}
