"""The contents of a scene file: Gaussians, where their coordinates lie, and metadata that some formats store.

Chapter: 07_a_trained_scene.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from gsplat_edu.base.pictures import scene_shower
from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.frame import ORIGIN, UNITS, Vector, as_origin, origin_of
from gsplat_edu.scene.gaussians import Gaussians


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """The contents of a scene file, in this package's axes (+x right, +y down, +z forward).

    Args:
        gaussians: N Gaussians, raw parameters; float32 if read from a file. Their means are relative to the origin.
        antialiased: Whether they were trained for antialiased rendering; None if the file does not say.
        up: The scene's up direction, of length 1; None if unknown.
        unit: What one unit of the coordinates is, "m", "cm" or "mm"; None if unknown.
        origin: Position of the means' zero in the capture's coordinates, double; see `gsplat_edu.scene.frame`.
        earth: Where on earth the coordinates are; None if unknown.
    """

    gaussians: Gaussians
    antialiased: bool | None = None
    up: Vector | None = None
    unit: str | None = None
    origin: Vector = ORIGIN
    earth: Earth | None = None

    def __repr__(self) -> str:
        """Return one line: the Gaussians, and what is known of the coordinates."""
        known = [f"{name}={value!r}" for name, value in extras(self.frame).items()]
        return f"Scene({', '.join([repr(self.gaussians), *known])})"

    def _repr_html_(self) -> str:
        return str(scene_shower().scene_html(self))

    def view(self, height: int = 480) -> object:
        """Return the viewer's page of the scene; `Gaussians.view` has the argument and the errors."""
        page: object = scene_shower().scene_page(self, height)
        return page

    @property
    def frame(self) -> SceneFrame:
        """What is known of its coordinates."""
        return SceneFrame(self.up, self.unit, self.origin, self.earth)

    def relative_to(self, origin: ArrayLike) -> Gaussians:
        """Return the Gaussians with means relative to another origin, computed in double: unchanged if it is the same.

        Args:
            origin: (3,) position of the new zero in the capture's coordinates.

        Raises:
            ShapeError, ArgumentError: as for `gsplat_edu.scene.frame.as_origin`.
        """
        shift = np.subtract(self.origin, as_origin("origin", origin))
        if not shift.any():  # -0.0 + 0.0 would be 0.0
            return self.gaussians
        means = self.gaussians.means
        moved = (means.double() + torch.from_numpy(shift).to(means.device)).to(means.dtype)
        return replace(self.gaussians, means=moved)


class SceneFrame(NamedTuple):
    """What is known of a scene's coordinates, as for `Scene`."""

    up: Vector | None = None
    unit: str | None = None
    origin: Vector = ORIGIN
    earth: Earth | None = None


def split_origin(means: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, "N 3"], Vector]:
    """Split positions into an origin and coordinates that float32 resolves; see `origin_of`.

    Args:
        means: (N, 3) positions of a file without an origin.

    Returns:
        The coordinates, computed in double, and the origin; the positions themselves if it is zero.
    """
    origin = origin_of(means)
    x, y, z = origin.tolist()
    return (means - origin if origin.any() else means), (x, y, z)


def extras(frame: SceneFrame) -> dict[str, Any]:
    """Return what is known of a scene's frame as JSON: "up", "unit", "origin" and "earth", in this package's axes.

    Args:
        frame: The scene's.
    """
    found: dict[str, Any] = {}
    if frame.up is not None:
        found["up"] = [float(x) for x in frame.up]
    if frame.unit is not None:
        found["unit"] = frame.unit
    if frame.origin != ORIGIN:
        found["origin"] = [float(x) for x in frame.origin]
    if frame.earth is not None:
        found["earth"] = str(frame.earth)
    return found


def read_extras(found: object) -> SceneFrame:
    """Return a scene's frame from the JSON that `extras` made.

    Args:
        found: The JSON; what another program stores there counts as unknown.

    Raises:
        ValueError: an origin or a place on earth is none; without it, the scene would lie elsewhere.
    """
    entry: Mapping[str, Any] = found if isinstance(found, dict) else {}
    unit = entry.get("unit")
    origin = ORIGIN if entry.get("origin") is None else as_origin("origin", entry["origin"])
    earth = Earth.parsed(entry.get("earth"))
    return SceneFrame(direction(entry.get("up")), unit if unit in UNITS else None, origin, earth)


def direction(found: object) -> Vector | None:
    """Return three numbers as a direction of length 1; None if they are none."""
    if not (isinstance(found, list | tuple) and len(found) == 3):
        return None
    if not all(isinstance(x, int | float) and not isinstance(x, bool) and abs(x) <= 1e38 for x in found):
        return None
    x, y, z = map(float, found)
    length = float(np.linalg.norm((x, y, z)))
    return (x / length, y / length, z / length) if 0.0 < length < np.inf else None
