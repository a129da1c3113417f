"""The contents of a scene file: Gaussians, and metadata that some formats store.

Chapter: 07_a_trained_scene.
"""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_edu.scene.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class Scene:
    """The contents of a scene file, in this package's axes (+x right, +y down, +z forward).

    Args:
        gaussians: N Gaussians, raw parameters; float32 if read from a file.
        antialiased: Whether they were trained for antialiased rendering; None if the file does not say.
        up: The scene's up direction, of length 1; None if unknown.
        unit: What one unit of the coordinates is, "m", "cm" or "mm"; None if unknown.
    """

    gaussians: Gaussians
    antialiased: bool | None = None
    up: tuple[float, float, float] | None = None
    unit: str | None = None
