"""Short work that needs torch or much memory, in a process of its own that answers one request after the other.

    python -m gsplat_edu.studio.worker

reads requests from standard input and writes answers to standard output, one JSON object per line: {"task": name, ...}
and {"result": ...} or {"error": one line}. It ends with its input, or after `IDLE` seconds without a request, so that
the memory of a scene is not held forever. No task takes longer than a minute; longer work is a job.
"""

from __future__ import annotations

import json
import os
import select
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gsplat_edu.base.errors import SplatError
from gsplat_edu.base.files import described, written_aside
from gsplat_edu.base.reading import parse_json, read_bytes
from gsplat_edu.base.text import legible

COVER = 512, 384
"""Size of the picture of a scene's start view, px: the shape of the page's cards."""

IDLE = 600.0
"""Seconds without a request after which the process ends."""


def make_page(
    source: str,
    title: str,
    out: str,
    edits: str = "",
    url: str = "",
    surface: str = "",
    collider: str = "",
    applied: str = "",
) -> dict[str, Any]:
    """Write the page that shows a scene (`gsplat_edu.viewer.page`).

    Args:
        source: Scene file or run folder.
        title: Heading of the page.
        out: File to write.
        edits: File of the scene's edits, for a page with the editor; empty for one without.
        url: Where that page reads and stores edits, relative to itself.
        surface: File of the mesh that the page shows beside the splats; empty for none.
        collider: File of the collider over it; empty for none.
        applied: File of edits that the page, one without the editor, shows applied; empty for none.
    """
    from gsplat_edu.runs.source import open_source
    from gsplat_edu.viewer import page, page_parts
    from gsplat_edu.viewer.edit_page import editing_of
    from gsplat_edu.viewer.page_mesh import open_meshes

    found = open_source(source)
    meshes = open_meshes(Path(surface) if surface else None, Path(collider) if collider else None, found)
    pictures, tour = "picture", page.Tour(meshes=meshes)
    if applied:
        pictures = "picture?edited=1"
        found, tour = _edited(found, applied, meshes)
    shown = (found.scene, found.cameras, found.settings, title, found.held_out, tour)
    if edits:
        editing = editing_of(found, Path(source), Path(edits), url)
        html, policy = page.html(*shown, editing), page_parts.policy(page_parts.EDITOR)
    else:
        html, policy = page.html(*shown, pictures=pictures), page_parts.policy(page_parts.PICTURED)
    _write(out, html)
    return {"policy": policy, "count": len(found.scene.gaussians)}


def _edited(found: Any, applied: str, meshes: Any = None) -> tuple[Any, Any]:  # noqa: ANN401
    """Apply edits to an opened scene and the meshes beside it; return it with the tour of its page."""
    from dataclasses import replace

    from gsplat_edu.edits.apply import views_after
    from gsplat_edu.edits.document import read_edits
    from gsplat_edu.viewer.edited import edited_meshes, edited_source, toured

    path = Path(applied)
    edits = read_edits(path)
    views = views_after(edits.operations)
    meshes = edited_meshes(meshes, found, edits)
    found = edited_source(found, edits, path.name)
    tour = toured(found, views, views.move)
    return found, replace(tour, meshes=meshes and meshes.moved(views.move))


def make_live_page(facts: str, out: str) -> dict[str, Any]:
    """Write the page that shows a training (`gsplat_edu.viewer.live_folder`).

    Args:
        facts: Its page.json.
        out: File to write.
    """
    from gsplat_edu.viewer import page, page_parts

    _write(out, page.live_html(parse_json(read_bytes(Path(facts))), step=False))
    return {"policy": page_parts.policy(page_parts.LIVE)}


def make_capture_page(capture: str, title: str, out: str) -> dict[str, Any]:
    """Write the page that shows a capture in 3D (`gsplat_edu.viewer.capture_page`).

    Args:
        capture: Folder of the capture.
        title: Heading of the page.
        out: File to write.
    """
    from gsplat_edu.data.reader import CaptureReader
    from gsplat_edu.viewer import capture_page
    from gsplat_edu.viewer.capture_data import capture_facts

    _write(out, capture_page.html(capture_facts(CaptureReader(capture), title)))
    return {"policy": capture_page.policy()}


def make_picture(
    source: str,
    camera: Any,  # noqa: ANN401
    live: bool,
    threads: int = 0,
    applied: str = "",
) -> dict[str, Any]:
    """Render what a page's camera sees.

    Args:
        source: Scene file or run folder.
        camera: As `gsplat_edu.viewer.live.picture_camera` takes it; None for the start view, fitted to its subject.
        live: Whether to draw the newest snapshot of the run's training.
        threads: Threads to render with; 0 for all.
        applied: File of edits to apply; empty for none.

    Returns:
        jpeg, in base64, and the seconds of processor time that it took.
    """
    import base64
    import time

    import torch

    from gsplat_edu.render.api import render
    from gsplat_edu.render.field import within_field
    from gsplat_edu.viewer.live import jpeg_of, picture_camera

    began = time.process_time()
    if live:
        gaussians, settings, lenses = _snapshot(Path(source))
        seen = picture_camera(camera)
    else:
        gaussians, settings, start, lenses = _opened(source, applied)
        seen = start if camera is None else picture_camera(camera)
    gaussians = within_field(gaussians, seen) if lenses else gaussians
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)
    try:
        output = render(gaussians, seen, settings=settings)
    finally:
        torch.set_num_threads(before)
    data = base64.b64encode(jpeg_of(output)).decode()
    return {"jpeg": data, "seconds": time.process_time() - began}


