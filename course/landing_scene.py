"""The scene of the site's landing page: two by two blocks of the procedural city, as flat Gaussians on its surfaces.

    python course/landing_scene.py FOLDER        writes FOLDER/scene.html and FOLDER/scene.jpg

Nothing is trained, so that the site builds in seconds: each face of a box and the ground carry Gaussians on a grid,
with the colours that the ray tracer of `lab/captures/city.py` paints there.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from PIL import Image
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT))

from gsplat_edu.base.constants import C0, SH_OFFSET  # noqa: E402
from gsplat_edu.evaluate.metrics import to_bytes  # noqa: E402
from gsplat_edu.io.scene import Scene  # noqa: E402
from gsplat_edu.render.api import render  # noqa: E402
from gsplat_edu.render.settings import RenderSettings  # noqa: E402
from gsplat_edu.scene.camera import Camera  # noqa: E402
from gsplat_edu.scene.gaussians import Gaussians  # noqa: E402
from gsplat_edu.viewer import page  # noqa: E402
from gsplat_edu.viewer.page_start import Start  # noqa: E402
from lab.captures.city_paint import PITCH, Buildings, facade_colors, ground_colors  # noqa: E402
from lab.captures.outdoors import SUN  # noqa: E402

Rows = Float64[np.ndarray, "N 3"]

SEED = 13
"""Seed of the city."""

WALL_STEP, GROUND_STEP = 0.09, 0.1
"""Distances between Gaussians on boxes and on the ground, world units."""

COVER = 0.65
"""Standard deviation of a Gaussian in steps, so that neighbours leave no gap."""

THIN = 0.004
"""Standard deviation across the surface, world units."""

LOGIT = 4.0
"""Logit of the opacity of every Gaussian."""

SKY = (0.79, 0.86, 0.93)
"""Background of the page and of the still picture."""

EYE, TARGET = (-10.0, -9.6, -13.4), (0.0, -1.3, 0.0)
WIDTH, HEIGHT = 1280, 540
"""Size of the still picture, px."""


def _grid(width: float, height: float, step: float) -> Float64[np.ndarray, "N 4"]:
    """Return places on a rectangle around zero, and the distances between them in both directions."""
    counts = [max(2, round(side / step)) for side in (width, height)]
    steps = width / counts[0], height / counts[1]
    a, b = (step * (np.arange(count) + 0.5 - count / 2) for count, step in zip(counts, steps, strict=True))
    across, up = (axis.ravel() for axis in np.meshgrid(a, b))
    return np.stack([across, up, np.full(across.shape, steps[0]), np.full(across.shape, steps[1])], axis=1)


def _faces(buildings: Buildings, number: int) -> list[tuple[Rows, Rows, Rows]]:
    """Return places, steps (along, up, 0) and rotation rows of the four walls and the roof of a box."""
    (x, z), (half_x, height, half_z), turn = buildings.box(number)
    c, s = np.cos(turn), np.sin(turn)
    own_x, own_z, down = np.array([c, 0, s]), np.array([-s, 0, c]), np.array([0.0, 1.0, 0.0])
    centre = np.array([x, -height / 2, z])
    made = []
    for along, up, outward, width, tall, away in (
        (own_z, down, own_x, 2 * half_z, height, half_x),
        (own_z, down, -own_x, 2 * half_z, height, half_x),
        (own_x, down, own_z, 2 * half_x, height, half_z),
        (own_x, down, -own_z, 2 * half_x, height, half_z),
        (own_x, own_z, -down, 2 * half_x, 2 * half_z, height / 2),
    ):
        a, b, *steps = _grid(width, tall, WALL_STEP).T
        places = centre + away * outward + a[:, None] * along + b[:, None] * up
        axes = np.stack([along, up, np.cross(along, up)], axis=1)
        made.append((places, np.stack([*steps, np.zeros(len(a))], axis=1), axes))
    return made


def town() -> Scene:
    """Return the scene; up is -y."""
    buildings = Buildings.drawn(1, SEED)
    a, b, *steps = _grid(2 * PITCH, 2 * PITCH, GROUND_STEP).T
    flat = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]).T
    places = [np.stack([a, np.zeros(len(a)), b], axis=1)]
    spread, axes = [np.stack([*steps, np.zeros(len(a))], axis=1)], [np.broadcast_to(flat, (len(a), 3, 3))]
    colors = [ground_colors(places[0], buildings) * (0.58 + 0.42 * max(0.0, -SUN[1]))]
    for number in range(len(buildings.places)):
        middle = np.array([*buildings.places[number]])
        for where, size, frame in _faces(buildings, number):
            outward = frame[:, 2].copy()
            offset = where[0] - np.array([middle[0], -buildings.halves[number, 1] / 2, middle[1]])
            outward *= np.sign(offset @ outward)
            owner, normals = np.full(len(where), number), np.broadcast_to(outward, where.shape)
            colors.append(facade_colors(where, normals, owner, buildings, SUN))
            places.append(where)
            spread.append(size)
            axes.append(np.broadcast_to(frame, (len(where), 3, 3)))
    rotations = np.concatenate(axes)
    quats = Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]]
    means, scales = np.concatenate(places), np.maximum(COVER * np.concatenate(spread), THIN)
    sh0 = (np.clip(np.concatenate(colors), 0, 1) - SH_OFFSET) / C0
    return Scene(
        Gaussians(
            means=_tensor(means),
            quats=_tensor(quats),
            log_scales=_tensor(np.log(scales)),
            sh0=_tensor(sh0)[:, None],
            sh_rest=torch.zeros(len(means), 0, 3),
            logit_opacities=torch.full((len(means),), LOGIT),
        ),
        up=(0.0, -1.0, 0.0),
    )


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def write_landing(folder: Path) -> None:
    """Write the page, and the still picture for browsers without scripts.

    Args:
        folder: Where scene.html and scene.jpg go.
    """
    scene, settings = town(), RenderSettings(background=SKY, sh_degree=0)
    camera = Camera.looking_at(EYE, np.array(TARGET), 1.15 * WIDTH, 1.15 * WIDTH, HEIGHT, WIDTH)
    start = Start(camera, np.array(TARGET), np.array([0.0, -1.0, 0.0]), -1)
    page.write(folder / "scene.html", scene, (), settings, tour=page.Tour(start=start))
    with torch.no_grad():
        image = to_bytes(render(scene.gaussians, camera, settings=settings).image)
    Image.fromarray(image).save(folder / "scene.jpg", quality=85)


if __name__ == "__main__":
    made = Path(sys.argv[1])
    write_landing(made)
    for path in sorted(made.glob("scene.*")):
        print(f"{path}: {path.stat().st_size:,} bytes")
