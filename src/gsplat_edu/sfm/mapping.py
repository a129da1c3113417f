"""From matches to poses: make attempts until most photos have a pose."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.colmap import read_cameras, read_images
from gsplat_edu.sfm.colmap import COLMAP_SEED, call
from gsplat_edu.sfm.diagnosis import diagnosis, evidence
from gsplat_edu.sfm.source import FEWEST

ENOUGH = 0.8
"""Stop once this fraction of the connected photos has a pose that counts."""

MANY_PHOTOS = 400
"""Number of photos above which the global mapper is tried first: the time of the incremental one grows with the square
of their number."""

ENOUGH_FOR_FREE = 20
"""Try a freer lens during mapping if there are at least this number of photos per camera. Cross-validation of the lens
needs as many (`gsplat_edu.sfm.engine.lenses.WITNESSES`)."""

MAIN = 0.5
"""If at least this fraction of the photos has one size, photos of other sizes follow their lens
(`gsplat_edu.sfm.engine.kin`)."""

OWN = 10
"""Photos of one size get their own camera if they are at least this number, as in `gsplat_edu.sfm.engine.kin`."""

SAME = 0.5
"""Accept two agreeing attempts if they place more than this fraction of the connected photos."""

NEARLY = 0.97
"""Compare models by their points if their scores are at least this fraction of the best score."""

PER_PHOTO = 6 / 8
"""Weight of a photo with its own camera: its points determine eight numbers (the pose, a focal length and a distortion
coefficient) instead of six."""


RIG = "PINHOLE"
"""Camera model of the faces of panoramas."""


@dataclass(frozen=True)
class Attempt:
    """The settings of one attempt at mapping.

    Args:
        mapper: "incremental" (Schönberger and Frahm 2016), "global" (Pan et al. 2024, GLOMAP), or "given": refine the
            poses of some photos and register the others.
        model: COLMAP's camera model.
        free: Map with a freer lens, then drop it; held-out photos decide what is refined.
        per_photo: Give every photo its own camera.
        loose: Use lower thresholds.
    """

    mapper: str
    model: str
    free: bool = False
    per_photo: bool = False
    loose: bool = False

    def __str__(self) -> str:
        """Describe the attempt."""
        if self.mapper == "given":
            return "given poses"
        words = [f"{self.mapper} mapper"] + [self.model] * (self.model not in ("auto", RIG))
        words += ["a freer lens at first"] * self.free
        words += ["a camera per photo"] * self.per_photo + ["lower thresholds"] * self.loose
        return ", ".join(words)


FROM_GIVEN = Attempt("given", "auto")
"""The attempt that starts from given poses; it is made first."""


@dataclass(frozen=True)
class Cameras:
    """The cameras that photos are mapped with.

    Args:
        shared: For each replaced camera, the number of its replacement: `shared_cameras`.
        rig: For faces of panoramas, the rig's "rotations" and the names of the faces of all "panoramas", as for
            `gsplat_edu.sfm.engine.database.with_rig`.
        given: Poses of some photos: `gsplat_edu.sfm.given.GivenPoses.model`.
    """

    shared: dict[int, int]
    rig: dict[str, Any] | None = None
    given: dict[str, Any] | None = None


def attempts(mapper: str, model: str, photos: int, cameras: int, one_lens: bool) -> list[Attempt]:
    """List the attempts in the order in which they are made.

    Args:
        mapper: The mapper chosen by the user, or "auto".
        model: The camera model chosen by the user, or "auto".
        photos: Number of photos.
        cameras: Number of cameras they are mapped with.
        one_lens: Whether one camera took them all, as for the frames of a video.
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


def rig_attempts(mapper: str) -> list[Attempt]:
    """List the attempts for panoramas, whose faces are pinholes with known intrinsics.

    Args:
        mapper: The mapper chosen by the user, or "auto".
    """
    order = ["incremental", "global"] if mapper == "auto" else [mapper]
    return [*(Attempt(name, RIG) for name in order), Attempt(order[0], RIG, loose=True)]


def shared_cameras(groups: Sequence[Mapping[str, Any]]) -> dict[int, int]:
    """Find cameras that are mapped as one, because their photos are probably scaled versions from one camera.

    One or two photos determine a focal length poorly. If most cameras have so few, no main camera exists to compare
    with. Photos of the same kind (by EXIF) and the same aspect ratio then share a camera. Photos of one camera that
    were cropped to different aspect ratios still get one camera each.

    Args:
        groups: Groups of photos of one size: "names", "width" and "height", px, their "kind" by EXIF, and "lens", not
            None for a fisheye, which has a camera of its own.

    Returns:
        For each replaced camera, the number of its replacement; numbers count from 1 in the order of the groups. Empty
        if most photos have one size.
    """
    total = sum(len(group["names"]) for group in groups)
    if max((len(group["names"]) for group in groups), default=0) >= MAIN * total:
        return {}
    few = [
        number
        for number, group in enumerate(groups, 1)
        if len(group["names"]) < OWN and group.get("lens") is None
    ]
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
    """Return whether photos may be scaled versions from one camera, up to rounding by half a pixel per side."""
    W, H, w, h = one["width"], one["height"], other["width"], other["height"]
    return bool(one["kind"] == other["kind"] and abs(W * h - H * w) <= 0.5 * (W + H + w + h))


