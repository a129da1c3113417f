"""Agisoft Metashape's cameras as XML.

A camera's `transform` takes camera to chunk coordinates, OpenCV axes; the transform of its component, or of the chunk,
takes them to the world: X = s R x + t. If the chunk's reference system is one of WGS 84, this world is earth-centred,
and the poses become metres east, north and up of the mean camera. With x and y of a ray, of a fisheye times theta / r,
and d = 1 + k1 r² + ... + k4 r⁸:

x' = d x + p1 (r² + 2 x²) + 2 p2 x y,   y' = d y + p2 (r² + 2 y²) + 2 p1 x y
u = W / 2 + cx + (f + b1) x' + b2 y',   v = H / 2 + cy + f y'

So p1 and p2 are OpenCV's p2 and p1. The centre of the first pixel is (0.5, 0.5).

Source: Agisoft Metashape's user manual, appendix "Camera models".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import printable, shortened, whole_of
from gsplat_edu.data.lens import MAX_SIDE, PINHOLE_LIKE, Lens
from gsplat_edu.data.notes import OtherReconstructions
from gsplat_edu.data.readers.pose_file import (
    AGAIN,
    PoseProgram,
    Poses,
    Shot,
    no_lens,
    numbers_of,
    panorama,
    sized,
    xml_of,
)
from gsplat_edu.scene.earth import NEAR_SURFACE, Earth, geodetic, local_axes

MODEL_OF = {"frame": PINHOLE_LIKE, "fisheye": "thin prism fisheye"}
"""Our models of Metashape's types of sensors, except for spherical ones."""

NUMBERS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
"""Numbers of a calibration that are read; missing ones are zero."""

UNDISTORT = "export undistorted photos (Export > Undistort Photos), or calibrate without it"


WGS84 = ("World Geodetic System 1984", "WGS_1984", "WGS 84")
"""Names of the datum in well-known text."""


class World(NamedTuple):
    """A transform from chunk to world coordinates: X = scale R x + t."""

    scale: float
    R: Float64[np.ndarray, "3 3"]
    t: Float64[np.ndarray, "3"]


AS_IS = World(1.0, np.eye(3), np.zeros(3))


def holds(path: Path, head: bytes) -> bool:
    """Return whether a file is an export of cameras."""
    return path.suffix.lower() == ".xml" and b"<document" in head and b"<chunk" in head


def read(path: Path) -> Poses:
    """Read the chunk with the most posed cameras.

    Raises:
        DatasetError: the file is damaged, or no camera has a pose.
    """
    chunks = [each for each in xml_of(path).iter("chunk") if each.find("cameras") is not None]
    counts = [len(chunk.findall("cameras//camera/transform")) for chunk in chunks]
    if not any(counts):
        raise DatasetError(
            f"{path}: has no posed camera; align the photos, then File > Export > Export Cameras"
        )
    most = counts.index(max(counts))
    others = tuple(count for number, count in enumerate(counts) if number != most)
    notes = (OtherReconstructions(path, counts[most], others),) if others else ()
    chunk = chunks[most]
    sensors = {each.get("id"): each for each in chunk.findall("sensors/sensor")}
    lenses = {key: _lens(f"{path}, sensor {key}", each) for key, each in sensors.items()}
    parts = {each.get("id"): each for each in chunk.findall("components/component")}
    worlds = {key: _world(f"{path}, component {key}", each) for key, each in parts.items()}
    whole = _world(f"{path}, chunk", chunk)
    shots, without = [], list[tuple[str, str]]()
    for camera in chunk.iterfind("cameras//camera"):
        name = camera.get("label") or ""
        where = f"{path}, camera {shortened(printable(name))}"
        transform = camera.find("transform")
        if transform is None:
            if (reason := _why(camera)) is not None:
                without.append((name, reason))
            continue
        world = worlds.get(camera.get("component_id")) or whole
        lens = lenses.get(camera.get("sensor_id")) or no_lens("its sensor is not in the file")
        shots.append(_shot(where, name, transform, world or AS_IS, lens))
    shots, earth = _on_earth(shots) if _is_on_earth(chunk) else (shots, None)
    return Poses(path, shots, None, notes, tuple(without), earth)


