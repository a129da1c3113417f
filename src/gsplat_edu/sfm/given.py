"""The poses that a folder of photos comes with: where the search for the poses of its other photos starts.

Another program, or an earlier search, posed some of the photos. Their lenses and poses become a model of COLMAP, which
`gsplat_edu.sfm.engine.known` adjusts, completes, and moves back to the given coordinates.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_edu.base.constants import AUTO
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.capture import Frame, fits_camera
from gsplat_edu.data.colmap_files import MODELS
from gsplat_edu.data.lens import FISHEYE, PINHOLE_LIKE, Lens
from gsplat_edu.data.lens_formulas import FORMULAS
from gsplat_edu.data.orientation import oriented
from gsplat_edu.data.reader import CaptureReader, layout_of
from gsplat_edu.photos.decoding import MIRRORED, TURNS, upright_size
from gsplat_edu.sfm.photos import PhotoFacts
from gsplat_edu.sfm.result import QUARTER
from gsplat_edu.sfm.scale_text import NONE
from gsplat_edu.survey.proof import Verdict, prove

FEWEST_GIVEN = 2
"""Fewest posed photos to start from: one alone has no points."""

OF_KIND = {
    PINHOLE_LIKE: ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    FISHEYE: ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"),
}
"""COLMAP's models of the lenses that a search can start from, the simplest first."""

DECIMALS = 6
"""Lenses are equal if their parameters agree to this many decimals; scaling to the size of a copy rounds the rest."""

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class GivenPoses:
    """The poses of some photos.

    Args:
        reader: The capture that has them.
        frames: The posed photos by their names, `PhotoFacts.name`.
    """

    reader: CaptureReader
    frames: Mapping[str, Frame]

    @property
    def program(self) -> str:
        """The layout or program that the poses are from."""
        return self.reader.capture.layout

    def digest(self) -> str:
        """Return a digest of everything that a search reads of them."""
        digest = hashlib.sha256(repr((self.program, self.reader.capture.scale)).encode())
        for name, frame in sorted(self.frames.items()):
            numbers = (frame.lens, frame.orientation, frame.R.tolist(), frame.eye.tolist())
            digest.update(f"{name}\0{numbers!r}\0".encode("utf-8", "surrogateescape"))
        return digest.hexdigest()

    def proven(self, say: Say) -> GivenPoses | None:
        """Compare the poses with the photos.

        Args:
            say: Receives what the photos say against the poses.

        Returns:
            The poses, read as the photos show; None if the photos do not agree with them under any reading.
        """
        proof = prove(self.reader)
        if proof.verdict is Verdict.DISAGREE:
            say(f"{proof}; searching without them")
            return None
        if proof.verdict is not Verdict.MISREAD:
            return self
        say(str(proof))
        reader = self.reader.under(proof.reading)
        read = {frame.image: frame for frame in oriented(reader.capture.frames, reader.headers)}
        return replace(self, reader=reader, frames={k: read[f.image] for k, f in self.frames.items()})

    def model(
        self, photos: Sequence[PhotoFacts], groups: Sequence[Mapping[str, Any]], longest: int
    ) -> dict[str, Any]:
        """Return the lenses and poses of the working copies: `gsplat_edu.sfm.engine.known.from_known_poses`.

        Photos of a group without a pose get the lens that most posed photos of the group have; among equally frequent
        ones, that with the median focal length.

        Args:
            photos: All photos.
            groups: The photos by camera; "names" are those of the copies.
            longest: Longest side of the copies, px.
        """
        of_copy = {copy: number for number, group in enumerate(groups) for copy in group["names"]}
        cameras, views, used = list[dict[str, Any]](), list[dict[str, Any]](), dict[int, list[int]]()
        numbers = dict[tuple[Any, ...], int]()
        for photo in photos:
            frame = self.frames.get(photo.name)
            if frame is None or (turns := quarter_turns(frame, photo)) is None:
                continue
            group, size = of_copy[photo.copy], photo.copy_size(longest)
            lens = turned(frame.lens.scaled(*(size[::-1] if turns % 2 else size)), -turns)
            model, params = colmap_camera(lens)
            key = (group, model, *(round(value, DECIMALS) for value in params))
            if key not in numbers:
                numbers[key] = len(cameras)
                cameras.append({"model": model, "W": lens.W, "H": lens.H, "params": params})
            used.setdefault(group, []).append(numbers[key])
            R = np.linalg.matrix_power(QUARTER, -turns % 4) @ frame.R
            views.append({"name": photo.copy, "rotation": R.tolist(), "eye": frame.eye.tolist()})
            views[-1]["camera"] = numbers[key]
        posed = {view["name"]: view["camera"] for view in views}
        usual = {group: _usual(which, cameras) for group, which in used.items()}
        lens_of = {copy: posed.get(copy, usual.get(group)) for copy, group in of_copy.items()}
        lens_of = {copy: camera for copy, camera in lens_of.items() if camera is not None}
        return {"cameras": cameras, "lens_of": lens_of, "views": views}