def _snapshot(run: Path) -> tuple[Any, Any, bool]:
    """Read the newest splats of a training, the settings of its page, and whether it trains through lenses."""
    from gsplat_edu.base.errors import SceneFormatError
    from gsplat_edu.render.settings import RenderSettings
    from gsplat_edu.viewer import page_data
    from gsplat_edu.viewer.live_folder import LiveFolder, split

    folder = LiveFolder(run)
    facts = folder.read_page()
    if facts is None or not folder.scene.is_file():
        raise SceneFormatError(f"{run.name}: has not begun to train; try again in a few seconds")
    header, splats = split(folder.scene, read_bytes(folder.scene))
    gaussians = page_data.unpacked(folder.scene, splats, header["count"], header["sh_degree"])
    given = facts["settings"] | {"background": tuple(facts["settings"]["background"])}
    lenses = given.pop("beyond", None) is not None
    return gaussians, RenderSettings(**given, depth=False), lenses


def _opened(source: str, applied: str) -> tuple[Any, Any, Any, bool]:
    """Open a finished scene; return splats, settings, start view, and whether it was trained through lenses.

    The last one is kept.
    """
    from dataclasses import replace

    from gsplat_edu.runs.source import open_source
    from gsplat_edu.scene.rig import through_lenses
    from gsplat_edu.viewer.page import cover_view

    if (key := f"{_state_of(source)} {_state_of(applied) if applied else ''}") not in _scenes:
        found, start = open_source(source), None
        if applied:
            found, tour = _edited(found, applied)
            start = tour.start
        camera = cover_view(found.scene, found.cameras, found.held_out, start, COVER)
        _scenes.clear()
        lenses = through_lenses(own for _, own in found.cameras)
        settings = replace(found.settings, depth=False)
        _scenes[key] = found.scene.gaussians, settings, camera, lenses
    gaussians, settings, camera, lenses = _scenes[key]
    return gaussians, settings, camera, lenses


def _state_of(source: str) -> str:
    """Return a value that changes with a scene's file, or with a run's latest scene."""
    from gsplat_edu.io.formats import file_in
    from gsplat_edu.runs.folder import RunFolder

    path = file_in(Path(source))
    if path.is_dir() and RunFolder(path).exists():
        path, _ = RunFolder(path).latest_scene()
    facts = path.stat()
    return f"{path} {facts.st_mtime_ns} {facts.st_size}"


_scenes: dict[str, Any] = {}
"""The scene that was drawn last."""


def check_edits(path: str, name: str, source: str) -> dict[str, Any]:
    """Check an edits file: its operations, and that it was made for a scene.

    Args:
        path: The file.
        name: Its name, for messages.
        source: Scene file or run folder.
    """
    from gsplat_edu.edits.document import parse_edits
    from gsplat_edu.edits.identity import identity_of
    from gsplat_edu.runs.source import open_source

    edits = parse_edits(read_bytes(Path(path)), name)
    if (key := _state_of(source)) not in _identities:
        found = open_source(source)
        _identities.clear()
        _identities[key] = identity_of(found.scene)
    edits.check_scene(_identities[key], name)
    return {"operations": len(edits.operations)}


_identities: dict[str, Any] = {}
"""The identity of the scene that was checked last."""


def forecast(capture: str, resolution: float | str | None) -> dict[str, Any]:
    """Forecast time and memory of a training of each quality, measured now on this machine.

    Args:
        capture: Folder of the capture.
        resolution: As for `train --resolution`: a number or "auto".
    """
    from dataclasses import replace

    from gsplat_edu.budget.choice import Prospect, choose_backend
    from gsplat_edu.budget.costs import Facts
    from gsplat_edu.budget.forecast import predict
    from gsplat_edu.data.dataset import Dataset
    from gsplat_edu.data.reader import CaptureReader
    from gsplat_edu.data.settings import DataSettings
    from gsplat_edu.train.capacity import advised_side
    from gsplat_edu.train.config import DEFAULT_STRATEGY, recipe
    from gsplat_edu.train.length import QUALITIES, planned_iterations

    reader = CaptureReader(capture)
    whole = Dataset.of(reader)
    if isinstance(resolution, str):
        sizes = [(view.camera.W, view.camera.H) for view in (*whole.train, *whole.test)]
        side = advised_side(sizes, len(whole.train))
        resolution = None if side is None else float(side)
    dataset = Dataset.of(reader, DataSettings(resolution=resolution))
    facts = Facts.of(dataset, whole)
    measured, found = None, {}
    for name in sorted(QUALITIES, key=lambda name: -QUALITIES[name]):
        iterations = planned_iterations(name, facts.train, facts.measured)
        config = recipe(iterations, strategy=DEFAULT_STRATEGY)
        cap = facts.wanted(config)
        config = replace(config, max_gaussians=cap)
        if measured is None:
            prospect = Prospect(dataset, whole, config)
            chosen = choose_backend(prospect)
            measured = chosen.measured.get(chosen.backend) or prospect.measured(chosen.backend)
        said = predict(facts, measured, config, dataset.images.budget)
        found[name] = {
            "iterations": said.iterations,
            "seconds": said.total,
            "bytes": said.peak,
            "gaussians": said.gaussians[1],
            "factor": said.factor,
            "backend": said.backend,
            "lines": said.lines(),
        }
    return {name: found[name] for name in QUALITIES}


