"""The jobs: features, matches, mapping, and the model that goes into the capture."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from .database import add_camera, add_photo, opened, with_cameras
from .judge import agreement, scattered, steady_points
from .kin import placed_anew
from .lenses import Kin, refined, simplified
from .mappers import Options, Tell, all_at_once, incremental, mended, without_doubtful

BLOCK = 64
"""Pairs that are matched between two writes to the database: what is lost when the program is ended."""

FOCAL = 0.85
"""Focal length where EXIF says none, as a share of the longer side. The main cameras of phones have 0.69 to 0.81 (24 to
28 mm, photos and videos), normal lenses 1.4; COLMAP's own 1.2 lets phones' photos begin with a bad geometry."""

FIRST_LENS = "SIMPLE_RADIAL"
"""Lens model that mapping begins with where the user names none; see `lenses`."""

FREE_LENS = "OPENCV"
"""Lens model that photos are placed with where `FIRST_LENS` places too few, as it does for strong wide angles. The lens
it finds is then dropped, and held-out photos judge how much of one is refined, as in the other ways."""


def features(
    tell: Tell,
    database: str,
    photos: str,
    masks: str,
    groups: list[dict[str, Any]],
    max_features: int,
    threads: int,
    seed: int,
) -> dict[str, Any]:
    """Find SIFT features in photos; those that have theirs in the database already are passed over.

    Args:
        tell: Not told: whoever waits counts rows of the database. Two SQLite libraries in one process, COLMAP's and
            Python's, would break each other's locks, so it cannot be this process.
        database: The database; made where it is missing.
        photos: Folder of the photos.
        masks: Folder of their masks, NAME.png; features are looked for where they are not zero. Empty for none.
        groups: Photos that share a camera: "names", "width" and "height", and the "focal" length where it is known, px.
        max_features: Most features of a photo.
        threads: Threads, -1 for all.
        seed: Of COLMAP's generator.

    Returns:
        "features": how many there are, by the names of the photos.
    """
    pycolmap.set_random_seed(seed)
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.use_gpu = threads, False
    options.sift.max_num_features = max_features
    names = sorted(name for group in groups for name in group["names"])
    # COLMAP would number photos in the order in which its threads are done with them.
    with opened(database) as db, pycolmap.DatabaseTransaction(db):
        numbers = {name: i for i, name in enumerate(names, 1)}
        for number, group in enumerate([] if db.num_images() else groups, 1):
            focal = group["focal"] or FOCAL * max(group["width"], group["height"])
            camera = pycolmap.Camera.create_from_model_name(
                number, FIRST_LENS, focal, group["width"], group["height"]
            )
            camera.has_prior_focal_length = group["focal"] is not None
            add_camera(db, camera)
            for name in group["names"]:
                add_photo(db, name, numbers[name], number)
    reading = pycolmap.ImageReaderOptions()
    reading.mask_path = masks
    pycolmap.extract_features(
        database,
        photos,
        image_names=names,
        reader_options=reading,
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )
    with opened(database) as db:
        found = {image.name: db.num_keypoints_for_image(image.image_id) for image in db.read_all_images()}
    return {"features": found}


def matches(tell: Tell, database: str, pairs: str, threads: int, seed: int) -> dict[str, Any]:
    """Match features and keep the matches that one geometry explains; pairs that were matched are passed over.

    Args:
        tell: Not told, as for `features`.
        database: The database.
        pairs: File with two names of photos a line.
        threads: Threads, -1 for all.
        seed: Of the random samples.

    Returns:
        "verified": [name, name, number of matches] of the pairs that have some.
    """
    pycolmap.set_random_seed(seed)
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = threads, False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path, pairing.block_size = pairs, BLOCK
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pycolmap.match_image_pairs(
        database,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )
    with opened(database) as db:
        names = {image.image_id: image.name for image in db.read_all_images()}
        ids, counts = db.read_two_view_geometry_num_inliers()
    verified = []
    for pair, count in zip(ids, counts, strict=True):
        if count:
            first, second = pycolmap.pair_id_to_image_pair(pair)
            verified.append([names[first], names[second], count])
    return {"verified": verified}


def mapping(
    tell: Tell,
    database: str,
    photos: str,
    out: str,
    attempt: dict[str, Any],
    shared: dict[str, int],
    threads: int,
    seed: int,
) -> dict[str, Any]:
    """Find poses and points, in one way.

    Args:
        tell: Told how many photos have a pose.
        database: The database with features and matches; not changed.
        photos: Folder of the photos, for the colours of the points.
        out: Folder for the models; it is empty.
        attempt: "mapper", "incremental" or "global"; "model", the cameras' model, or "auto" to find out how much of it
            the photos tell; "free", whether photos are placed with `FREE_LENS` before that is found out; "per_photo",
            whether every photo has a camera of its own; "loose", whether thresholds are low.
        shared: Cameras that are replaced by a camera of the same aspect, by their numbers.
        threads: Threads, -1 for all.
        seed: Of all random draws.

    Returns:
        "models", of each: its "folder" in `out`, "names" of the photos whose pose counts, "doubtful" those of the
        photos whose pose does not, "unclear" those of them whose focal length is why, "points", "steady", those that
        three photos see, "agreement", the share of all matches that fit the poses, "lens", what was refined of the
        camera with the most photos, and "error", the mean reprojection error in px of the photos that were given.
    """
    pycolmap.set_random_seed(seed)
    lens = FREE_LENS if attempt["free"] else FIRST_LENS if attempt["model"] == "auto" else attempt["model"]
    by_number = {int(camera): leader for camera, leader in shared.items()}
    mapped = with_cameras(database, f"{out}/database.db", lens, attempt["per_photo"], by_number)
    options = Options(bool(attempt["loose"]), threads, seed)
    if attempt["mapper"] == "global":
        found = all_at_once(mapped, photos, out, options)
    else:
        found = incremental(tell, mapped, photos, out, options)
    models = []
    for number, begun in sorted(found.items()):
        folder = Path(out) / str(number)
        folder.mkdir(exist_ok=True)
        facts = _judged(begun, mapped, photos, folder, attempt, options)
        models += [] if facts is None else [facts]
    return {"models": models}


def _judged(
    begun: pycolmap.Reconstruction,
    database: str,
    photos: str,
    folder: Path,
    attempt: dict[str, Any],
    options: Options,
) -> dict[str, Any] | None:
    """Keep what counts of a mapper's model, refine it, and write it to a folder; None where nothing is left."""
    auto, per_photo = attempt["model"] == "auto", attempt["per_photo"]
    placed, kin, unclear = _names(begun), dict[int, Kin](), list[str]()
    model = mended(begun, database, photos, folder, options)
    if model.num_reg_images() < 2 or not model.num_points3D():
        return None
    if attempt["free"]:
        simplified(model, FIRST_LENS, options.threads)
    if not per_photo:
        anew, kin, out = placed_anew(model, database, photos, folder, options)
        unclear, model = sorted(model.image(image).name for image in out), anew
    model, lenses = refined(model, auto and not per_photo, options.threads, kin)
    without_doubtful(model, database)
    if not model.num_reg_images() or (per_photo and scattered(model)):
        return None
    model.write_binary(folder)
    return {
        "folder": folder.name,
        "names": _names(model),
        "doubtful": sorted(set(placed) - set(_names(model))),
        "unclear": unclear,
        "points": model.num_points3D(),
        "steady": steady_points(model),
        "agreement": agreement(model, database).share,
        "lens": lenses[_main_camera(model)],
        "error": float(model.compute_mean_reprojection_error()) if model.num_points3D() else 0.0,
    }


