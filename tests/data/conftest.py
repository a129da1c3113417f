"""Fixtures for capture tests: a capture on disk, and the real captures if this machine has them."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_blender, write_colmap, write_transforms

WRITERS = {
    "colmap": write_colmap,
    "text": lambda folder, views, points, colors: write_colmap(folder, views, points, colors, binary=False),
    "transforms": write_transforms,
    "blender": lambda folder, views, points, colors: write_blender(folder, views[3:], views[:3]),
}


@pytest.fixture(scope="session")
def truth():
    """24 views of 64x48 with start points and colours."""
    return procedural_capture()


@pytest.fixture(scope="session")
def small():
    """Nine views of 24x18, for tests whose photos need no detail."""
    return procedural_capture(24, 9, splats=60)


@pytest.fixture
def written(tmp_path, small):
    """Write the small capture in a layout; return its folder."""

    def write(layout: str) -> Path:
        folder = tmp_path / layout
        WRITERS[layout](folder, *small)
        return folder

    return write


@pytest.fixture
def real():
    """Return a real capture's folder, or skip the test and name the capture."""

    def find(name: str) -> Path:
        shared = Path(__file__).parents[3] / "shared" / "data"
        folder = Path(os.environ.get("GSPLAT_EDU_DATA", shared)) / name
        if not folder.exists():
            pytest.skip(f"{name} is not on this machine; see GSPLAT_EDU_DATA")
        return folder

    return find


@pytest.fixture
def one_photo(tmp_path):
    """Write a transforms.json with one photo of the given pixels; `values` are its intrinsics."""

    def write(pixels: np.ndarray, **values) -> Path:
        (tmp_path / "images").mkdir(exist_ok=True)
        Image.fromarray(pixels).save(tmp_path / "images" / "a.png")
        H, W = pixels.shape[:2]
        frame = {"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}
        contents = {"w": W, "h": H, "fl_x": float(W), "frames": [frame], **values}
        (tmp_path / "transforms.json").write_text(json.dumps(contents))
        return tmp_path

    return write
