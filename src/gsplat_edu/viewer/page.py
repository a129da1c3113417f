"""Export a scene as one HTML file that any browser with WebGL2 renders offline.

The file contains, in this order: our style, shaders and scripts (`viewer/web`), metadata of the scene as JSON, and the
splats (`viewer/page_data.py`) and meshes (`viewer/page_mesh.py`), compressed with gzip, encoded in base64, and split
into elements that a browser can process one by one. Its Content-Security-Policy allows these scripts by their hashes
and blocks everything external.
"""

from __future__ import annotations

import base64
import gzip
import math
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from gsplat_edu.base import constants
from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import parse_json, read_bytes
from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.io.quantize import check_expansion
from gsplat_edu.io.scene import Scene, read_extras
from gsplat_edu.paths.keyframes import KeyframePath
from gsplat_edu.render.field import BEYOND, LEAST_BEYOND
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.source import NamedCamera, file_settings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.frame import ORIGIN, as_origin
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.rig import stand_in, through_lenses
from gsplat_edu.viewer import page_data, page_mesh
from gsplat_edu.viewer.modules import web
from gsplat_edu.viewer.page_mesh import Meshes
from gsplat_edu.viewer.page_parts import filled
from gsplat_edu.viewer.page_proof import Proof
from gsplat_edu.viewer.page_start import (
    Start,
    contents_of,
    first_camera,
    framed,
    start_among,
    start_of,
    subjects_of,
)

FORMAT = "gsplat-edu page"
VERSION = 1

PIECE = 12 << 20
"""Compressed bytes per element, a multiple of 3 so that the base64 of one element continues in the next."""

FACTS_OPEN, SPLATS_OPEN, VALUES_OPEN, MESHES_OPEN, SEEN_OPEN, PHOTOS_OPEN, CLOSE = (
    b'<script type="application/json" id="facts">',
    b'<script type="application/octet-stream;base64" class="splats">',
    b'<script type="application/octet-stream;base64" class="values">',
    b'<script type="application/octet-stream;base64" class="meshes">',
    b'<script type="application/octet-stream;base64" class="seen">',
    b'<script type="application/octet-stream;base64" class="photos">',
    b"</script>",
)


@dataclass(frozen=True)
class Tour:
    """What a page offers to look at besides the splats: a camera path, views, meshes, and evidence.

    Args:
        path: Keyframes that the page plays, in the coordinates of the page's scene; None for none.
        start: The view in which the page opens; None lets the page choose one.
        views: Named views, listed before those of the capture.
        meshes: Meshes in the coordinates of the page's scene; None for none.
        texts: Texts of named views by their names. Views with a text are the steps of a guided tour.
        proof: How many photos saw each splat, and photos to compare with the picture; None for none.
        poster: A JPEG that is shown until the first picture is drawn; empty for none.
    """

    path: KeyframePath | None = None
    start: Start | None = None
    views: Sequence[NamedCamera] = ()
    meshes: Meshes | None = None
    texts: Mapping[str, str] = field(default_factory=dict)
    proof: Proof | None = None
    poster: bytes = b""


@dataclass(frozen=True, eq=False)
class Editing:
    """What a page needs to edit its scene; see `gsplat_edu.viewer.edit_page`.

    Args:
        facts: The scene's identity, the operations so far, and the commands that apply them.
        values: The exact parameters that the page's splats lack, little-endian float32: sh0, then logit_opacities.
    """

    facts: dict[str, Any]
    values: bytes


