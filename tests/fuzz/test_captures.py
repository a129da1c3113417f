"""Damaged captures are loaded with finite cameras and points and readable photos, or refused in one line."""

import tracemalloc

import numpy as np
import pytest

import tiers
from damage import damaged_bytes, damaged_json, damaged_text
from gsplat_edu.base.errors import SplatError
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.scale import Scale, write_scale
from gsplat_edu.data.writers import write_blender, write_colmap, write_transforms
from gsplat_edu.scene.views import View

pytestmark = pytest.mark.fuzz

CAPTURES = tiers.count("GSPLAT_EDU_FUZZ_CAPTURES", 40, 3_000)
"""Damaged captures per file."""

SEEDS = range(tiers.SEED, tiers.SEED + CAPTURES)

MOST_MEMORY = 32 << 20
"""Largest memory that reading may take, bytes; the captures have less than 20 KiB. Photos are excluded, because
Pillow allocates as much as a chunk of a PNG declares, up to 4 GiB, although it never touches most of it."""

LENS = {"k1": 0.01, "k2": 0.001, "p1": 0.001, "p2": -0.001, "camera_model": "OPENCV", "aabb_scale": 4}

FILES = {
    "transforms": ("transforms.json", "points.ply", "images/view_000.png"),
    "blender": ("transforms_train.json", "transforms_test.json", "train/view_000.png"),
    "colmap": ("sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin", "scale.json"),
    "text": (
        "sparse/0/cameras.txt",
        "sparse/0/images.txt",
        "sparse/0/points3D.txt",
        "masks/view_000.png.png",
    ),
}


def written(folder, layout):
    """Write a small capture, with masks in the layouts that have them."""
    views, points, colors = procedural_capture(12, 3, splats=30)
    if layout == "blender":
        write_blender(folder, views[:2], views[2:])
        return
    hole = np.ones((views[0].camera.H, views[0].camera.W), dtype=bool)
    hole[3:5, 2:7] = False
    marked = []
    for i, view in enumerate(views):
        mask = hole if i % 2 == 0 else None
        marked.append(View(view.camera, view.read().image, mask=mask, name=view.name))
    if layout == "transforms":
        write_transforms(folder, marked, points, colors, extra=LENS)
        return
    write_colmap(folder, marked, points, colors, binary=layout == "colmap")
    write_scale(folder, Scale("m", "GPS", "from a test"))


def damaged(name, data, rng):
    if name.endswith(".json"):
        return damaged_json(data, rng)
    return damaged_text(data, rng) if name.endswith(".txt") else damaged_bytes(data, rng)


def load(folder, seed):
    """Load a capture and its photos; return whether that succeeded."""
    try:
        dataset = load_dataset(folder, DataSettings())
        assert np.isfinite(dataset.points).all() and np.isfinite(dataset.colors).all(), seed
        for view in (*dataset.train, *dataset.test):
            camera = view.camera
            assert np.isfinite([*camera.eye, *camera.R.ravel(), camera.fx, camera.fy]).all(), seed
            assert view.read().image.shape == (camera.H, camera.W, 3), seed
    except SplatError as error:
        message = str(error)
        assert "\n" not in message, seed
        return False
    return True


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(("layout", "name"), [(layout, name) for layout in FILES for name in FILES[layout]])
def test_damaged_captures(tmp_path, layout, name):
    written(tmp_path, layout)
    path = tmp_path / name
    whole, loaded = path.read_bytes(), 0
    assert load(tmp_path, "whole")
    for seed in SEEDS:
        path.write_bytes(damaged(name, whole, np.random.default_rng(seed)))
        tracemalloc.start()
        try:
            loaded += load(tmp_path, seed)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert peak < MOST_MEMORY or name.endswith(".png"), f"seed {seed}: {peak:,} bytes"
    assert loaded < CAPTURES, "no damage was refused"
