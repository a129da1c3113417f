"""The projection and the shutter of a camera as a record in JSON, beside the numbers of a pinhole.

    "projection": {"kind": "fisheye", "k1": -0.01, "radial_first": true},
    "shutter": {"turn": [0, 0.01, 0], "shift": [0, 0, 0], "readout": "down", "exposure": 0.5}

A shutter without "exposure" has no motion blur.
Programs that do not know these keys take the camera for a pinhole of the same focal lengths.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import flag, in_range
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.projection import COEFFICIENTS, Distortion, Projection
from gsplat_edu.scene.shutter import RollingShutter

LARGEST_COEFFICIENT = 1e6
"""Largest magnitude of a coefficient that is read."""


def lens_entry(camera: Camera) -> dict[str, Any]:
    """Return the keys of a camera that is not a pinhole at rest; none for one that is."""
    found: dict[str, Any] = {}
    if not camera.projection.plain:
        found["projection"] = {"kind": camera.projection.kind}
        values = zip(COEFFICIENTS, camera.coefficients or (), strict=camera.coefficients is not None)
        found["projection"] |= {name: c for name, c in values if c or name == "k1"}
        if camera.projection.radial_first:
            found["projection"]["radial_first"] = True
    if (shutter := camera.shutter) is not None:
        found["shutter"] = {
            "turn": shutter.turn.tolist(),
            "shift": shutter.shift.tolist(),
            "readout": shutter.readout,
        }
        if shutter.exposure:
            found["shutter"]["exposure"] = shutter.exposure
    return found


def with_lens(camera: Camera, entry: Mapping[str, Any]) -> Camera:
    """Return a pinhole with the projection and the shutter of a record; null counts as missing.

    Args:
        camera: The pinhole.
        entry: The record, which others may have written.

    Raises:
        ArgumentError: a key or a value is not one that `lens_entry` writes.
    """
    given, moving = entry.get("projection"), entry.get("shutter")
    if given is None and moving is None:
        return camera
    shutter = None
    if moving is not None:
        values = _object("shutter", moving, ("turn", "shift", "readout", "exposure"))
        how = values.get("readout", "down"), values.get("exposure", 0.0)
        shutter = RollingShutter(values["turn"], values["shift"], *how)
    return camera.through(Projection() if given is None else _projection(given), shutter)


def _projection(given: object) -> Projection:
    values = _object("projection", given, ("kind", "radial_first", *COEFFICIENTS))
    coefficients = {
        name: in_range(f"projection.{name}", values[name], -LARGEST_COEFFICIENT, LARGEST_COEFFICIENT)
        for name in COEFFICIENTS
        if name in values
    }
    first = flag("projection.radial_first", values.get("radial_first", False))
    distortion = Distortion.of(radial_first=first, **coefficients) if coefficients else None
    return Projection(values["kind"], distortion)


def _object(name: str, given: object, keys: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise ArgumentError(f"{name}: is not an object")
    if unknown := [key for key in given if key not in keys]:
        raise ArgumentError(f"{name}: has the unknown key {unknown[0]!r}")
    return given
