"""From matches to models: COLMAP's two mappers, and the removal of unreliable poses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Container
from pathlib import Path
from typing import NamedTuple

import pycolmap

from .judge import agreement, take_out, unsupported

Tell = Callable[[int], None]
"""Called with the amount done."""

ROUNDS = 5
"""Most rounds of removing photos; each round may leave other photos without support."""


class Options(NamedTuple):
    """Options common to all mappers, and of the incremental mapper if it starts from given poses.

    Args:
        loose: Use lower thresholds.
        threads: Number of threads.
        seed: Seed of all random draws.
        known: Whether intrinsics and the rig's rotations are exact, as for panoramas.
        fixed: Cameras whose intrinsics stay.
        holds: Whether the poses of the initial model stay.
        unmatched: Whether the initial model may have photos without matches.
    """

    loose: bool
    threads: int
    seed: int
    known: bool = False
    fixed: Collection[int] = ()
    holds: bool = False
    unmatched: bool = False


def incremental(
    tell: Tell, database: str, photos: str, out: str, common: Options, begin: str = ""
) -> dict[int, pycolmap.Reconstruction]:
    """Register one photo after the other (Schönberger and Frahm 2016).

    Args:
        tell: Called with the number of registered photos.
        database: Database with features and matches.
        photos: Folder of the photos, for the colours of the points.
        out: Folder for COLMAP's output.
        common: Thresholds, threads and seed.
        begin: Folder of an initial model.

    Returns:
        The models by number.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = common.threads, common.seed
    options.min_model_size = 3  # accept small models, because the caller uses the best one
    options.multiple_models = not begin
    options.constant_cameras, options.fix_existing_frames = set(common.fixed), common.holds
    options.load_all_images = common.unmatched
    if common.known:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.ba_refine_sensor_from_rig = False
    if common.loose:  # half the matches and a quarter of the angle that COLMAP requires
        options.min_num_matches = 10
        options.mapper.init_min_num_inliers, options.mapper.abs_pose_min_num_inliers = 50, 15
        options.mapper.init_min_tri_angle, options.mapper.abs_pose_min_inlier_ratio = 4.0, 0.15
    placed = 0

    def first_pair() -> None:
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
        initial_image_pair_callback=first_pair,
        next_image_callback=one_more,
    )


def all_at_once(database: str, photos: str, out: str, common: Options) -> dict[int, pycolmap.Reconstruction]:
    """Register all photos together (Pan et al. 2024, GLOMAP); arguments as for `incremental`."""
    options = pycolmap.GlobalPipelineOptions()
    if common.known:
        adjustment = options.mapper.bundle_adjustment
        adjustment.refine_focal_length = adjustment.refine_extra_params = False
        adjustment.refine_sensor_from_rig = options.mapper.refine_sensor_from_rig = False
    else:
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed = common.seed
        pycolmap.calibrate_view_graph(database, calibration)
    options.num_threads = options.mapper.num_threads = common.threads
    options.random_seed = options.mapper.random_seed = common.seed
    options.min_num_matches = 10 if common.loose else options.min_num_matches
    return pycolmap.global_mapping(database, photos, out, options)


def repaired(
    model: pycolmap.Reconstruction, database: str, photos: str, folder: Path, options: Options
) -> pycolmap.Reconstruction:
    """Remove photos with unreliable poses, and let the mapper register them again in the remaining model.

    While focal lengths are still guesses, the incremental mapper may place two photos consistently with each other but
    inconsistently with the rest, and it never re-examines them. The global mapper gives every photo a pose, however few
    points it has.

    Args:
        model: The model; may be modified.
        database: Database with features and matches.
        photos: Folder of the photos.
        folder: Folder for intermediate files.
        options: Thresholds, threads and seed.

    Returns:
        A model in which all poses are reliable: the given one or a new one.
    """
    if not without_doubtful(model, database) or model.num_reg_images() < 2:
        return model
    begin = folder / "begin"
    begin.mkdir()
    model.write_binary(begin)
    found = incremental(lambda done: None, database, photos, str(folder), options, str(begin))
    again = max(found.values(), key=lambda other: other.num_reg_images(), default=model)
    without_doubtful(again, database)
    return again if again.num_reg_images() >= model.num_reg_images() else pycolmap.Reconstruction(begin)


def without_doubtful(model: pycolmap.Reconstruction, database: str, trusted: Container[str] = ()) -> int:
    """Remove the photos with unreliable poses; return their number.

    Args:
        model: The model; modified.
        database: Database with the matches.
        trusted: Names of the photos whose poses need no points, as long as their matches do not contradict them.
    """
    before = model.num_reg_images()
    for _ in range(ROUNDS):
        contradictory = agreement(model, database).contradictory(model)
        doubtful = contradictory | set(unsupported(model, trusted))
        if not doubtful:
            break
        take_out(model, doubtful)
    return before - model.num_reg_images()
