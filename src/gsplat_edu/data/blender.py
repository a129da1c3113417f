"""Blender's synthetic scenes: transforms_train.json, transforms_val.json and transforms_test.json.

The frames are as in transforms.json. Source: the scenes of Mildenhall et al. 2020, "NeRF".
"""

from __future__ import annotations

from pathlib import Path

from gsplat_edu.data.capture import Capture, Frame, Problem, is_file, problem_notes
from gsplat_edu.data.masks import with_masks
from gsplat_edu.data.notes import FilesOutside, MissingPhotos, UnusedSplit
from gsplat_edu.data.points import BLENDER_CUBE
from gsplat_edu.data.transforms import each_once, nothing_found, read_frames, read_json

TRAIN_FILE = "transforms_train.json"


def read_blender(folder: Path) -> Capture:
    """Read a Blender scene: its training views, and the test views from test, or from val if there is no test.

    Args:
        folder: The folder with transforms_train.json.

    Raises:
        DatasetError: as for `read_transforms`.
    """
    read, missing, outside, problems = list[Frame](), list[str](), list[Path](), list[Problem]()
    held_out = next((p for part in ("test", "val") if is_file(p := folder / f"transforms_{part}.json")), None)
    for part, path in (("train", folder / TRAIN_FILE), ("test", held_out)):
        if path is None:
            continue
        contents = read_json(path)
        found = read_frames(path, contents, part)
        if part == "train" and not found.frames:
            problem_notes(found.problems, len(found.problems))  # raises the first problem, if there is one
            raise nothing_found(path, found.missing)
        read += found.frames
        problems += found.problems
        missing += found.missing
        outside += found.outside
    val = folder / "transforms_val.json"
    frames, notes = each_once(folder / TRAIN_FILE, read, problems)
    if held_out is not None and held_out != val and is_file(val):
        notes.append(UnusedSplit(val.name, held_out.name))
    notes += [MissingPhotos(len(missing), len(frames) + len(missing), missing[0])] if missing else []
    notes += [FilesOutside(outside[0], len(outside), folder)] if outside else []
    frames, mask_notes = with_masks(folder, frames)
    notes += mask_notes
    return Capture("Blender", tuple(frames), None, tuple(notes), cube=BLENDER_CUBE)
