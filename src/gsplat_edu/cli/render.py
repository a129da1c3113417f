"""`gsplat-edu render`: images or a video of a trained scene."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from rich.progress import BarColumn, MofNCompleteColumn, TimeRemainingColumn

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import check_writable
from gsplat_edu.base.links import check_links
from gsplat_edu.base.text import image_file_names
from gsplat_edu.base.validation import whole_number
from gsplat_edu.cli.shot import PLAN, Shot, check_lens, median_depth, plan_asked_for, through_lens
from gsplat_edu.cli.terminal import Bar, Field, Terminal
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.edits.apply import Views, edited, placed, views_after
from gsplat_edu.edits.document import Edits, read_edits
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.evaluate.images import VIDEO_SUFFIX, check_output, write_frames
from gsplat_edu.evaluate.map_files import write_list, write_maps
from gsplat_edu.io.edit import IDENTITY
from gsplat_edu.io.formats import file_in, read_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.jobs import emitter
from gsplat_edu.options.render import KEYFRAMES, ORBIT_FRAMES, RUNS_CAMERAS, SCENE_SIZE, lens_choice
from gsplat_edu.paths.curve import PathCurve
from gsplat_edu.paths.following import path_along
from gsplat_edu.paths.keyframes import FEWEST, Keyframe, KeyframePath, evenly_chosen, read_path, write_path
from gsplat_edu.paths.orbits import orbit_of_scene, resized
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import device_of, load_backend, resolve_backend
from gsplat_edu.render.field import within_field
from gsplat_edu.render.maps import render_maps
from gsplat_edu.render.settings import MAPS, RenderSettings
from gsplat_edu.runs.dataset import data_settings
from gsplat_edu.runs.folder import RunFolder, render_settings
from gsplat_edu.runs.source import capture_up, file_settings, open_source
from gsplat_edu.scene.camera import WORLD_UP, Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.rig import through_lenses
from gsplat_edu.scene.shells import far_shell

MOST_FRAMES = 100_000
"""Largest number of frames of a path unless --frames gives more: an hour at 28 frames per second."""


def run(arguments: argparse.Namespace) -> None:
    """Render and report the written files, or write the path."""
    _check_outputs(arguments)
    lens = lens_choice(arguments.camera_model)
    backend = _backend(arguments.backend, lens.kind)
    maps = _chosen_maps(arguments)
    folder = RunFolder(arguments.source)
    edits = None if arguments.edits is None else read_edits(arguments.edits)
    orbit = arguments.orbit or arguments.dataset is None
    has_path = arguments.path is not None or (
        edits is not None and views_after(edits.operations).path is not None
    )
    planned = plan_asked_for(arguments, has_path)
    check_lens(arguments, maps, planned)
    name = PLAN if planned else _output_name(has_path, orbit, bool(maps))
    if folder.exists():
        shot = _run_shot(arguments, folder, orbit, edits)
        if arguments.out is None:
            check_links("RUN", folder.path)
        out = arguments.out or folder.renders / name
    elif file_in(arguments.source).is_file():
        shot = _file_shot(arguments, orbit, edits)
        out = arguments.out or Path("out") / f"{arguments.source.stem}_{name}"
    elif arguments.source.exists():
        raise ArgumentError(
            f"{arguments.source}: is not a run (config.json is missing); give a run folder or a scene file"
        )
    else:
        raise ArgumentError(f"{arguments.source}: does not exist; give a run folder or a scene file")
    shot = through_lens(shot, lens, arguments.size, planned)
    console = Terminal()
    if shot.path:
        console.print(shot.path, soft_wrap=True)
    if arguments.save_path is not None:
        console.print(_save_path(arguments, shot, orbit), soft_wrap=True)
        return
    started = time.perf_counter()
    shot = replace(shot, gaussians=shot.gaussians.to(device_of(backend)), maps=maps)
    columns = (Field("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("rendering", total=len(shot.cameras))

        def advanced() -> Iterator[Any]:
            for frame in _frames(shot, backend, out):
                yield frame
                bar.advance(task)

        written = write_frames(out, advanced(), arguments.fps, shot.names, shot.sphere)
    emitter.report_output(out)
    each = 1e3 * (time.perf_counter() - started) / len(shot.cameras)
    first = shot.cameras[0]
    also = f" and their maps ({', '.join(maps)})" if maps else ""
    what = f"{len(shot.cameras)} images{also} of {len(shot.gaussians):,} Gaussians"
    what += f", {first.W}x{first.H}, {each:.0f} ms each"
    console.say(f"wrote {out}{'' if written == [out] else '/'}: {what}")


def _backend(name: str, lens: str) -> str:
    """Return the backend to render with: "auto" takes one that has the lens."""
    found = resolve_backend(name)
    if lens == "pinhole" or "lens" not in load_backend(found).lacks:
        return found
    if name == "auto":
        return resolve_backend("cpu")
    load_backend(found).require("lens", f"--camera-model: {lens}")
    return found


def _check_outputs(arguments: argparse.Namespace) -> None:
    if arguments.out is not None:
        check_output(arguments.out)
    if arguments.keyframes is not None:
        whole_number("--keyframes", arguments.keyframes, FEWEST)
    if arguments.save_path is not None:
        check_writable("--save-path", arguments.save_path)


def _output_name(has_path: bool, orbit: bool, maps: bool) -> str:
    """Return the default name of the output: a video, or a folder for maps and for the dataset's cameras."""
    if not orbit:
        return "views"
    kind = "path" if has_path else "orbit"
    return kind if maps else f"{kind}{VIDEO_SUFFIX}"