def map_photos(
    folder: Path,
    ways: Sequence[Attempt],
    cameras: Cameras,
    total: int,
    connected: int,
    threads: int,
    say: Callable[[str], None],
    progress: Callable[[str, int, int], None],
) -> dict[str, Any]:
    """Make attempts until one gives most of the photos a pose that counts; keep the best model.

    Args:
        folder: Folder with database.db and photos/; models/ is recreated.
        ways: The attempts, in order.
        cameras: Their cameras.
        total: Number of photos.
        connected: Number of photos connected by matches.
        threads: Number of threads for COLMAP.
        say: Receives the result of each attempt that was not enough.
        progress: Called with the number of photos that have a pose.

    Returns:
        The model: its "folder" below `folder`; the "names" of the photos whose pose counts; "doubtful", the photos
        whose pose does not; "unclear", those of them with an ambiguous focal length; "points"; "error" in px; the
        "way" that made it; and the other entries of the job "mapping".

    Raises:
        DatasetError: no attempt places enough photos for a model, or the last one failed and none placed any.
    """
    models = folder / "models"
    shutil.rmtree(models, ignore_errors=True)
    found = list[dict[str, Any]]()
    for number, way in enumerate(ways, 1):
        out = models / str(number)
        out.mkdir(parents=True)
        try:
            made = _mapped(
                folder, out, way, cameras, threads, lambda done: progress("mapping", min(done, total), total)
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
    best = _preferred(found) if found else {"names": []}
    if len(best["names"]) < min(FEWEST, total):
        raise DatasetError(_without_poses(folder, total, connected))
    return best


def _preferred(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Choose the model from given poses, the only one in their coordinates, unless another has many more photos."""
    best = best_model(found)
    given = [
        model for model in found if "held" in model and len(model["names"]) >= ENOUGH * len(best["names"])
    ]
    return given[0] if given else best


def _agreed(found: Sequence[dict[str, Any]], connected: int) -> bool:
    """Return whether two attempts placed the same photos, and most of the connected ones.

    The remaining photos then overlap too little with them, and no further attempt is made.
    """
    sets = [set(model["names"]) for model in found if len(model["names"]) > SAME * connected]
    return any(len(one & other) >= NEARLY * len(one | other) for one, other in combinations(sets, 2))


def best_model(models: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Choose a model.

    The score of a model is the number of photos whose pose counts, times the fraction of all their matches that agree
    with their poses, times `PER_PHOTO` if every photo has its own camera. Among models with nearly equal scores, keep
    those with the most points seen by three photos; among these, take the one with the smallest reprojection error.
    Models with one camera per photo come last.

    Args:
        models: At least one result of the job "mapping", with a flag "per_photo".
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


def _without_poses(folder: Path, total: int, connected: int) -> str:
    """Return a message that explains why there is no model."""
    copies = [path for path in sorted((folder / "photos").rglob("*")) if path.is_file()]
    what = f"none of {total} photos has a pose that counts; {connected} of them are connected by matches"
    return f"{what}; {diagnosis(evidence(folder, copies, connected))}"


def _mapped(
    folder: Path,
    out: Path,
    way: Attempt,
    cameras: Cameras,
    threads: int,
    progress: Callable[[int], None],
) -> list[dict[str, Any]]:
    """Make one attempt, and return its models."""
    found = call(
        "mapping",
        folder / "log.txt",
        progress,
        database=str(folder / "database.db"),
        photos=str(folder / "photos"),
        out=str(out),
        attempt=asdict(way),
        cameras=asdict(cameras),
        threads=threads,
        seed=COLMAP_SEED,
    )["models"]
    return [without_implausible_lenses(out, model) for model in found]


def without_implausible_lenses(out: Path, model: dict[str, Any]) -> dict[str, Any]:
    """Leave out photos whose estimated lens is too implausible to undistort them."""
    folder, good = out / model["folder"], dict[int, bool]()
    for number, lens in read_cameras(folder / "cameras.bin").items():
        try:
            lens.undistorted()
            good[number] = True
        except DatasetError:
            good[number] = False
    names = [pose.name for pose in read_images(folder / "images.bin") if good[pose.camera]]
    return model | {"names": sorted(names)}
