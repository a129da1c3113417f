"""The folder of a run: which file lies where, and what is in it.

    config.json                                   everything that decides the run
    log.jsonl                                     one JSON object a line, each with `iteration`
    metrics.json                                  the judgement: {"test": {...}, "train": {...}, "num_gaussians": ...}
    cameras.json                                  the cameras, as Inria's viewers read them
    point_cloud/iteration_N/point_cloud.ply       the scene after N iterations
    photos.json                                   size and digest of every photo's file when the run began
    checkpoints/                                  what a run is continued from
    renders/                                      pictures
    report.html                                   the run on one page
    .lock                                         the process that is writing here (`gsplat_edu.locks`); one that was
                                                  killed leaves the file behind, which then locks nothing

Scenes and cameras.json stand in the capture's own frame: training may have moved the origin, and config.json's
`origin` says where to.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from gsplat_edu.camera import Camera
from gsplat_edu.errors import ArgumentError, CheckpointError
from gsplat_edu.files import written_aside
from gsplat_edu.reading import parse_json, read_text
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.fields import CONFIG, LOG, METRICS, checked
from gsplat_edu.text import as_file_name
from gsplat_edu.validation import ArrayLike, float64_array
from gsplat_edu.views import View

ORIGIN = (0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """A run's folder; it need not be there yet.

    Args:
        path: The folder.
    """

    path: Path

    @property
    def config(self) -> Path:
        """What decides the run."""
        return self.path / "config.json"

    @property
    def log_file(self) -> Path:
        """One JSON object a line."""
        return self.path / "log.jsonl"

    @property
    def metrics(self) -> Path:
        """The judgement."""
        return self.path / "metrics.json"

    @property
    def cameras(self) -> Path:
        """The cameras of training and test."""
        return self.path / "cameras.json"

    @property
    def photos(self) -> Path:
        """Size and digest of every photo's file."""
        return self.path / "photos.json"

    @property
    def renders(self) -> Path:
        """Folder of pictures."""
        return self.path / "renders"

    @property
    def checkpoints(self) -> Path:
        """Folder of what a run is continued from."""
        return self.path / "checkpoints"

    @property
    def report(self) -> Path:
        """The run on one page."""
        return self.path / "report.html"

    def scene(self, iteration: int) -> Path:
        """Return where the scene after so many iterations lies."""
        return self.path / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"

    def exists(self) -> bool:
        """Say whether a run has begun here: it has written its config.json."""
        return self.config.is_file()

    def read_config(self) -> dict[str, Any]:
        """Read what decides the run.

        Raises:
            CheckpointError: there is no run here, or the file is damaged.
        """
        if not self.exists():
            raise CheckpointError(
                f"{self.path}: is no run: it has no config.json; give the folder of a training"
            )
        return checked(_read_object(self.config), CONFIG, str(self.config))

    def write_config(self, config: dict[str, Any]) -> None:
        """Write what decides the run.

        Raises:
            ArgumentError: something in it has no JSON, NaN for example.
            OSError: the file cannot be written. What stood there before is untouched.
        """
        write_json(self.config, config)

    def read_metrics(self) -> dict[str, Any]:
        """Read the judgement; empty where the run has not been judged.

        Raises:
            CheckpointError: the file is damaged.
        """
        if not self.metrics.is_file():
            return {}
        return checked(_read_object(self.metrics), METRICS, str(self.metrics))

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Write the judgement; errors as for `write_config`."""
        write_json(self.metrics, metrics)

    def read_photos(self) -> dict[str, Any] | None:
        """Read what was known of the photos when the run began; None if it was begun by a version that kept nothing.

        Raises:
            CheckpointError: the file is damaged.
        """
        return _read_object(self.photos) if self.photos.is_file() else None

    def write_photos(self, photos: dict[str, Any]) -> None:
        """Write what is known of the photos; errors as for `write_config`."""
        write_json(self.photos, photos)

    def log(self) -> list[dict[str, Any]]:
        """Read the log: the objects of its lines; none where there is no log.

        A last line that does not end was being written when the run was stopped, and is left out.

        Raises:
            CheckpointError: another line is no JSON object; the message names it.
        """
        if not self.log_file.is_file():
            return []
        *lines, _torn = read_text(self.log_file, errors="replace").split("\n")
        return [
            checked(_parse_object(line, where := f"{self.log_file}: line {number}"), LOG, where)
            for number, line in enumerate(lines, start=1)
            if line.strip()
        ]

    def latest_scene(self) -> tuple[Path, int]:
        """Return the scene of the most iterations, and how many those are.

        Raises:
            CheckpointError: there is none.
        """
        found = {}
        for path in self.path.glob("point_cloud/iteration_*/point_cloud.ply"):
            digits = path.parent.name.removeprefix("iteration_")
            if re.fullmatch(r"[0-9]+", digits):
                found[int(digits)] = path
        if not found:
            raise CheckpointError(
                f"{self.path}: holds no scene (point_cloud/iteration_N/point_cloud.ply); let the training go on"
                " until it writes one"
            )
        latest = max(found)
        return found[latest], latest

    def write_cameras(
        self, train_views: Sequence[View], test_views: Sequence[View], origin: ArrayLike = ORIGIN
    ) -> None:
        """Write the cameras as Inria's viewers read them, with our principal points and the split.

        Args:
            train_views: Views of training.
            test_views: Views that were held out.
            origin: (3,) added to the cameras' centres: where their zero lies in the capture's own frame.

        Raises:
            ShapeError: the origin is not of shape (3,).
            OSError: the file cannot be written. What stood there before is untouched.
        """
        shift = float64_array("origin", origin, (3,))
        views = [(view, "train") for view in train_views] + [(view, "test") for view in test_views]
        write_json(
            self.cameras, [_camera_entry(i, view, split, shift) for i, (view, split) in enumerate(views)]
        )

    def read_cameras(self, origin: ArrayLike = ORIGIN) -> list[tuple[str, str, Camera]]:
        """Read the cameras: name, split ("train" or "test") and camera of each.

        A file by Inria's code, without principal points and split, has them in the image's middle, and all are of
        training. What `write_cameras` wrote comes back to the bit where the origin is zero.

        Args:
            origin: (3,) subtracted from the cameras' centres; what `write_cameras` was given.

        Raises:
            ShapeError: the origin is not of shape (3,).
            CheckpointError: the file is not there, or damaged; the message names the entry.
        """
        shift = float64_array("origin", origin, (3,))
        if not self.cameras.is_file():
            raise CheckpointError(
                f"{self.cameras}: is not there; name a dataset's folder with --dataset PATH"
            )
        entries = _read_json(self.cameras)
        if not isinstance(entries, list):
            raise CheckpointError(f"{self.cameras}: is not a list of cameras; write it again or remove it")
        return [_camera(f"{self.cameras}: entry {i}", entry, shift) for i, entry in enumerate(entries)]


def render_settings(config: dict[str, Any]) -> RenderSettings:
    """Build the render settings of a run from the section "render" of its config; defaults for what it leaves out.

    Raises:
        CheckpointError: the section holds what this version does not know, or a value is out of its range.
    """
    section = config.get("render", {})
    known = {field.name for field in dataclasses.fields(RenderSettings)}
    if not isinstance(section, dict) or (unknown := sorted(set(section) - known)):
        what = f"{', '.join(unknown)}: not known" if isinstance(section, dict) else "is no object"
        raise CheckpointError(
            f"config.json: render: {what} to this version of gsplat_edu; use the run's version"
        )
    values: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in section.items()
    }
    try:
        return RenderSettings(**values)
    except (ArgumentError, TypeError) as error:
        raise CheckpointError(f"config.json: render: {error}; mend the file") from None


def image_file_names(names: Sequence[str], suffix: str = ".png") -> list[str]:
    """Turn the names of images into different file names of one folder.

    Whatever is not a letter, digit, ".", "_" or "-" becomes "_", folders included; an image's own suffix goes.

    Args:
        names: What the capture calls the images, "left/0001.jpg" for example.
        suffix: Of the file names.

    Returns:
        A file name per image: "left_0001.png".
    """
    result: list[str] = []
    taken: set[str] = set()
    copies: dict[str, int] = {}  # a thousand images of one name are not counted up from 2 each
    for index, name in enumerate(names):
        base = re.sub(r"\.[A-Za-z]{3,4}$", "", name)
        stem = re.sub(r"[^\w.-]", "_", base).lstrip(".")[:200] or f"view_{index:04d}"
        chosen, copy = stem, copies.get(stem.lower(), 2)
        while chosen.lower() in taken:  # file systems that know no case
            chosen, copy = f"{stem}_{copy}", copy + 1
        taken.add(chosen.lower())
        copies[stem.lower()] = copy
        result.append(as_file_name(chosen + suffix))
    return result


def write_json(path: Path, value: object) -> None:
    """Write strict JSON: no NaN, no infinity.

    Raises:
        ArgumentError: the value has no such JSON; the message says why.
        OSError: the file cannot be written. What stood there before is untouched.
    """
    try:
        text = json.dumps(value, indent=2, allow_nan=False, ensure_ascii=True)
    except (ValueError, TypeError) as error:
        raise ArgumentError(f"{path}: cannot be written as JSON ({error}); nothing was changed") from None
    with written_aside(path) as aside:
        aside.write_text(text + "\n", encoding="utf-8")


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")


def _parse(text: str, where: str) -> Any:  # noqa: ANN401
    try:
        return parse_json(text, _refuse_constant)
    except ValueError as error:
        reason = str(error)[:80]
        raise CheckpointError(f"{where}: is not JSON ({reason}); mend or remove it") from None


def _parse_object(text: str, where: str) -> dict[str, Any]:
    value = _parse(text, where)
    if not isinstance(value, dict):
        raise CheckpointError(f"{where}: is not a JSON object; mend or remove it")
    return value


def _read_json(path: Path) -> Any:  # noqa: ANN401
    return _parse(read_text(path, errors="replace"), str(path))


def _read_object(path: Path) -> dict[str, Any]:
    return _parse_object(read_text(path, errors="replace"), str(path))


def _camera_entry(index: int, view: View, split: str, shift: np.ndarray) -> dict[str, Any]:
    camera = view.camera
    return {
        "id": index,
        "img_name": view.name,
        "width": camera.W,
        "height": camera.H,
        "position": (camera.eye + shift).tolist() if shift.any() else camera.eye.tolist(),
        "rotation": camera.R.T.tolist(),  # camera to world
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "split": split,
    }


def _camera(where: str, entry: object, shift: np.ndarray) -> tuple[str, str, Camera]:
    if not isinstance(entry, dict):
        raise CheckpointError(f"{where}: is not a JSON object; write the file again or remove it")
    try:
        width, height = entry["width"], entry["height"]
        rotation = np.asarray(entry["rotation"], dtype=np.float64)
        eye = float64_array("position", entry["position"], (3,))
        camera = Camera(
            rotation.T,
            eye - shift if shift.any() else eye,
            entry["fx"],
            entry["fy"],
            entry.get("cx", (width - 1) / 2),
            entry.get("cy", (height - 1) / 2),
            height,
            width,
        )
    except KeyError as error:
        raise CheckpointError(f"{where}: lacks {error}; write the file again or remove it") from None
    except (ValueError, TypeError, OverflowError) as error:
        raise CheckpointError(f"{where}: {error}; write the file again or remove it") from None
    return str(entry.get("img_name", "")), str(entry.get("split", "train")), camera