def _orbit_frames(arguments: argparse.Namespace) -> int:
    """Return the number of cameras of an orbit to render, or of keyframes to save."""
    if arguments.save_path is not None:
        return int(arguments.keyframes or KEYFRAMES)
    return int(arguments.frames or ORBIT_FRAMES)


def _save_path(arguments: argparse.Namespace, shot: Shot, orbit: bool) -> str:
    """Write the shot's cameras as keyframes; return a line about it."""
    cameras = evenly_chosen(shot.cameras, arguments.keyframes or KEYFRAMES)
    if len(cameras) < FEWEST:
        raise ArgumentError(f"--save-path: there is 1 camera, but a path needs at least {FEWEST}")
    duration = (arguments.frames or ORBIT_FRAMES) / arguments.fps if orbit else None
    path = KeyframePath(tuple(map(Keyframe.of_camera, cameras)), orbit, duration)
    write_path(arguments.save_path, path, shot.origin)
    kind = "loop" if orbit else "path"
    return f"wrote {arguments.save_path}: {len(cameras)} keyframes, a {kind} of {path.seconds:g} s"


def _path_of(arguments: argparse.Namespace, origin: Sequence[float], views: Views) -> KeyframePath | None:
    """Return the path of --path or of the edits, relative to the origin of the edited scene.

    Args:
        arguments: The command line.
        origin: That of the scene before its edits.
        views: The views of the edits.
    """
    path = views.path if arguments.path is None else read_path(arguments.path, origin)
    if path is None or views.move is IDENTITY:
        return path
    return path.placed(views.move.R, views.move.s, views.move.t)


def _after_edits(arguments: argparse.Namespace, scene: Scene, edits: Edits | None) -> tuple[Scene, Views]:
    """Apply the edits of --edits to a scene."""
    if edits is None:
        return scene, views_after(())
    edits.check_scene(identity_of(scene), str(arguments.edits))
    views = views_after(edits.operations)
    left = edited(scene, edits.operations)
    if not len(left.gaussians):
        raise ArgumentError(f"{arguments.edits}: leaves no splat of the scene; remove a deletion from it")
    return placed(left, views), views


def _path_cameras(arguments: argparse.Namespace, path: KeyframePath, width: int, height: int) -> list[Camera]:
    """Return the cameras along a path."""
    frames = arguments.frames
    if frames is None:
        frames = max(1, round(path.seconds * arguments.fps) + (0 if path.loop else 1))
        if frames > MOST_FRAMES:
            raise ArgumentError(
                f"{arguments.path or arguments.edits}: lasts {path.seconds:g} s, which is {frames:,} frames;"
                " give --frames"
            )
    return PathCurve(path).cameras(frames, width, height)


def _run_shot(arguments: argparse.Namespace, folder: RunFolder, orbit: bool, edits: Edits | None) -> Shot:
    config = folder.read_config()
    settings = _settings(render_settings(config), arguments)
    scene, _ = folder.latest_scene()
    if arguments.dataset not in (None, RUNS_CAMERAS):
        return _dataset_shot(arguments, read_scene(scene), settings, data_settings(config), orbit)
    whole = open_source(scene).scene
    origin = whole.origin
    left, views = _after_edits(arguments, whole, edits)
    gaussians, up = left.gaussians, left.up or WORLD_UP
    named = [(name, camera) for name, _, camera in folder.read_cameras(origin)]
    if views.move is not IDENTITY:
        named = [(name, views.move.camera(camera)) for name, camera in named]
    if not named:
        raise ArgumentError(f"{folder.cameras}: lists no cameras; give a dataset folder with --dataset PATH")
    if (path := _path_of(arguments, origin, views)) is not None:
        first = named[0][1] if arguments.size is None else resized(named[0][1], arguments.size)
        along = _path_cameras(arguments, path, first.W, first.H)
        lenses = through_lenses(camera for _, camera in named)
        return Shot(gaussians, along, None, settings, up=up, through_lenses=lenses)
    shot = _shot(arguments, gaussians, named, settings, orbit)
    return replace(shot, origin=left.origin, up=up, unit=left.unit)


