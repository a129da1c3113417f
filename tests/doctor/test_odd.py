"""On unusual captures, the doctor gives advice and prints no NaN or infinity."""

import numpy as np
import pytest

from doctor.rooms import room, with_camera
from gsplat_edu.doctor.diagnosis import advice_lines, diagnosis_lines
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.views import View


def flat(view, W=None, H=None, value=0):
    c = view.camera
    W, H = W or c.W, H or c.H
    camera = Camera(c.R, c.eye, c.fx * W / c.W, c.fy * W / c.W, (W - 1) / 2, (H - 1) / 2, H, W)
    return View(camera, np.full((H, W, 3), value, dtype=np.uint8), name=view.name)


ODD = {
    "two views": lambda views: views[:2],
    "black photos": lambda views: [flat(view) for view in views],
    "white photos": lambda views: [flat(view, value=255) for view in views],
    "photos of one pixel": lambda views: [flat(view, 1, 1, 90) for view in views],
    "photos of one row": lambda views: [flat(view, 40, 1, 90) for view in views],
    "photos of many sizes": lambda views: [flat(v, 20 + i, 15 + 2 * i, 90) for i, v in enumerate(views)],
    "one pose": lambda views: [with_camera(v, R=np.eye(3), eye=(1.0, 2.0, 3.0)) for v in views],
    "one direction": lambda views: [with_camera(v, R=np.eye(3)) for v in views],
    "a huge world": lambda views: [with_camera(v, eye=1e9 * v.camera.eye) for v in views],
    "a tiny world": lambda views: [with_camera(v, eye=1e-9 * v.camera.eye) for v in views],
}

CLOUDS = {
    "no points": lambda points: None,
    "one point": lambda points: points[:1],
    "one place": lambda points: np.tile(points[:1], (50, 1)),
    "unseen": lambda points: np.add(points, (0.0, 1e6, 0.0)),
}


@pytest.mark.parametrize("cloud", CLOUDS)
@pytest.mark.parametrize("odd", ODD)
def test_odd_captures_get_advice(diagnosed, odd, cloud):
    views, points = room("orbit", 96)
    diagnosis = diagnosed(ODD[odd](views[::4]), CLOUDS[cloud](points))
    lines = [*diagnosis_lines(diagnosis), *advice_lines(diagnosis)]
    assert diagnosis.advice and not any(
        "nan" in line.lower().split() or "inf" in line.split() for line in lines
    )
    assert diagnosis.hopeless == (odd == "one pose" or "no parallax" in [f.name for f in diagnosis.findings])
