"""COLMAP's own reader reads the tracks of the models that we write."""

import numpy as np
import pytest

from gsplat_edu import Camera
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.tracks import MOST_SEEN, visible_points
from gsplat_edu.data.writers import write_colmap, write_model

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed (extra dev)")


@pytest.mark.parametrize("binary", [False, True])
def test_colmap_reads_the_tracks(tmp_path, binary):
    """Points list images and images list points. Each observation lies where COLMAP's camera projects its point."""
    views, points, colors = procedural_capture(24, 6)
    write_colmap(tmp_path, views, points, colors, binary=binary)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert model.num_points3D() == len(points) and model.num_reg_images() == len(views)
    assert model.compute_mean_reprojection_error() < 1e-9
    assert model.compute_num_observations() > len(points)
    found = 0
    for point_id, point in model.points3D.items():
        for element in point.track.elements:
            image = model.image(element.image_id)
            mark = image.points2D[element.point2D_idx]
            assert mark.point3D_id == point_id
            assert np.abs(image.project_point(point.xyz) - mark.xy).max() < 1e-9
            found += 1
    assert found == sum(image.num_points3D for image in model.images.values())
    depths = [image.cam_from_world() * model.point3D(m.point3D_id).xyz
              for image in model.images.values() for m in image.points2D]  # fmt: skip
    assert min(depth[2] for depth in depths) > 0  # gsplat's trainer supervises depth with these


def test_hidden_points_are_not_seen():
    """Of two walls one behind the other, the camera sees the front one and the part of the rear one beside it."""
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-1, 1, 31), np.linspace(-1, 1, 31)))
    front, rear = np.stack([x, y, x * 0 + 2], 1), np.stack([4 * x, 4 * y, x * 0 + 4], 1)
    camera = Camera(np.eye(3), np.zeros(3), 50.0, 50.0, 49.5, 49.5, 100, 100)
    seen = visible_points(camera, np.concatenate([front, rear]))
    assert set(range(961)) <= set(seen.points.tolist())
    behind = seen.points[seen.points >= 961] - 961
    assert len(behind) > 0 and np.all(np.abs(rear[behind, :2]).max(axis=1) > 1.9)


def test_the_number_of_observations_of_a_photo_is_limited(tmp_path):
    points = np.random.default_rng(0).uniform(-1, 1, (9_000, 3)) * (1, 1, 0.01) + (0, 0, 3)
    camera = Camera(np.eye(3), np.zeros(3), 50.0, 50.0, 49.5, 49.5, 100, 100)
    seen = visible_points(camera, points)
    assert len(seen.points) == MOST_SEEN == len(np.unique(seen.points))
    write_model(tmp_path, [("a.png", camera)], np.zeros((0, 3)), np.zeros((0, 3)))
    assert pycolmap.Reconstruction(str(tmp_path / "sparse" / "0")).num_points3D() == 0