def _file_shot(arguments: argparse.Namespace, orbit: bool, edits: Edits | None) -> Shot:
    if arguments.dataset == RUNS_CAMERAS:
        raise ArgumentError("--dataset: a scene file has no cameras; give the dataset folder: --dataset PATH")
    whole = read_scene(arguments.source)
    scene, views = _after_edits(arguments, whole, edits)
    settings = _settings(file_settings(scene), arguments)
    if arguments.dataset is not None:
        return _dataset_shot(arguments, scene, settings, DataSettings(), orbit)
    side, up = arguments.size or SCENE_SIZE, scene.up or WORLD_UP
    if (path := _path_of(arguments, whole.origin, views)) is not None:
        return Shot(scene.gaussians, _path_cameras(arguments, path, side, side), None, settings, up=up)
    cameras = orbit_of_scene(scene.gaussians, _orbit_frames(arguments), side, up)
    description = (
        "a scene file has no cameras: using a full circle; --dataset PATH follows a capture's cameras"
    )
    return Shot(
        scene.gaussians, cameras, None, settings, description, origin=scene.origin, up=up, unit=scene.unit
    )


def _dataset_shot(
    arguments: argparse.Namespace,
    scene: Scene,
    settings: RenderSettings,
    data: DataSettings,
    orbit: bool,
) -> Shot:
    dataset = load_dataset(arguments.dataset, data)
    gaussians = scene.relative_to(dataset.origin)
    named = [(view.name, view.camera) for view in (*dataset.train, *dataset.test)]
    shot = _shot(arguments, gaussians, named, settings, orbit)
    return replace(shot, origin=tuple(dataset.origin.tolist()), up=capture_up(dataset))


def _shot(
    arguments: argparse.Namespace,
    gaussians: Gaussians,
    named: Sequence[tuple[str, Camera]],
    settings: RenderSettings,
    orbit: bool,
) -> Shot:
    if arguments.save_path is not None:
        named = sorted(named, key=lambda entry: entry[0])  # the order in which most captures were taken
    cameras = [camera for _, camera in named]
    names, description = None, ""
    if orbit:
        path = path_along(cameras, _orbit_frames(arguments), median_depth(gaussians, cameras[0]))
        cameras, description = path.cameras, path.description
    else:
        names = image_file_names([name for name, _ in named])
    if arguments.size is not None:
        cameras = [resized(camera, arguments.size) for camera in cameras]
    lenses = through_lenses(camera for _, camera in named)
    return Shot(gaussians, cameras, names, settings, description, through_lenses=lenses)


def _settings(settings: RenderSettings, arguments: argparse.Namespace) -> RenderSettings:
    changes: dict[str, Any] = {"background": (1.0, 1.0, 1.0)} if arguments.white_background else {}
    return replace(settings, depth=False, **changes)


def _chosen_maps(arguments: argparse.Namespace) -> list[str]:
    """Return the maps that --maps names, after checking that they can be written."""
    if arguments.maps is None:
        return []
    names = [name.strip() for name in arguments.maps.split(",")]
    if unknown := [name for name in names if name not in MAPS]:
        raise ArgumentError(f"--maps: does not know {unknown[0]!r}; use {', '.join(MAPS)}")
    if arguments.out is not None and arguments.out.suffix.lower() == VIDEO_SUFFIX:
        raise ArgumentError(f"--maps: {arguments.out} is a video; give a folder with --out DIR")
    return list(dict.fromkeys(names))


def _frames(shot: Shot, backend: str, out: Path) -> Iterator[Float[np.ndarray, "H W 3"]]:
    """Yield the images; write the maps of each beside them. A sky is part of the images, but of no map."""
    scales: dict[str, dict[str, float]] = {}
    sky = torch.from_numpy(far_shell(shot.gaussians.means.numpy(force=True))) if shot.maps else None
    surface = shot.gaussians if sky is None or not sky.any() else shot.gaussians[~sky]
    for index, camera in enumerate(shot.cameras):
        with torch.no_grad():
            shown, solid = (
                within_field(each, camera) if shot.through_lenses else each
                for each in (shot.gaussians, surface)
            )
            maps, view = render_maps(solid, camera, shot.maps, shot.settings, backend)
            if surface is not shot.gaussians:
                view = render(shown, camera, settings=shot.settings, backend=backend)
        arrays = {name: tensor.numpy(force=True) for name, tensor in maps.items()}
        image, arrays = shot.within(view.image.numpy(force=True), arrays)
        if shot.maps:
            stem = f"frame_{index:04d}" if shot.names is None else Path(shot.names[index]).stem
            scales |= write_maps(out, stem, arrays)
        yield image
    if shot.maps:
        write_list(out, scales)
