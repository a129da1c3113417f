"""Captures of the textured room through a lens, as COLMAP writes them: a fisheye of 180 degrees, or panoramas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

import panorama_room
from gsplat_edu import Camera, look_at
from gsplat_edu.scene.projection import Distortion, Projection

FISHEYE = Projection("fisheye", Distortion.of(k1=-0.01, k2=0.004, k3=-0.002, k4=0.0003))


def room_cameras(projection: Projection, count: int = 16, side: int = 96) -> list[Camera]:
    """Return cameras on the walk through the room that look around."""
    cameras = []
    for i, eye in enumerate(panorama_room.walk(count)):
        angle = 2.4 * i
        target = eye + np.array([np.sin(angle), 0.2 * np.sin(1.7 * i), np.cos(angle)])
        R = look_at(eye, target)
        if projection.kind == "equirectangular":
            cameras.append(Camera.panorama(R, eye, side, 2 * side))
        else:
            focal, middle = side / np.pi, (side - 1) / 2
            cameras.append(Camera(R, eye, focal, focal, middle, middle, side, side).through(projection))
    return cameras


def room_photo(camera: Camera) -> np.ndarray:
    """Return the photo of a camera, averaged over four rays a pixel; black where it has none."""
    fine = camera.scaled(2 * camera.W, 2 * camera.H)
    rays = fine.rays()
    seen = np.isfinite(rays).all(axis=-1, keepdims=True)
    colours = panorama_room.colours_of(camera.eye, np.where(seen, rays, (0.0, 0.0, 1.0)))
    return panorama_room.averaged(np.where(seen, colours, 0.0))


def write_room(folder: Path, projection: Projection, count: int = 16, side: int = 96) -> list[Camera]:
    """Write a capture; return its cameras."""
    cameras = room_cameras(projection, count, side)
    for name in ("images", "sparse/0"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    lines = []
    for i, camera in enumerate(cameras):
        Image.fromarray(room_photo(camera)).save(folder / "images" / f"r{i:02}.png")
        x, y, z, w = Rotation.from_matrix(camera.R).as_quat()
        t = -camera.R @ camera.eye
        lines.append(f"{i + 1} {w} {x} {y} {z} {t[0]} {t[1]} {t[2]} 1 r{i:02}.png\n\n")
    first = cameras[0]
    if projection.kind == "equirectangular":
        model = f"1 EQUIRECTANGULAR {first.W} {first.H} {first.W} {first.H}\n"
    else:
        k = " ".join(str(value) for value in projection.distortion.coefficients[:4])
        model = f"1 OPENCV_FISHEYE {first.W} {first.H} {first.fx} {first.fy} {first.cx + 0.5} {first.cy + 0.5} {k}\n"
    (folder / "sparse/0/cameras.txt").write_text(model)
    (folder / "sparse/0/images.txt").write_text("".join(lines))
    (folder / "sparse/0/points3D.txt").write_text(_points())
    return cameras


def room_depth(camera: Camera) -> np.ndarray:
    """Return the exact depth of a camera's pixels, in that of its projection; 0 where a pixel has no ray."""
    rays = camera.rays()
    seen = np.isfinite(rays).all(axis=-1)
    return np.where(seen, panorama_room.depths_of(camera.eye, np.where(seen[..., None], rays, 1.0)), 0.0)


def _points(each: int = 400) -> str:
    rng, lines = np.random.default_rng(0), []
    for corner, a, b in panorama_room.rectangles():
        for point in corner + rng.random((each // 4, 1)) * a + rng.random((each // 4, 1)) * b:
            lines.append(f"{len(lines) + 1} {point[0]} {point[1]} {point[2]} 128 128 128 1.0\n")
    return "".join(lines)


def moving_photo(camera: Camera) -> np.ndarray:
    """Return the photo of a camera that moves while its rows are read; one ray a pixel."""
    rays, origins = camera.rays(), camera.origins()
    rows = [panorama_room.colours_of(origins[v, 0], rays[v][None])[0] for v in range(camera.H)]
    return np.round(np.stack(rows)).astype(np.uint8)
