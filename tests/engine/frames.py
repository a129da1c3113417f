"""Scenes of the tests as the engine takes them."""

import numpy as np

from gsplat_edu.engine import frame
from gsplat_edu.engine.view import DeviceView
from gsplat_edu.scene.camera import Camera
from native_scenes import BACKGROUND


def packed(scene):
    parts = (scene.means, scene.quats, scene.log_scales, scene.sh[:, 0], scene.logits[:, None])
    core = np.concatenate(parts, axis=1).astype(np.float32)
    return frame.Scene(core, np.ascontiguousarray(scene.sh[:, 1:], dtype=np.float32))


def view_of(scene, **changes):
    settings = {
        "background": BACKGROUND,
        "sh_degree": 3,
        "antialiased": False,
        "dilation": 0.3,
        "jacobian_limit": None,
        "alpha_max": 0.99,
        "z_near": 0.05,
    }
    return DeviceView(scene.camera, **settings | changes)


def drawn(pool, scene, **changes):
    return frame.draw_frame(pool, packed(scene), view_of(scene, **changes))


def plain_view(H, W):
    camera = Camera(np.eye(3), np.zeros(3), 30.0, 30.0, W / 2, H / 2, H, W)
    return DeviceView(camera, (0.0, 0.0, 0.0), 0, False, 0.3, None, 0.99, 0.01)