def write(
    path: Path,
    scene: Scene,
    views: Sequence[NamedCamera] = (),
    settings: RenderSettings | None = None,
    held_out: Collection[str] = (),
    tour: Tour | None = None,
) -> None:
    """Write the page; its title is the file's name without the suffix.

    Args:
        path: Output file; parent folders are created.
        scene: The scene; it may be empty.
        views: Name and camera of each viewpoint. The page numbers them, starts at the first one that was not held out,
            and contains no names.
        settings: Render settings; None takes those of scene files (`gsplat_edu.runs.source.file_settings`).
        held_out: Names of the test views, which are marked in the list.
        tour: The camera path to play, and meshes; None for neither.

    Raises:
        ArgumentError: a parameter is NaN or infinite.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    pieces = _shared(path.stem, scene, views, settings, held_out, tour or Tour())
    with written_aside(path) as aside, aside.open("wb") as file:
        file.writelines(pieces)


def shared(
    title: str,
    scene: Scene,
    views: Sequence[NamedCamera],
    settings: RenderSettings | None,
    held_out: Collection[str],
    tour: Tour,
) -> bytes:
    """Return the bytes of a page that `write` writes.

    Args:
        title: Heading of the page.
        scene: As for `write`.
        views: As for `write`.
        settings: As for `write`.
        held_out: As for `write`.
        tour: As for `write`.

    Raises:
        ArgumentError: a parameter is NaN or infinite.
    """
    return b"".join(_shared(title, scene, views, settings, held_out, tour))


def _shared(
    title: str,
    scene: Scene,
    views: Sequence[NamedCamera],
    settings: RenderSettings | None,
    held_out: Collection[str],
    tour: Tour,
) -> Iterator[bytes]:
    """Yield a page to pass on: the names of files tell a visitor nothing."""
    shown = [(f"photo {i}", camera) for i, (_, camera) in enumerate(views, start=1)]
    out = {f"photo {i}" for i, (name, _) in enumerate(views, start=1) if name in held_out}
    return _pieces(title, scene, shown, settings, out, tour, {"shared": True})


def html(
    scene: Scene,
    views: Sequence[NamedCamera] = (),
    settings: RenderSettings | None = None,
    title: str = "scene",
    held_out: Collection[str] = (),
    tour: Tour | None = None,
    editing: Editing | None = None,
    pictures: str = "",
) -> bytes:
    """Return the page's bytes.

    Args:
        scene: As for `write`.
        views: As for `write`.
        settings: As for `write`.
        title: Heading of the page.
        held_out: As for `write`.
        tour: As for `write`.
        editing: Makes it a page with the editor.
        pictures: Relative URL at which its server renders for browsers without WebGL2; empty if it does not.

    Raises:
        ArgumentError: a parameter is NaN or infinite.
    """
    more: dict[str, Any] = {} if editing is None else {"edit": editing.facts}
    more |= {"pictures": pictures} if pictures else {}
    return b"".join(_pieces(title, scene, views, settings, held_out, tour or Tour(), more, editing))


def live_facts(
    title: str,
    views: Sequence[NamedCamera],
    held_out: Collection[str],
    points: Float[np.ndarray, "N 3"],
    settings: RenderSettings,
    origin: ArrayLike = ORIGIN,
) -> dict[str, Any]:
    """Return the facts of a page whose splats come later and change.

    Args:
        title: Heading of the page.
        views: As for `write`; at least one.
        held_out: As for `write`.
        points: (N, 3) points of the scene; may be empty.
        settings: Render settings of the finished scene.
        origin: (3,) position of the page's zero in the capture's coordinates.
    """
    none = Gaussians(*(torch.zeros(0, *shape) for shape in ((3,), (4,), (3,), (1, 3), (0, 3), ())))
    nothing = Scene(none, origin=as_origin("origin", origin))
    facts = _facts(title, nothing, views, settings, held_out, Tour())
    index = facts["start"]["index"]
    start = start_among([camera for _, camera in views], index, points)
    facts["start"] |= {"pivot": start.pivot.tolist(), "up": start.up.tolist()}
    _add_subjects(facts, [camera for _, camera in views], start.camera, points)
    return facts | {"up": start.up.tolist(), "sh_degree": int(settings.sh_degree)}


def live_html(facts: dict[str, Any], step: bool = True) -> bytes:
    """Return a page that shows a training. It contains no splats and asks its server for them.

    Args:
        facts: From `live_facts`.
        step: Whether the server can take a single step.
    """
    head, tail = web("index.html").split("{{splats}}\n")
    nothing = SPLATS_OPEN + base64.b64encode(gzip.compress(b"", mtime=0)) + CLOSE + b"\n"
    begin = filled(head, str(facts["title"]), facts | {"live": {"step": step}})
    return begin.encode("utf-8", errors="replace") + nothing + tail.encode("utf-8")


def levels_html(scene: Scene, levels: dict[str, Any], title: str) -> bytes:
    """Return a page without splats that loads those of a folder with levels of detail from its server.

    Args:
        scene: Any level of the scene, for the first camera and the metadata.
        levels: Description of the regions, for `viewer/web/levels.js`; see `gsplat_edu.viewer.stream`.
        title: Heading of the page.
    """
    facts = _facts(title, scene, (), file_settings(scene), (), Tour()) | {"count": 0, "lod": levels}
    head, tail = web("index.html").split("{{splats}}\n")
    return (filled(head, title, facts) + tail).encode("utf-8", errors="replace")


def read(path: Path) -> Scene:
    """Read the scene from a page: means and scales are exact, the other parameters have the page's precision.

    Args:
        path: The file.

    Raises:
        SceneFormatError: the file is not one of our pages, or it is damaged.
        OSError: the file cannot be read.
    """
    data = read_bytes(path)
    if data.startswith(b"version https://git-lfs"):
        raise SceneFormatError(f"{path}: is a Git LFS pointer, not a page; fetch it with: git lfs pull")
    facts = read_facts(path, data)
    count, sh_degree = facts["count"], facts["sh_degree"]
    claimed = page_data.size(count, sh_degree)
    check_expansion(path, claimed, len(data))
    splats = _inflated(path, data, claimed)
    try:
        frame = read_extras(facts)
    except ValueError as error:
        raise SceneFormatError(f"{path}: {error}; the page is damaged, export it again") from None
    return Scene(page_data.unpacked(path, splats, count, sh_degree), facts["antialiased"], *frame)


def _pieces(
    title: str,
    scene: Scene,
    views: Sequence[NamedCamera],
    settings: RenderSettings | None,
    held_out: Collection[str],
    tour: Tour,
    more: Mapping[str, Any] | None = None,
    editing: Editing | None = None,
) -> Iterator[bytes]:
    """Yield the file in parts, so that they need not be in memory together."""
    scene.gaussians.check_finite()
    facts = _facts(title, scene, views, settings or file_settings(scene), held_out, tour) | _toured(
        tour, scene
    )
    facts["cameras"] = [*facts.pop("views"), *facts["cameras"]]
    facts |= more or {}
    mesh_data = b""
    if tour.meshes is not None:
        facts["meshes"], mesh_data = page_mesh.packed(tour.meshes)
    proof = tour.proof or Proof()
    facts |= proof.facts(len(tour.views))
    head, tail = web("index.html").split("{{splats}}\n")
    begin = filled(head, title, facts, tour.poster)
    yield begin.encode("utf-8", errors="replace")  # a file name may not be valid text
    yield from _elements(SPLATS_OPEN, page_data.packed(scene.gaussians))
    if editing is not None:
        yield from _elements(VALUES_OPEN, editing.values)
    if mesh_data:
        yield from _elements(MESHES_OPEN, mesh_data)
    if proof.seen is not None:
        if len(proof.seen) != len(scene.gaussians):
            raise ArgumentError(
                f"seen: counts {len(proof.seen)} splats, but the scene has {len(scene.gaussians)}"
            )
        yield from _elements(SEEN_OPEN, proof.seen.tobytes())
    if proof.photos:
        yield from _elements(PHOTOS_OPEN, b"".join(photo.jpeg for photo in proof.photos))
    yield tail.encode("utf-8")


def _elements(opening: bytes, data: bytes) -> Iterator[bytes]:
    """Yield compressed bytes as elements."""
    compressed = memoryview(gzip.compress(data, 6, mtime=0))
    for begin in range(0, len(compressed), PIECE):
        yield opening + base64.b64encode(compressed[begin : begin + PIECE]) + CLOSE + b"\n"


def _toured(tour: Tour, scene: Scene) -> dict[str, Any]:
    """Return the facts of a tour that replace those of the scene, and its views."""
    cameras = [camera for _, camera in tour.views]
    chosen = contents_of([*cameras, *([tour.start.camera] if tour.start else [])], _opaque(scene))
    views = [
        {
            "name": name,
            "held_out": False,
            "saved": True,
            **({"text": tour.texts[name]} if tour.texts.get(name) else {}),
            **_camera(camera),
            "subject": content,
        }
        for (name, camera), content in zip(tour.views, chosen, strict=False)
    ]
    if tour.start is None:
        return {"views": views}
    start = _start(tour.start)
    start["camera"]["subject"] = chosen[-1]
    return {"views": views, "start": start}


def _facts(
    title: str,
    scene: Scene,
    views: Sequence[NamedCamera],
    settings: RenderSettings,
    held_out: Collection[str],
    tour: Tour,
) -> dict[str, Any]:
    lenses = through_lenses(camera for _, camera in views)
    views = [(name, stand_in(camera)) for name, camera in views]  # the page draws pinholes
    cameras = [camera for _, camera in views]
    start = usual_start(scene, views, held_out)
    facts = {
        "format": FORMAT,
        "version": VERSION,
        "title": title,
        "count": len(scene.gaussians),
        "sh_degree": scene.gaussians.sh_degree,
        "antialiased": scene.antialiased,
        "up": None if scene.up is None else [float(x) for x in scene.up],
        "settings": {
            "background": [float(x) for x in settings.background],
            "sh_degree": int(settings.sh_degree),
            "antialiased": bool(settings.antialiased),
            "jacobian_limit": None if settings.jacobian_limit is None else float(settings.jacobian_limit),
            "beyond": [BEYOND, LEAST_BEYOND] if lenses else None,
        },
        "near": constants.Z_NEAR,
        "start": _start(start) | {"index": start.index + (len(tour.views) if start.index >= 0 else 0)},
        "unit": scene.unit,
        "origin": [float(x) for x in scene.origin],
        "path": None if tour.path is None else tour.path.document(),
        "cameras": [
            {"name": name, "held_out": name in held_out, **_camera(camera)} for name, camera in views
        ],
    }
    _add_subjects(facts, cameras, start.camera, _opaque(scene))
    return facts


def usual_start(scene: Scene, views: Sequence[NamedCamera], held_out: Collection[str]) -> Start:
    """Return the view in which a page opens unless its tour has one.

    Args:
        scene: As for `write`.
        views: As for `write`.
        held_out: As for `write`.
    """
    cameras = [stand_in(camera) for _, camera in views]
    trained = [i for i, (name, _) in enumerate(views) if name not in held_out]
    return start_of(scene, cameras, first_camera(cameras, trained or range(len(views))) if views else 0)


def cover_view(
    scene: Scene,
    views: Sequence[NamedCamera],
    held_out: Collection[str],
    chosen: Start | None,
    size: tuple[int, int],
) -> Camera:
    """Return the view for a small picture of a scene: the start view, fitted to what it shows.

    Args:
        scene: As for `write`.
        views: As for `write`.
        held_out: As for `write`.
        chosen: The start view that somebody has chosen; None if nobody has.
        size: Width and height of the picture, px.
    """
    if chosen is not None:
        (content,) = contents_of([chosen.camera], _opaque(scene))
        return framed(chosen.camera, content, *size)
    camera = usual_start(scene, views, held_out).camera
    cameras = [stand_in(one) for _, one in views]
    (subject,) = subjects_of(cameras, [camera], _opaque(scene))
    return framed(camera, subject, *size)


def _opaque(scene: Scene) -> Float[np.ndarray, "N 3"]:
    """Return the centres of the splats whose opacity exceeds a half."""
    gaussians = scene.gaussians
    means: Float[np.ndarray, "N 3"] = (
        gaussians.means[gaussians.logit_opacities > 0].double().numpy(force=True)
    )
    return means


def _add_subjects(
    facts: dict[str, Any], cameras: Sequence[Camera], first: Camera, points: Float[np.ndarray, "N 3"]
) -> None:
    """Add the position of the subject in the images of the capture and of the start view."""
    *others, start = subjects_of(cameras, [*cameras, first], points)
    facts["start"]["camera"]["subject"] = start
    for entry, subject in zip(facts["cameras"], others, strict=True):
        entry["subject"] = subject


def _start(start: Start) -> dict[str, Any]:
    return {
        "camera": _camera(start.camera),
        "pivot": start.pivot.tolist(),
        "up": start.up.tolist(),
        "index": start.index,
    }


def _camera(camera: Camera) -> dict[str, Any]:
    numbers = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "H", "W")}
    return {"R": camera.R.tolist(), "eye": camera.eye.tolist(), **numbers}


def read_facts(path: Path, data: bytes) -> dict[str, Any]:
    """Return a page's metadata; the entries that `read` uses are validated."""
    begin = data.find(FACTS_OPEN) + len(FACTS_OPEN)
    end = data.find(CLOSE, begin)
    if begin < len(FACTS_OPEN) or end < 0:
        raise SceneFormatError(
            f"{path}: is not a page of this package, or is truncated; export the page again"
        )
    try:
        facts = parse_json(data[begin:end])
    except ValueError:
        facts = None
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        raise SceneFormatError(f"{path}: the metadata is damaged; export the page again")
    if facts.get("version") != VERSION:
        raise SceneFormatError(
            f"{path}: has page version {facts.get('version')!r}, but {VERSION} is supported; export the page again"
        )
    count, degree, antialiased, up = (
        facts.get(name, "missing") for name in ("count", "sh_degree", "antialiased", "up")
    )
    for name, fits in {
        "count": type(count) is int and count >= 0,
        "sh_degree": type(degree) is int and 0 <= degree <= constants.SH_MAX_DEGREE,
        "antialiased": antialiased is None or isinstance(antialiased, bool),
        "up": up is None or _is_direction(up),
    }.items():
        if not fits:
            raise SceneFormatError(f"{path}: metadata '{name}' is missing or invalid; export the page again")
    return facts


