"""Camera paths of every kind, for both languages."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from gsplat_edu.paths.keyframes import Keyframe, KeyframePath
from gsplat_edu.scene.camera import look_at


def keyframe(eye, target=(0.1, 0.2, 0.3), fov=50.0, time=None):
    return Keyframe(np.array(eye, float), look_at(eye, target), fov, time)


def turned(rotvec, eye=(0.0, 0.0, 0.0), time=None):
    return Keyframe(np.array(eye, float), Rotation.from_rotvec(rotvec).as_matrix().T, 60.0, time)


def around(*times, count=5):
    """Return keyframes around zero at uneven distances, with a changing zoom."""
    eyes = [(0, 0, -4), (0.3, -0.2, -3.8), (2.5, -0.5, -2), (3, 0, 1), (0.5, 0.4, 3.5)]
    times = times or (None,) * count
    return tuple(
        keyframe(e, fov=50.0 - 4 * i, time=t) for i, (e, t) in enumerate(zip(eyes, times, strict=False))
    )


def holding(keyframes, *holds):
    """Return keyframes that rest for these seconds."""
    return tuple(replace(keyframe, hold=hold) for keyframe, hold in zip(keyframes, holds, strict=True))


AROUND = around()
PATHS = {
    "open": KeyframePath(AROUND, False),
    "loop": KeyframePath(AROUND, True),
    "two": KeyframePath(AROUND[:2], False, 3.0),
    "there and back": KeyframePath(AROUND[2:4], True),
    "three": KeyframePath(AROUND[1:4], False),
    "times": KeyframePath(around(1.0, 1.5, 4.0, 4.2, 8.0), False),
    "loop with times": KeyframePath(around(-1.0, 1.5, 4.0, 4.2, 8.0), True, 12.0),
    "equal neighbours": KeyframePath((AROUND[0], *AROUND[:3], AROUND[2], AROUND[0]), True),
    "rest": KeyframePath(
        tuple(turned((0, min(i, 1) * 0.5, 0), (i // 2, 0, 0), float(i)) for i in range(4)), False
    ),
    "all equal": KeyframePath(AROUND[:1] * 3, False),
    "full turn on the spot": KeyframePath(tuple(turned((0, i * 2.0944, 0)) for i in range(3)), True),
    "slow at the ends": KeyframePath(AROUND, False, 7.0, "ends"),
    "slow at every view": KeyframePath((*AROUND[:3], AROUND[2], *AROUND[3:]), False, None, "views"),
    "loop slow at every view": KeyframePath(AROUND, True, None, "views"),
    "times, holds, slow at the ends": KeyframePath(
        holding(around(1.0, 1.6, 4.0, 6.2, 8.0), 0.5, 0.0, 0.0, 0.7, 1.5), False, None, "ends"
    ),
    "loop with times and holds": KeyframePath(
        holding(around(-1.0, 1.5, 4.0, 4.2, 8.0), 0.0, 2.0, 0.0, 0.0, 1.0), True, 12.0, "views"
    ),
    "upside down": KeyframePath(
        tuple(turned((3.0 - i * 0.4, i * 0.7, 0.2), (i, 0, 0)) for i in range(6)), False
    ),
}
