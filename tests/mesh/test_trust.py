"""How far a mesh can be trusted: by known depth maps of a plane, and by photos of a painted ball."""

import numpy as np
import pytest

from gsplat_edu import Camera
from gsplat_edu.evaluate.surface import Comparison, score_surface
from gsplat_edu.mesh.depths import DepthCounts, DepthView
from gsplat_edu.mesh.extract import MeshResult
from gsplat_edu.mesh.trust import photo_agreement, seen_by, seen_truth, trust_of
from gsplat_edu.scene.mesh import Mesh
from gsplat_edu.scene.projection import Projection
from gsplat_edu.scene.views import View
from painted_ball import photo_of_ball

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


VOXEL = 0.03


def ball_mesh(radius=1.0, centre=(0.0, 0.0, 0.0), rows=96):
    """Return a ball of triangles between circles of latitude."""
    v, u = np.meshgrid(np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows), indexing="ij")
    vertices = np.stack([np.sin(v) * np.cos(u), np.cos(v), np.sin(v) * np.sin(u)], axis=-1)
    i = (2 * rows * np.arange(rows)[:, None] + np.arange(2 * rows - 1)).ravel()
    corners = [i, i + 1, i + 2 * rows], [i + 1, i + 2 * rows + 1, i + 2 * rows]
    faces = np.concatenate([np.stack(c, axis=1) for c in corners])
    return Mesh(np.array(centre) + radius * vertices.reshape(-1, 3), faces)


def photo_pairs_of_ball(lens=None, **paint):
    """Return four pairs of photos 0.35 rad apart, around the ball."""

    def taken(angle):
        eye = 3.2 * np.array([np.cos(angle), -0.2, np.sin(angle)])
        camera = Camera.looking_at(eye, (0, 0, 0), 260.0, 260.0, 192, 192)
        camera = camera if lens is None else camera.through(lens)
        return View(camera, photo_of_ball(camera, **paint), name=f"{angle:.2f}")

    return [(taken(angle), taken(angle + 0.35)) for angle in (0.0, 1.6, 3.1, 4.7)]


def test_photos_agree_with_the_true_surface_only():
    """Away from it by four voxels, in any way, and the point that both photos show is another one.

    The eye moves by 0.35 rad, which moves what is 0.12 too near by 0.35 x 0.12 x 260 / 2.2 = 5 px: paint repeats
    every 15 px, and a patch is 7 px wide.
    """
    pairs = photo_pairs_of_ball()
    right = photo_agreement(ball_mesh(), pairs, VOXEL)
    assert right.views == 4 and right.points > 4_000 and right.textured > 0.95 * right.points
    assert right.share > 0.94
    for wrong in (
        ball_mesh(1 + 4 * VOXEL),
        ball_mesh(1 - 4 * VOXEL),
        ball_mesh(1, (0.0, 4 * VOXEL, 4 * VOXEL)),
    ):
        assert photo_agreement(wrong, pairs, VOXEL).share < right.share - 0.3
    near = photo_agreement(ball_mesh(1 + 0.2 * VOXEL), pairs, VOXEL)
    assert near.share > 0.9, "a fifth of a voxel is no fault"


def test_photos_of_a_reflection_do_not_agree_with_the_surface():
    """The paint moves with the eye, as in a mirror, so no surface that the photos show lies on the ball."""
    found = photo_agreement(ball_mesh(), photo_pairs_of_ball(shiny=0.2), VOXEL)
    assert found.textured > 2_000 and found.share < 0.6


def test_photos_without_texture_judge_nothing():
    found = photo_agreement(ball_mesh(0.9), photo_pairs_of_ball(texture=0.0), VOXEL)
    assert found.points > 4_000 and found.textured == 0 and found.share is None


def test_photos_through_a_lens_are_compared_as_others():
    pairs = photo_pairs_of_ball(Projection("fisheye"))[:2]
    right, wrong = (photo_agreement(ball_mesh(r), pairs, VOXEL) for r in (1.0, 1 + 4 * VOXEL))
    assert right.textured >= 100 and right.share > 0.94 and wrong.share < right.share - 0.3


def test_what_the_other_photo_does_not_see_is_not_compared():
    """From the opposite side, two photos of a ball share no point of it."""
    first, second = (photo_pairs_of_ball()[i][0] for i in (0, 2))
    assert photo_agreement(ball_mesh(), [(first, second)], VOXEL).points == 0
