"""What a scene file holds: Gaussians, and the few facts about them that some formats carry along.

Chapter: 07_a_trained_scene.
"""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_edu.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class Scene:
    """Gaussians as a file holds them, in this package's axes (+x right, +y down, +z forward).

    Args:
        gaussians: N Gaussians, raw parameters, float32 where they were read from a file.
        antialiased: Whether they were trained to be drawn with antialiasing; None where the file does not say.
        up: Direction that is up in the scene, of length 1; None where it is not known.
    """

    gaussians: Gaussians
    antialiased: bool | None = None
    up: tuple[float, float, float] | None = None
