"""The projection and the shutter of a camera as a record in JSON, beside the numbers of a pinhole.

    "projection": {"kind": "fisheye", "k1": -0.01, "radial_first": true},
    "shutter": {"turn": [0, 0.01, 0], "shift": [0, 0, 0], "readout": "down", "exposure": 0.5}

A shutter without "exposure" has no motion blur.
Programs that do not know these keys take the camera for a pinhole of the same focal lengths.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec

from gsplat_edu.base.records import ABSENT, Absent, Number, Record, record_of
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.projection import COEFFICIENTS, PROJECTIONS, Distortion, Projection
from gsplat_edu.scene.shutter import RollingShutter

Coefficient = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Vector = tuple[Number, Number, Number]

_COEFFICIENTS: Any = [(name, Coefficient | Absent, ABSENT) for name in COEFFICIENTS]
_KIND: Any = [("kind", Literal[PROJECTIONS]), ("radial_first", bool, False)]
_Projection = msgspec.defstruct("_Projection", [*_KIND, *_COEFFICIENTS], bases=(Record,), frozen=True)


class _Shutter(Record, frozen=True):
    turn: Vector
    shift: Vector
    readout: str = "down"
    exposure: Number = 0.0


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
    given, moving, projection, shutter = entry.get("projection"), entry.get("shutter"), Projection(), None
    if given is not None:
        lens = record_of("projection", given, _Projection)
        values = {name: c for name in COEFFICIENTS if (c := getattr(lens, name)) is not ABSENT}
        distortion = Distortion.of(radial_first=lens.radial_first, **values) if values else None
        projection = Projection(lens.kind, distortion)
    if moving is not None:
        motion = record_of("shutter", moving, _Shutter)
        shutter = RollingShutter(motion.turn, motion.shift, motion.readout, motion.exposure)
    return camera if given is moving is None else camera.through(projection, shutter)