def _usual(used: Sequence[int], cameras: Sequence[Mapping[str, Any]]) -> int:
    """Return the most frequent camera; among equally frequent ones, that with the median focal length."""
    counts = Counter(used)
    most = max(counts.values())
    usual = sorted((cameras[one]["params"][0], one) for one, count in counts.items() if count == most)
    return usual[len(usual) // 2][1]


def find_given(source: Path, poses: str | Path, files: Sequence[Path], say: Say) -> GivenPoses | None:
    """Find the poses that a folder of photos comes with.

    Args:
        source: The folder that the user gave.
        poses: "auto": those that `gsplat_edu.data.reader.read_capture` finds; "none"; or the file with the poses.
        files: Its photos.
        say: Receives which poses are used, or why some are not.

    Returns:
        None if there are no poses, or no usable ones.

    Raises:
        DatasetError: the file that the user gave is damaged, or poses none of the photos.
    """
    if poses == NONE or (poses == AUTO and layout_of(source) is None):
        return None
    reader = CaptureReader(source if poses == AUTO else poses)
    try:
        frames = oriented(reader.capture.frames, reader.headers)
    except DatasetError as error:
        if poses != AUTO:
            raise
        say(f"not starting from the poses that are there: {error}")
        return None
    names = {path.resolve(): path.relative_to(files[0].parent).as_posix() for path in files}
    found = {
        names[place]: frame
        for frame in frames
        if (place := frame.image.resolve()) in names and _startable(frame, reader)
    }
    counted = f"the poses of {reader.capture.layout}: {len(found)} of {len(files)} photos"
    if len(found) >= FEWEST_GIVEN:
        say(f"starting from {counted} (--poses {NONE} ignores them)")
        return GivenPoses(reader, found)
    if poses != AUTO:
        raise DatasetError(
            f"{poses}: poses {len(found)} of the {len(files)} photos in a way that a search can start from; give "
            f"another file, or --poses {NONE}"
        )
    say(f"not starting from {counted} have a usable one")
    return None


def leave_unused(source: Path, poses: str | Path, say: Say) -> None:
    """Say that the poses of panoramas are not used, if there are any.

    Args:
        source: As for `find_given`.
        poses: As for `find_given`.
        say: Receives the sentence.

    Raises:
        DatasetError: the user chose a file of poses.
    """
    if poses not in (AUTO, NONE):
        raise DatasetError(f"{poses}: a search for the poses of panoramas starts from none; omit --poses")
    if poses == AUTO and (layout := layout_of(source)) is not None:
        say(f"not starting from the poses of {layout}: a search for the poses of panoramas starts from none")


def _startable(frame: Frame, reader: CaptureReader) -> bool:
    """Return whether COLMAP has a frame's lens, and the photo fits it."""
    try:
        size = upright_size(reader.headers.size(frame.image), frame.orientation)
    except DatasetError:
        return False
    return frame.lens.model in OF_KIND and fits_camera(frame.lens, size)


def quarter_turns(frame: Frame, photo: PhotoFacts) -> int | None:
    """Return the quarter turns clockwise from a photo's working copy to the picture that its pose is of.

    Args:
        frame: The pose, of the decoded pixels turned by `Frame.orientation`.
        photo: The photo, whose copy has the decoded pixels turned by `PhotoFacts.sensor`.

    Returns:
        0 to 3; None if one of them is mirrored.
    """
    if (frame.orientation in MIRRORED) != (photo.sensor in MIRRORED):
        return None
    return (TURNS[frame.orientation] - TURNS[photo.sensor]) % 4


def turned(lens: Lens, turns: int) -> Lens:
    """Return the lens of a photo turned clockwise.

    (x, y) becomes (-y, x), so the tangential coefficients (p1, p2) become (p2, -p1); radial ones stay.

    Args:
        lens: A lens of `OF_KIND`.
        turns: Quarter turns.
    """
    names = FORMULAS[lens.model].names
    bends = dict(zip(names, (*lens.coefficients, *[0.0] * len(names)), strict=False))
    for _ in range(turns % 4 if "p1" in bends else 0):
        bends["p1"], bends["p2"] = bends["p2"], -bends["p1"]
    plain = lens.turned(turns)
    sizes = (plain.W, plain.H, plain.fx, plain.fy, plain.cx, plain.cy)
    return Lens(*sizes, tuple(bends.values()), lens.model)


def colmap_camera(lens: Lens) -> tuple[str, list[float]]:
    """Return the simplest of COLMAP's models that has a lens, and its parameters, px.

    Args:
        lens: A lens of `OF_KIND`.
    """
    bends = dict(zip(FORMULAS[lens.model].names, lens.coefficients, strict=False))
    # formats put the first pixel's centre at (0.5, 0.5)
    values = {"fx": lens.fx, "fy": lens.fy, "f": lens.fx, "cx": lens.cx + 0.5, "cy": lens.cy + 0.5, **bends}
    one_focal = abs(lens.fx - lens.fy) <= 10.0**-DECIMALS * lens.fx
    parameters = dict(MODELS)
    for model in OF_KIND[lens.model]:
        names = parameters[model].split()
        if all(name in names for name, value in bends.items() if value) and (one_focal or "f" not in names):
            break
    return model, [float(values.get(name, 0.0)) for name in names]
