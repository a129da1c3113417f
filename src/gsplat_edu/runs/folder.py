"""The folder of a run and its files.

    config.json                                   all settings of the run
    log.jsonl                                     one JSON object per line, each with `iteration`
    metrics.json                                  the scores: {"test": {...}, "train": {...}, "num_gaussians": ...}
    cameras.json                                  the cameras, in the format of Inria's viewers
    point_cloud/iteration_N/point_cloud.ply       the scene after N iterations
    mesh.json                                     what is known of the meshes made of the scene
    photos.json                                   size and digest of every photo's file when the run started
    checkpoints/                                  states to resume from
    renders/                                      pictures
    report.html                                   the run on one page
    .lock                                         names the process that writes here (see base/locks.py); the file of
                                                  a killed process remains, but locks nothing

Scenes and cameras.json are in the capture's own frame. Training may subtract an origin from the coordinates;
config.json stores it as `origin`.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gsplat_edu.base.constants import RUN_CONFIG
from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.plugins import plugins
from gsplat_edu.base.reading import parse_json, read_text
from gsplat_edu.base.records import ABSENT, Absent, Number, Record, present, record_of
from gsplat_edu.base.validation import ArrayLike, float64_array, quoted
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.fields import CONFIG, LOG, MESH, METRICS, checked
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.frame import ORIGIN
from gsplat_edu.scene.lens_record import Vector, lens_entry, with_lens
from gsplat_edu.scene.views import View

FORMAT = 1
"""Number of the layout of a run's files; a run of another layout is refused."""


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """A run's folder; it need not exist yet.

    Args:
        path: The folder.
    """

    path: Path

    @property
    def config(self) -> Path:
        """All settings of the run."""
        return self.path / RUN_CONFIG

    @property
    def log_file(self) -> Path:
        """One JSON object per line."""
        return self.path / "log.jsonl"

    @property
    def metrics(self) -> Path:
        """The scores."""
        return self.path / "metrics.json"

    @property
    def cameras(self) -> Path:
        """The training and test cameras."""
        return self.path / "cameras.json"

    @property
    def photos(self) -> Path:
        """Size and digest of every photo's file."""
        return self.path / "photos.json"

    @property
    def meshes(self) -> Path:
        """What is known of the meshes made of the scene."""
        return self.path / "mesh.json"

    @property
    def renders(self) -> Path:
        """Folder of pictures."""
        return self.path / "renders"

    @property
    def checkpoints(self) -> Path:
        """Folder of the states to resume from."""
        return self.path / "checkpoints"

    @property
    def report(self) -> Path:
        """The run on one page."""
        return self.path / "report.html"

    def scene(self, iteration: int) -> Path:
        """Return the path of the scene after this many iterations."""
        return self.path / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"

    def exists(self) -> bool:
        """Return whether a run has started here: config.json exists."""
        return self.config.is_file()

    def read_config(self) -> dict[str, Any]:
        """Read the settings of the run.

        Raises:
            CheckpointError: the folder contains no run, one of another version, or the file is damaged.
        """
        if not self.exists():
            raise CheckpointError(
                f"{self.path}: is not a run: it has no config.json; give the folder of a run"
            )
        config = _read_object(self.config)
        if (written := config.pop("format", None)) != FORMAT:
            by = f"number {written}" if type(written) is int else "no number"
            raise CheckpointError(
                f"{self.config}: has {by} for its format, and this version reads {FORMAT}; train the run again"
            )
        return checked(config, CONFIG, str(self.config))

    def check_plugins(self) -> None:
        """Check that the plug-ins that the run was trained with are installed.

        Raises:
            CheckpointError: one is not, or config.json is damaged.
        """
        for name, package in self.read_config().get("plugins", {}).items():
            if name not in {**plugins("parts"), **plugins("strategies")}:
                raise CheckpointError(
                    f"--resume: {self.path} was trained with the plug-in {str(name)[:60]} of {str(package)[:60]},"
                    " which is not installed; install the package, or give another --out"
                )

    def write_config(self, config: dict[str, Any]) -> None:
        """Write the settings of the run.

        Raises:
            ArgumentError: a value cannot be represented in JSON, for example NaN.
            OSError: the file cannot be written. An existing file is unchanged.
        """
        write_json(self.config, {"format": FORMAT, **config})

    def read_metrics(self) -> dict[str, Any]:
        """Read the scores; empty if the run has not been evaluated.

        Raises:
            CheckpointError: the file is damaged.
        """
        if not self.metrics.is_file():
            return {}
        return checked(_read_object(self.metrics), METRICS, str(self.metrics))

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Write the scores; errors as for `write_config`."""
        write_json(self.metrics, metrics)

    def read_meshes(self) -> dict[str, Any]:
        """Read what is known of the meshes, by their kind; empty if there are none.

        Raises:
            CheckpointError: the file is damaged.
        """
        if not self.meshes.is_file():
            return {}
        kinds = _read_object(self.meshes)
        for kind, record in kinds.items():
            where = f"{self.meshes}: {kind}"
            if not isinstance(record, dict):
                raise CheckpointError(f"{where}: is not an object; fix or remove the file")
            checked(record, MESH, where)
        return kinds

    def write_meshes(self, meshes: dict[str, Any]) -> None:
        """Write what is known of the meshes; errors as for `write_config`."""
        write_json(self.meshes, meshes)

    def read_photos(self) -> dict[str, Any] | None:
        """Read the photos' digests at the start of the run; None if an older version started it without photos.json.

        Raises:
            CheckpointError: the file is damaged.
        """
        return _read_object(self.photos) if self.photos.is_file() else None

    def write_photos(self, photos: dict[str, Any]) -> None:
        """Write the photos' digests; errors as for `write_config`."""
        write_json(self.photos, photos)

    def log(self) -> list[dict[str, Any]]:
        """Read the objects of the log's lines; empty if there is no log.

        A last line without a newline was cut off when the run was stopped, and is skipped.

        Raises:
            CheckpointError: another line is not a JSON object; the message names it.
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
        """Return the scene with the most iterations, and their number.

        Raises:
            CheckpointError: the folder contains no scene.
        """
        found = {}
        for path in self.path.glob("point_cloud/iteration_*/point_cloud.ply"):
            digits = path.parent.name.removeprefix("iteration_")
            if re.fullmatch(r"[0-9]+", digits):
                found[int(digits)] = path
        if not found:
            raise CheckpointError(
                f"{self.path}: contains no scene (point_cloud/iteration_N/point_cloud.ply) yet; continue the"
                " training until it writes one"
            )
        latest = max(found)
        return found[latest], latest

    def write_cameras(
        self, train_views: Sequence[View], test_views: Sequence[View], origin: ArrayLike = ORIGIN
    ) -> None:
        """Write the cameras in the format of Inria's viewers, with the principal points and the split added.

        Args:
            train_views: Training views.
            test_views: Held-out views.
            origin: (3,) added to the camera centres: position of their zero in the capture's own frame.

        Raises:
            ShapeError: the origin is not of shape (3,).
            OSError: the file cannot be written. An existing file is unchanged.
        """
        shift = float64_array("origin", origin, (3,))
        views = [(view, "train") for view in train_views] + [(view, "test") for view in test_views]
        write_json(
            self.cameras, [_camera_entry(i, view, split, shift) for i, (view, split) in enumerate(views)]
        )

    def read_cameras(self, origin: ArrayLike = ORIGIN) -> list[tuple[str, str, Camera]]:
        """Read the cameras: name, split ("train" or "test") and camera of each.

        Files by Inria's code have no principal points and no split: principal points default to the image centre, and
        all views to training. With a zero origin, cameras are read back bit for bit as `write_cameras` wrote them.

        Args:
            origin: (3,) subtracted from the camera centres; the origin that `write_cameras` was called with.

        Raises:
            ShapeError: the origin is not of shape (3,).
            CheckpointError: the file does not exist or is damaged; the message names the entry.
        """
        shift = float64_array("origin", origin, (3,))
        if not self.cameras.is_file():
            raise CheckpointError(
                f"{self.cameras}: does not exist; give a dataset's folder with --dataset PATH"
            )
        entries = _read_json(self.cameras)
        if not isinstance(entries, list):
            raise CheckpointError(f"{self.cameras}: is not a list of cameras; write it again or remove it")
        return [_camera(f"{self.cameras}: entry {i}", entry, shift) for i, entry in enumerate(entries)]


def render_settings(config: dict[str, Any]) -> RenderSettings:
    """Build the render settings of a run from the section "render" of its config; missing keys get their defaults.

    Raises:
        CheckpointError: this version does not know a key of the section, or a value is out of range.
    """
    section = config.get("render", {})
    known = {field.name for field in dataclasses.fields(RenderSettings)}
    if not isinstance(section, dict) or (unknown := sorted(set(section) - known)):
        what = (
            f"unknown settings {', '.join(map(quoted, unknown))}"
            if isinstance(section, dict)
            else "is not an object"
        )
        raise CheckpointError(
            f"config.json: render: {what}; use the version of gsplat_edu that started the run"
        )
    values: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in section.items()
    }
    try:
        return RenderSettings(**values)
    except (ArgumentError, TypeError) as error:
        raise CheckpointError(f"config.json: render: {error}; fix the file") from None


def write_json(path: Path, value: object) -> None:
    """Write strict JSON: no NaN, no infinity.

    Raises:
        ArgumentError: the value cannot be represented; the message says why.
        OSError: the file cannot be written. An existing file is unchanged.
    """
    try:
        text = json.dumps(value, indent=2, allow_nan=False, ensure_ascii=True)
    except (ValueError, TypeError) as error:
        raise ArgumentError(f"{path}: cannot be written as JSON ({error}); nothing was changed") from None
    with written_aside(path) as aside:
        aside.write_text(text + "\n", encoding="utf-8")


def _parse(text: str, where: str) -> Any:  # noqa: ANN401
    try:
        return parse_json(text, strict=True)
    except ValueError as error:
        reason = str(error)[:80]
        raise CheckpointError(f"{where}: is not JSON ({reason}); fix or remove it") from None


def _parse_object(text: str, where: str) -> dict[str, Any]:
    value = _parse(text, where)
    if not isinstance(value, dict):
        raise CheckpointError(f"{where}: is not a JSON object; fix or remove it")
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
        **lens_entry(camera),
    }


class _Camera(Record, frozen=True, forbid_unknown_fields=False):
    """An entry of cameras.json; `with_lens` reads the lens and the shutter."""

    width: int
    height: int
    position: Vector
    rotation: tuple[Vector, Vector, Vector]
    fx: Number
    fy: Number
    cx: Number | Absent = ABSENT
    cy: Number | Absent = ABSENT
    img_name: str = ""
    split: Literal["train", "test"] = "train"


def _camera(where: str, entry: Any, shift: np.ndarray) -> tuple[str, str, Camera]:  # noqa: ANN401
    try:
        one: _Camera = record_of("", entry, _Camera)
        cx, cy = present(one.cx), present(one.cy)
        camera = Camera(
            np.array(one.rotation).T,
            np.array(one.position) - shift if shift.any() else np.array(one.position),
            one.fx,
            one.fy,
            (one.width - 1) / 2 if cx is None else cx,
            (one.height - 1) / 2 if cy is None else cy,
            one.height,
            one.width,
        )
        camera = with_lens(camera, entry)
    except (ValueError, TypeError, OverflowError) as error:
        raise CheckpointError(f"{where}: {error}; write the file again or remove it") from None
    return one.img_name, one.split, camera
