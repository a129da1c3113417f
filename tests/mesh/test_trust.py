"""How far a mesh can be trusted: on a plane whose depth maps are known."""

import numpy as np
import pytest

from gsplat_edu import Camera
from gsplat_edu.evaluate.surface import Comparison, score_surface
from gsplat_edu.mesh.depths import DepthCounts, DepthView
from gsplat_edu.mesh.extract import MeshResult
from gsplat_edu.mesh.trust import seen_by, seen_truth, trust_of
from gsplat_edu.scene.mesh import Mesh

CAMERA = Camera(np.eye(3), (0, 0, -2), 32, 32, 20, 20, 41, 41)
SQUARE = Mesh(
    np.array([[-1.0, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0], [9, 9, 0]]), np.array([[0, 1, 2], [1, 3, 2]])
)


def view(depth, name="view"):
    plane = np.full((41, 41), depth, dtype=np.float32)
    nothing = np.zeros((41, 41))
    return DepthView(
        name, CAMERA, plane, np.full((41, 41), 255, np.uint8), np.zeros((41, 41, 3), np.uint8), nothing > 0, 0
    )


def made(views):
    counts = DepthCounts(1, 0, 0, 0, 0, 0.0)
    return MeshResult(SQUARE, 0.1, 0.3, 1, counts, views, ())


def test_views_are_counted_and_their_distances_averaged():
    seen = seen_by(SQUARE, [view(2.0), view(2.2), view(1.9), view(2.5), view(0.0)], 0.3)
    assert seen.views.tolist() == [3, 3, 3, 3, 0]
    np.testing.assert_allclose(seen.error[:4], 0.1, rtol=1e-6)
    assert np.isinf(seen.error[4])


def test_shares_are_of_the_area():
    """A map without the lower half shows two of four vertices, which have half of the area."""
    half = view(2.0)
    half.depth[21:] = 0
    trust = trust_of(made([view(2.0), view(2.1), half]), [])
    assert trust.certain == pytest.approx(0.5) and trust.held_out is None and trust.scores is None
    assert trust.spread == pytest.approx((0.05 + 0.1 / 3) / 2, rel=1e-5)
    assert trust.shape.boundary_edges == 4 and trust.intersections.found == 0


def test_held_out_depths_within_a_voxel():
    agreeing, differing = view(2.05), view(2.15)
    for one in (agreeing, differing):
        one.depth[:5] = one.depth[36:] = one.depth[:, :5] = one.depth[:, 36:] = 0  # beside the square
    assert trust_of(made([view(2.0)]), [agreeing, differing]).held_out.within == 0.5
    assert trust_of(made([view(2.0)]), [view(0.0)]).held_out is None


def test_only_what_the_cameras_see_of_the_truth_counts():
    """A square, a smaller one 0.5 behind it, and one beside the image; the camera is 2 in front of the first."""
    behind = 0.5 * SQUARE.vertices[:4] + [0, 0, 0.5]
    beside = SQUARE.vertices[:4] + np.array([5.0, 0, 0])
    vertices = np.concatenate([SQUARE.vertices[:4], behind, beside])
    faces = np.concatenate([SQUARE.faces + 4 * i for i in range(3)])
    origin = (100.0, 20.0, -7.0)
    counts = seen_truth(Mesh(vertices + origin, faces), [view(2.0)], 0.1, origin)
    points = np.array([[0.3, 0.2, 0.0], [0.3, 0.2, 0.5], [5.2, 0.1, 0.0], [0.3, 0.2, 0.05], [-0.9, 0.9, 0.0]])
    assert counts(points + origin).tolist() == [True, False, False, True, True]


def test_recall_leaves_out_what_no_camera_sees():
    """A mesh of the front of a box is complete: the camera sees one of its two parallel sides."""
    back = SQUARE.vertices[:4] + np.array([0.0, 0, 1])
    truth = Mesh(
        np.concatenate([SQUARE.vertices[:4], back]), np.concatenate([SQUARE.faces, SQUARE.faces + 4])
    )
    all_of_it = score_surface(SQUARE, truth, Comparison(0.1, samples=2_000))
    seen = score_surface(
        SQUARE, truth, Comparison(0.1, samples=2_000), seen_truth(truth, [view(2.0)], 0.1)
    ).distances
    assert all_of_it.distances.recall == 0.5 and seen.recall == 1.0 and seen.counted == 0.5
