"""The program that calls COLMAP: one job of structure from motion, in a process of its own.

    python engine.py < job.json

It imports nothing of this package. It is a process of its own for three reasons: COLMAP's code cannot be interrupted,
but a process can be ended; if it crashes, it takes nothing along; and its libraries do not meet those of Pillow, which
in one process crash each other when pycolmap is loaded first. `gsplat_edu.sfm.colmap` starts it. What the job prints
as JSON lines on stdout is for that module; COLMAP's own words go to stderr.
"""

from __future__ import annotations

import copy
import json
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

Tell = Callable[[int], None]
"""Told how much is done."""

BLOCK = 64
"""Pairs that are matched between two writes to the database: what is lost when the program is ended."""

FOCAL = 0.85
"""Focal length where EXIF says none, as a share of the longer side. The main cameras of phones have 0.69 to 0.81 (24 to
28 mm, photos and videos), normal lenses 1.4; COLMAP's own 1.2 lets phones' photos begin with a bad geometry."""

AGREED = 4.0
"""Distance from the epipolar line up to which a match agrees with two poses, px: the bound when they were found."""

CONTRADICTED = 0.3
"""Share of a photo's matches that have to agree with its pose."""

WITNESSES = 20
"""Photos of a camera from which they fix its principal point."""

CENTRED = 0.1
"""Farthest that a principal point may be from the middle, as a share of the size."""