def certain(capture: str) -> dict[str, Any]:
    """Return what is certain about a capture that nobody has examined, as the fields of events.

    Args:
        capture: Folder of the capture; one whose poses are missing or damaged has no findings yet.
    """
    from msgspec.structs import asdict

    from gsplat_edu.base.errors import DatasetError
    from gsplat_edu.data.reader import CaptureReader
    from gsplat_edu.doctor.certain import certain_findings
    from gsplat_edu.doctor.diagnosis import event_of

    try:
        return {"findings": [asdict(event_of(one)) for one in certain_findings(CaptureReader(capture))]}
    except DatasetError:
        return {"findings": []}


def sentence(line: str) -> str:
    """Return a line that begins with a capital, unless it begins with the name of a file."""
    return line[:1].upper() + line[1:] if line.partition(" ")[0].isalpha() else line


def notes(capture: str) -> dict[str, Any]:
    """Return what the command line says when it reads a capture: whose poses, of how many photos, which files not.

    Args:
        capture: Folder of the capture; of one that cannot be read, its training says why.
    """
    from gsplat_edu.base.errors import DatasetError
    from gsplat_edu.data.reader import read_capture

    try:
        said = [legible(str(note)) for note in read_capture(Path(capture)).notes]
    except DatasetError:
        return {"notes": []}
    return {"notes": [sentence(line) for line in said]}


def make_thumbnail(photo: str, side: int, out: str) -> dict[str, Any]:
    """Write a photo's thumbnail; see `gsplat_edu.studio.pictures.make_thumbnail`."""
    from gsplat_edu.studio.pictures import make_thumbnail

    return make_thumbnail(photo, side, out)


def check_photos(entry: str, cache: str) -> dict[str, Any]:
    """Measure photos that are not placed yet; see `gsplat_edu.studio.photo_checks.check_photos`."""
    from gsplat_edu.studio.photo_checks import check_photos

    return check_photos(entry, cache)


def draw_mask(
    capture: str, photo: str, shapes: list[Any] | None = None, version: str | None = None
) -> dict[str, Any]:
    """Draw on a photo's mask; see `gsplat_edu.studio.photo_masks.draw`."""
    from gsplat_edu.studio.photo_masks import draw

    return draw(capture, photo, shapes, version)


def make_view_pictures(comparison: str, outs: dict[str, str], small: bool) -> dict[str, Any]:
    """Write pictures of a run's held-out view; see `gsplat_edu.studio.runs.make_view_pictures`."""
    from gsplat_edu.studio.runs import make_view_pictures

    return make_view_pictures(comparison, outs, small)


TASKS: dict[str, Callable[..., dict[str, Any]]] = {
    "notes": notes,
    "page": make_page,
    "live_page": make_live_page,
    "capture_page": make_capture_page,
    "picture": make_picture,
    "check_edits": check_edits,
    "thumbnail": make_thumbnail,
    "check_photos": check_photos,
    "mask": draw_mask,
    "view_pictures": make_view_pictures,
    "forecast": forecast,
    "certain": certain,
}


def answer(line: bytes) -> dict[str, Any]:
    """Carry out a request; a failure becomes one line."""
    try:
        request = parse_json(line)
        return {"result": TASKS[request.pop("task")](**request)}
    except SplatError as error:
        return {"error": legible(str(error))}
    except OSError as error:
        return {"error": legible(described(error))}
    except MemoryError:
        return {"error": "ran out of memory; close other programs, or cancel a job"}
    except Exception as error:
        return {
            "error": legible(f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}")
        }


def main(nice: int = 0) -> None:
    """Answer requests until the input ends.

    Args:
        nice: Niceness of the process.
    """
    os.nice(nice)
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # libraries may print to stdout, which is for answers only
    requests = sys.stdin.buffer
    while select.select([requests], [], [], IDLE)[0]:
        line = requests.readline()
        if not line:
            return
        answers.write(json.dumps(answer(line)) + "\n")
        answers.flush()


def _write(out: str, data: bytes) -> None:
    with written_aside(Path(out)) as aside:
        aside.write_bytes(data)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
