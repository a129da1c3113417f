"""Level cameras around the middle of a tilted scene."""

import numpy as np
from scipy.spatial.transform import Rotation

from gsplat_edu.scene.camera import look_at

TILT = Rotation.from_rotvec((0.2, 0.1, -0.35)).as_matrix()
"""From the level world to the scene's."""

UP = TILT @ (0.0, -1.0, 0.0)


def rolled(R, angle):
    """Turn a camera about its line of sight."""
    return Rotation.from_rotvec((0.0, 0.0, angle)).as_matrix() @ R


def around(n, turn=2 * np.pi, height=-0.8, rolls=None):
    """Return cameras in an arc about the middle, looking down a little, in the tilted scene."""
    angles = np.linspace(0, turn, n, endpoint=False)
    rolls = np.zeros(n) if rolls is None else rolls
    found = []
    for angle, roll in zip(angles, rolls, strict=True):
        eye = np.array((3 * np.sin(angle), height, -3 * np.cos(angle)))
        found.append((rolled(look_at(eye, np.zeros(3)), roll) @ TILT.T, TILT @ eye))
    return found