def _names(model: pycolmap.Reconstruction) -> list[str]:
    return sorted(model.image(image).name for image in model.reg_image_ids())


def _main_camera(model: pycolmap.Reconstruction) -> int:
    """Return the camera of most photos."""
    photos = Counter(model.image(image).camera_id for image in model.reg_image_ids())
    return max(sorted(photos), key=lambda camera: photos[camera])


def finish(
    tell: Tell,
    model: str,
    out: str,
    rotation: list[list[float]],
    move: list[float],
    scale: float,
    photos: dict[str, dict[str, Any]],
) -> dict[str, Any]:
    """Write a model again, in another frame, with the pinhole cameras of the undistorted photos.

    Args:
        tell: Told how many photos are done.
        model: Folder of the model.
        out: Folder to write to; made.
        rotation: R of x' = scale R x + move.
        move: Its shift, world units.
        scale: Its factor.
        photos: By the names in the model, those that are kept: "name" to write, size "W" and "H", intrinsics
            "fx", "fy", "cx", "cy" with the first pixel's centre at (0.5, 0.5), and "turns", by how many quarters
            the photo was turned clockwise.

    Returns:
        "points", how many there are, and "error", their mean reprojection error in px of the new photos.
    """
    before = pycolmap.Reconstruction(model)
    before.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(np.array(rotation)), np.array(move)))
    after, cameras = pycolmap.Reconstruction(), dict[tuple[float, ...], int]()
    kept: dict[int, dict[int, tuple[int, int]]] = {}  # of each point, its observations
    by_name = sorted(
        (photos[before.image(i).name]["name"], i)
        for i in before.reg_image_ids()
        if before.image(i).name in photos
    )
    for number, (name, image) in enumerate(by_name, 1):
        old, new = before.image(image), photos[before.image(image).name]
        key = (new["W"], new["H"], new["fx"], new["fy"], new["cx"], new["cy"])
        if key not in cameras:
            cameras[key] = len(cameras) + 1
            after.add_camera_with_trivial_rig(_pinhole(key, cameras[key]))
        turn = np.linalg.matrix_power(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), new["turns"] % 4)
        seen = [p for p in old.points2D if p.has_point3D()]
        where = before.camera(old.camera_id).cam_from_img(np.array([p.xy for p in seen]).reshape(-1, 2))
        where = where @ turn[:2, :2].T * key[2:4] + key[4:6]
        for index, observed in enumerate(seen):
            kept.setdefault(observed.point3D_id, {})[number] = (number, index)
        pose = pycolmap.Rigid3d(turn @ old.cam_from_world().matrix())
        written = pycolmap.Image(name=name, keypoints=where, camera_id=cameras[key], image_id=number)
        after.add_image_with_trivial_frame(written, pose)
        tell(number)
    for point, observations in sorted(kept.items()):
        if len(observations) >= 2:
            track = pycolmap.Track([pycolmap.TrackElement(*pair) for pair in observations.values()])
            after.add_point3D(before.point3D(point).xyz, track, before.point3D(point).color)
    after.update_point_3d_errors()
    Path(out).mkdir(parents=True, exist_ok=True)
    after.write_binary(out)
    return {"points": after.num_points3D(), "error": float(after.compute_mean_reprojection_error())}


def _pinhole(key: tuple[float, ...], number: int) -> pycolmap.Camera:
    W, H, *intrinsics = key
    return pycolmap.Camera(model="PINHOLE", width=W, height=H, params=intrinsics, camera_id=number)


JOBS: dict[str, Callable[..., dict[str, Any]]] = {
    "features": features,
    "matches": matches,
    "mapping": mapping,
    "finish": finish,
}


def main() -> int:
    """Do the job that stdin describes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches this process too, but its parent decides
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever else is printed goes to the log

    def answer(value: dict[str, Any]) -> None:
        try:
            print(json.dumps(value), file=answers, flush=True)
        except OSError:  # nobody waits for the result any more
            os._exit(1)

    parent = os.getppid()

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)  # a later run must not meet this one in the database

    threading.Thread(target=end_with_parent, daemon=True).start()
    order = json.load(sys.stdin)
    job = JOBS[order.pop("job")]
    answer({"result": job(lambda done: answer({"done": done}), **order)})
    return 0


if __name__ == "__main__":
    sys.exit(main())