def _is_direction(value: object) -> bool:
    if not (isinstance(value, list) and len(value) == 3 and all(type(x) in (int, float) for x in value)):
        return False
    return all(abs(x) <= 1.001 for x in value) and abs(math.hypot(*value) - 1.0) < 1e-3


def _inflated(path: Path, data: bytes, size: int) -> bytes:
    """Decompress the splats; fail unless they have exactly the expected number of bytes."""
    inflater = zlib.decompressobj(wbits=31)
    pieces = []
    room = size + 1  # one extra byte reveals surplus data; zlib treats 0 as no limit
    begin = data.find(SPLATS_OPEN)
    try:
        while begin >= 0:
            begin += len(SPLATS_OPEN)
            end = data.find(CLOSE, begin)
            packed = base64.b64decode(memoryview(data)[begin : end if end >= 0 else len(data)], validate=True)
            while packed and room:
                piece = inflater.decompress(packed, room)
                pieces.append(piece)
                room -= len(piece)
                packed = inflater.unconsumed_tail
            begin = data.find(SPLATS_OPEN, begin)
    except (zlib.error, ValueError):  # binascii's error is a ValueError
        raise SceneFormatError(f"{path}: the splats are damaged; export the page again") from None
    if room != 1 or not inflater.eof:
        raise SceneFormatError(f"{path}: the splats are truncated or damaged; export the page again")
    return b"".join(pieces)