def features(
    tell: Tell,
    database: str,
    photos: str,
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
    with _opened(database) as opened, pycolmap.DatabaseTransaction(opened):
        numbers = {name: i for i, name in enumerate(names, 1)}
        for number, group in enumerate([] if opened.num_images() else groups, 1):
            focal = group["focal"] or FOCAL * max(group["width"], group["height"])
            camera = pycolmap.Camera.create_from_model_name(
                number, "SIMPLE_RADIAL", focal, group["width"], group["height"]
            )
            camera.has_prior_focal_length = group["focal"] is not None
            _add_camera(opened, camera)
            for name in group["names"]:
                _add_photo(opened, name, numbers[name], number)
    pycolmap.extract_features(
        database, photos, image_names=names, extraction_options=options, device=pycolmap.Device.cpu
    )
    with _opened(database) as opened:
        found = {
            image.name: opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()
        }
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
    with _opened(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        ids, counts = opened.read_two_view_geometry_num_inliers()
    verified = []
    for pair, count in zip(ids, counts, strict=True):
        if count:
            first, second = pycolmap.pair_id_to_image_pair(pair)
            verified.append([names[first], names[second], count])
    return {"verified": verified}


def mapping(
    tell: Tell, database: str, photos: str, out: str, attempt: dict[str, Any], threads: int, seed: int
) -> dict[str, Any]:
    """Find poses and points, in one way.

    Args:
        tell: Told how many photos have a pose.
        database: The database with features and matches; not changed.
        photos: Folder of the photos, for the colours of the points.
        out: Folder for the models; it is empty.
        attempt: "mapper", "incremental" or "global"; "model", the cameras' model; "per_photo", whether
            every photo has a camera of its own; "loose", whether thresholds are low.
        threads: Threads, -1 for all.
        seed: Of all random draws.

    Returns:
        "models", of each: its "folder" in `out`, "names" of the photos with a pose, "points", and "error", the mean
        reprojection error in px of the photos that were given.
    """
    pycolmap.set_random_seed(seed)
    database = _with_cameras(database, f"{out}/database.db", attempt["model"], attempt["per_photo"])
    run = _global if attempt["mapper"] == "global" else _incremental
    options = _Options(bool(attempt["loose"]), threads, seed)
    found = run(tell, database, photos, out, options)
    models = []
    for number, begun in sorted(found.items()):
        folder = Path(out) / str(number)
        folder.mkdir(exist_ok=True)
        model = _refined(_mended(begun, database, photos, folder, options), threads)
        model.write_binary(folder)
        names = sorted(model.image(image).name for image in model.reg_image_ids())
        error = float(model.compute_mean_reprojection_error()) if model.num_points3D() else 0.0
        models.append({"folder": folder.name, "names": names, "points": model.num_points3D(), "error": error})
    return {"models": models}


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


class _Options(NamedTuple):
    """What mappers have in common."""

    loose: bool
    threads: int
    seed: int


def _incremental(
    tell: Tell, database: str, photos: str, out: str, common: _Options, begin: str = ""
) -> dict[int, pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = common.threads, common.seed
    options.min_model_size = 3  # photos are few here, and the largest model is taken anyway
    if common.loose:  # half the matches, and a quarter of the angle, that COLMAP asks for
        options.min_num_matches = 10
        options.mapper.init_min_num_inliers, options.mapper.abs_pose_min_num_inliers = 50, 15
        options.mapper.init_min_tri_angle, options.mapper.abs_pose_min_inlier_ratio = 4.0, 0.15
    placed = 0

    def begun() -> None:
        nonlocal placed
        placed = 2
        tell(placed)

    def one_more() -> None:
        nonlocal placed
        placed += 1
        tell(placed)

    return pycolmap.incremental_mapping(
        database,
        photos,
        out,
        options,
        begin,
        initial_image_pair_callback=begun,
        next_image_callback=one_more,
    )


def _global(
    tell: Tell, database: str, photos: str, out: str, common: _Options
) -> dict[int, pycolmap.Reconstruction]:
    calibration = pycolmap.ViewGraphCalibrationOptions()
    calibration.random_seed = common.seed
    pycolmap.calibrate_view_graph(database, calibration)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = common.threads
    options.random_seed = options.mapper.random_seed = common.seed
    options.min_num_matches = 10 if common.loose else options.min_num_matches
    return pycolmap.global_mapping(database, photos, out, options)


def _mended(
    model: pycolmap.Reconstruction, database: str, photos: str, folder: Path, options: _Options
) -> pycolmap.Reconstruction:
    """Take out photos whose poses contradict their matches, and let the mapper place them in what is left.

    While focal lengths are still guesses, the incremental mapper may place two photos well beside each other but
    wrongly beside the rest, and never looks at them again.
    """
    wrong = _contradictory(model, database)
    if not wrong or len(wrong) + 2 > model.num_reg_images():
        return model
    _take_out(model, wrong)
    begin = folder / "begin"
    begin.mkdir()
    model.write_binary(begin)
    found = _incremental(lambda done: None, database, photos, str(folder), options, str(begin))
    mended = max(found.values(), key=lambda other: other.num_reg_images(), default=model)
    _take_out(mended, _contradictory(mended, database))
    return mended


def _take_out(model: pycolmap.Reconstruction, images: list[int]) -> None:
    for image in images:
        model.deregister_frame(model.image(image).frame_id)


def _contradictory(model: pycolmap.Reconstruction, database: str) -> list[int]:
    """Find photos most of whose matches do not fit their poses, by the Sampson distance."""
    agree, total = dict[int, int](), dict[int, int]()
    registered = set(model.reg_image_ids())
    rays = dict[int, np.ndarray]()
    with _opened(database) as opened:
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            if not len(geometry.inlier_matches) or not {first, second} <= registered:
                continue
            for image in (first, second):
                if image not in rays:
                    keypoints = opened.read_keypoints(image)[:, :2].astype(np.float64)
                    camera = model.camera(model.image(image).camera_id)
                    plane: np.ndarray = camera.cam_from_img(keypoints)  # type: ignore[assignment]
                    rays[image] = np.column_stack([plane, np.ones(len(plane))])
            a, b = (rays[i][geometry.inlier_matches[:, k]] for k, i in enumerate((first, second)))
            relative = model.image(second).cam_from_world() * model.image(first).cam_from_world().inverse()
            E = pycolmap.essential_matrix_from_pose(relative)
            Ea, Eb = a @ E.T, b @ E
            slopes = (Ea[:, :2] ** 2).sum(axis=1) + (Eb[:, :2] ** 2).sum(axis=1)
            distance = np.abs((b * Ea).sum(axis=1)) / np.sqrt(np.maximum(slopes, 1e-30))
            focal = model.camera(model.image(first).camera_id).mean_focal_length()
            good = int((distance * focal < AGREED).sum())
            for image in (first, second):
                agree[image] = agree.get(image, 0) + good
                total[image] = total.get(image, 0) + len(a)
    return sorted(image for image in total if agree[image] < CONTRADICTED * total[image])


def _refined(model: pycolmap.Reconstruction, threads: int) -> pycolmap.Reconstruction:
    """Adjust everything once more, principal points too, where enough photos of each camera fix them."""
    photos = Counter(model.image(image).camera_id for image in model.reg_image_ids())
    if not photos or min(photos.values()) < WITNESSES or not model.num_points3D():
        return model
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.ceres.use_gpu, options.ceres.solver_options.num_threads = False, threads
    refined = copy.deepcopy(model)
    pycolmap.bundle_adjustment(refined, options)
    for camera in (refined.camera(number) for number in photos):
        x, y = camera.principal_point_x / camera.width, camera.principal_point_y / camera.height
        if max(abs(x - 0.5), abs(y - 0.5)) > CENTRED:
            return model
    refined.update_point_3d_errors()
    return refined


def _with_cameras(source: str, target: str, model: str, per_photo: bool) -> str:
    """Copy a database, without descriptors, and give its photos other cameras.

    Returns:
        The copy's path.
    """
    with _opened(source) as old, _opened(target) as new, pycolmap.DatabaseTransaction(new):
        made = set[int]()
        for image in old.read_all_images():
            before = old.read_camera(image.camera_id)
            number = image.image_id if per_photo else image.camera_id
            if number not in made:
                made.add(number)
                camera = pycolmap.Camera.create_from_model_name(
                    number,
                    model,
                    before.mean_focal_length(),
                    before.width,
                    before.height,
                )
                camera.has_prior_focal_length = before.has_prior_focal_length
                _add_camera(new, camera)
            _add_photo(new, image.name, image.image_id, number)
            new.write_keypoints(image.image_id, old.read_keypoints(image.image_id))
        for pair, geometry in zip(*old.read_two_view_geometries(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            new.write_two_view_geometry(first, second, geometry)
            new.write_matches(first, second, old.read_matches(first, second))
    return target


def _add_camera(database: pycolmap.Database, camera: pycolmap.Camera) -> None:
    """Write a camera, and the rig of the same number that is this camera alone."""
    database.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=camera.camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    database.write_rig(rig, use_rig_id=True)


def _add_photo(database: pycolmap.Database, name: str, number: int, camera: int) -> None:
    """Write an image, and the frame of the same number that is this image alone."""
    image = pycolmap.Image(name=name, camera_id=camera, image_id=number)
    database.write_image(image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=number, rig_id=camera)
    frame.add_data_id(image.data_id)
    database.write_frame(frame, use_frame_id=True)


@contextmanager
def _opened(path: str) -> Iterator[pycolmap.Database]:
    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        database.close()


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
