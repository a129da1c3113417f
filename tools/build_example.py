"""Trace the photos of the studio's example, a house in a garden, and pack them as a capture.

    python tools/build_example.py

The result, `src/gsplat_edu/studio/example.zip`, is in the repository because tracing takes a minute.
`tests/studio/test_example.py` compares one of its photos with a new one.
"""

from __future__ import annotations

import io
import json
import math
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from gsplat_edu.base.files import written_aside  # noqa: E402
from gsplat_edu.data.writers import write_transforms  # noqa: E402
from gsplat_edu.scene.camera import Camera  # noqa: E402
from gsplat_edu.scene.views import View  # noqa: E402
from lab.captures.garden import garden_camera, photograph_garden  # noqa: E402

EXAMPLE = ROOT / "src" / "gsplat_edu" / "studio" / "example.zip"

PHOTOS, SIZE, QUALITY = 40, (480, 360), 78

HEIGHTS = (0.16, 0.3, 0.46)
"""Elevations of the cameras above the middle of the garden, radians; neighbours differ."""

POINTS = 150
"""Start points from each photo."""


def example_camera(index: int) -> Camera:
    """Return the camera of a photo: they surround the house."""
    return garden_camera(2 * math.pi * index / PHOTOS, HEIGHTS[index % len(HEIGHTS)], SIZE)


def main() -> None:
    """Write the file."""
    generator = np.random.default_rng(0)
    views, points, colors = [], [], []
    for index in range(PHOTOS):
        camera = example_camera(index)
        photo = photograph_garden(camera)
        views.append(View(camera, photo.image, name=f"garden_{index + 1:02d}.png"))
        seen = np.flatnonzero(np.isfinite(photo.points).all(axis=2))
        chosen = generator.choice(seen, POINTS, replace=False)
        points.append(photo.points.reshape(-1, 3)[chosen])
        colors.append(photo.image.reshape(-1, 3)[chosen] / 255.0)
    with tempfile.TemporaryDirectory() as made, written_aside(EXAMPLE) as aside:
        write_transforms(Path(made), views, np.concatenate(points), np.concatenate(colors))
        with zipfile.ZipFile(aside, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as packed:
            for name, data in _files(Path(made), views):
                packed.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data, zipfile.ZIP_DEFLATED)


def _files(capture: Path, views: list[View]) -> list[tuple[str, bytes]]:
    """Return names and contents of the capture's files, with photos as JPEG."""
    transforms = json.loads((capture / "transforms.json").read_text(encoding="utf-8"))
    for frame in transforms["frames"]:
        frame["file_path"] = str(Path(frame["file_path"]).with_suffix(".jpg"))
    found = [
        ("transforms.json", json.dumps(transforms, indent=1).encode()),
        ("points.ply", (capture / "points.ply").read_bytes()),
    ]
    for view in views:
        jpeg = io.BytesIO()
        Image.fromarray(view.read().over((0.0, 0.0, 0.0))).save(jpeg, "JPEG", quality=QUALITY, optimize=True)
        found.append((f"images/{Path(view.name).stem}.jpg", jpeg.getvalue()))
    return found


if __name__ == "__main__":
    main()