def _is_on_earth(chunk: Element) -> bool:
    """Return whether a chunk has a reference system, geographic or projected, of WGS 84."""
    system = chunk.findtext("reference") or ""
    return not system.startswith("LOCAL_CS") and any(name in system for name in WGS84)


def _on_earth(shots: list[Shot]) -> tuple[list[Shot], Earth | None]:
    """Take shots from earth-centred axes to east, north and up of their middle; far from the surface, as they are."""
    middle = np.mean([shot.eye for shot in shots], axis=0)
    latitude, longitude, height = geodetic(middle)
    if abs(height) > NEAR_SURFACE:
        return shots, None
    axes = local_axes(latitude, longitude)
    moved = [replace(shot, R=shot.R @ axes.T, eye=axes @ (shot.eye - middle)) for shot in shots]
    return moved, Earth.of(axes.T, middle)


def _why(camera: Element) -> str | None:
    """Return why a camera without a transform has none, if that is not just that it could not be aligned."""
    if (master := camera.get("master_id")) is None or master == camera.get("id"):
        return None
    return "it is a slave of a rig, for which Metashape exports no pose; export the cameras as COLMAP"


def _shot(where: str, name: str, transform: Element, world: World, lens: Callable[[Path], Lens]) -> Shot:
    pose = numbers_of(f"{where}, transform", transform.text, 16).reshape(4, 4)
    R = (world.R @ pose[:3, :3]).T
    return Shot(name, R, world.scale * world.R @ pose[:3, 3] + world.t, lens)


def _world(where: str, owner: Element) -> World | None:
    """Read the transform of a component or chunk; None if it has none. Its parts are 1, 0 and 1 if they are missing."""
    element = owner.find("transform")
    if element is None:
        return None

    def part(tag: str, missing: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        found = element.find(tag)
        return missing if found is None else numbers_of(f"{where}, {tag}", found.text, len(missing))

    R = part("rotation", np.eye(3).ravel()).reshape(3, 3)
    scale = float(part("scale", np.ones(1))[0])
    if scale <= 0:
        raise DatasetError(f"{where}, scale: is {scale:g}, but has to be positive; {AGAIN}")
    return World(scale, R, part("translation", np.zeros(3)))


def _lens(where: str, sensor: Element) -> Callable[[Path], Lens]:
    kind = sensor.get("type") or "frame"
    size = _size(sensor.find("resolution"))
    if kind == "spherical" and size is not None:
        return panorama(size)
    if kind not in MODEL_OF:
        return no_lens(f"sensors of type {shortened(printable(kind))!r} have no model here; {UNDISTORT}")
    given = sensor.findall("calibration")
    adjusted = [each for each in given if each.get("class") == "adjusted"]
    if size is None or not given:
        return no_lens("its sensor has no resolution or calibration; align the photos and export again")
    calibration = (adjusted or given)[0]
    if (its := calibration.get("type") or kind) != kind:
        return no_lens(f"a calibration of type {shortened(printable(its))!r} has no model here; {UNDISTORT}")
    size = _size(calibration.find("resolution")) or size
    found = {tag: _number(where, calibration, tag) for tag in NUMBERS}
    if found["b2"]:
        return no_lens(f"a lens with b2 (skew) has no model here; {UNDISTORT}")
    if found["k4"] and kind == "frame":
        return no_lens(f"a lens of type frame with k4 has no model here; {UNDISTORT}")
    values = {name: found[name] for name in ("cx", "cy", "k1", "k2", "k3")}
    values |= {"k4": found["k4"]} if kind == "fisheye" else {}
    values |= {"fx": found["f"] + found["b1"], "fy": found["f"], "p1": found["p2"], "p2": found["p1"]}
    return sized(values, size, MODEL_OF[kind])


def _number(where: str, calibration: Element, tag: str) -> float:
    element = calibration.find(tag)
    return 0.0 if element is None else float(numbers_of(f"{where}, {tag}", element.text, 1)[0])


def _size(resolution: Element | None) -> tuple[int, int] | None:
    if resolution is None:
        return None
    W, H = (whole_of(resolution.get(key) or "") or 0 for key in ("width", "height"))
    return (W, H) if 0 < W <= MAX_SIDE and 0 < H <= MAX_SIDE else None


METASHAPE = PoseProgram("Metashape", holds, read)
