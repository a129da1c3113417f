"""Cameras with other lenses see points where geometry says, and a plan is to scale."""

import math

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.paths.lenses import circle, fisheye, floor_plan, orthographic, panorama
from gsplat_edu.render.maps import render_maps
from gsplat_edu.render.planes import distortion_features, facing_normals
from gsplat_edu.scene.camera import WORLD_UP, Camera
from gsplat_edu.scene.gaussians import Gaussians

UP = (0.0, -1.0, 0.0)


@pytest.fixture
def tilted():
    """A camera that looks to +x and 40 degrees down, and is rolled a little."""
    return Camera.looking_at(
        (1, -2, 3), (2, -2 + math.tan(math.radians(40)), 3), 50, 50, 40, 60, (0.1, -1, 0.1)
    )


def splats(places, scales=0.02, opacity=0.95):
    means = torch.tensor(np.atleast_2d(places), dtype=torch.float64)
    sizes = torch.as_tensor(scales, dtype=torch.float64).expand(len(means), 3)
    return Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(len(means), 1),
        log_scales=sizes.log(),
        logit_opacities=torch.full((len(means),), math.log(opacity / (1 - opacity)), dtype=torch.float64),
        sh0=torch.ones(len(means), 1, 3, dtype=torch.float64),
        sh_rest=torch.zeros(len(means), 0, 3, dtype=torch.float64),
    )


@pytest.mark.parametrize("degrees", [60.0, 180.0, 250.0])
def test_the_rim_of_a_fisheye_is_half_its_field_of_view_from_the_axis(tilted, degrees):
    camera = fisheye(tilted, degrees, 101)
    assert (camera.H, camera.W) == (101, 101) and np.array_equal(camera.eye, tilted.eye)
    half = math.radians(degrees / 2)
    for turn in (0.0, 1.0, 4.0):
        for share in (0.5, 1.0):
            a = share * half
            p = np.array([math.sin(a) * math.cos(turn), math.sin(a) * math.sin(turn), math.cos(a)])
            u, v, depth = camera.project(7 * p)
            radius = 50.5 * share
            np.testing.assert_allclose((u, v), (50 + radius * math.cos(turn), 50 + radius * math.sin(turn)))
            assert depth == pytest.approx(7)
    rays = camera.rays() @ camera.R[2]
    inside = circle(101)
    assert (rays[inside] >= math.cos(half) - 1e-12).all()
    assert not (rays[~inside] > math.cos(half)).any()
    assert inside[50].all() and not inside[0, 0] and inside.mean() == pytest.approx(math.pi / 4, abs=0.01)


@pytest.mark.parametrize("degrees", [0.0, -5.0, 341.0, float("nan")])
def test_a_fisheye_ends_before_the_point_behind_it(tilted, degrees):
    with pytest.raises(ArgumentError, match="^degrees: "):
        fisheye(tilted, degrees, 10)


def test_a_panorama_is_level_and_has_its_middle_where_the_camera_looks(tilted):
    camera = panorama(tilted, UP, 200)
    assert (camera.H, camera.W) == (100, 200) and np.array_equal(camera.eye, tilted.eye)
    np.testing.assert_allclose(camera.R[1], (0, 1, 0), atol=1e-12)
    (u, v, _) = camera.project(camera.world_to_cam(tilted.eye + tilted.R[2]))
    # 40 degrees below the horizon, of 180 in 100 rows
    np.testing.assert_allclose((u, v), (99.5, 49.5 + 40 / 1.8), atol=1e-9)
    straight = Camera.looking_at((0, 0, 0), (0, 1, 0), 50, 50, 40, 60, (1, 0, 0))
    np.testing.assert_allclose(panorama(straight, UP, 200).R[2], (1, 0, 0), atol=1e-12)
    for size in (0, 202):
        with pytest.raises(ArgumentError, match="^size: is"):
            panorama(tilted, UP, size)


def test_an_orthographic_camera_shows_its_depth_as_large_as_the_camera_does(tilted):
    camera = orthographic(tilted, 4.0)
    for x, y in ((0.0, 0.0), (0.7, -0.4)):
        for z in (1.0, 4.0, 9.0):
            flat = camera.project(np.array([x, y, z]))[:2]
            np.testing.assert_allclose(flat, tilted.project(np.array([x, y, 4.0]))[:2])
    with pytest.raises(ArgumentError, match="^depth: "):
        orthographic(tilted, 0.0)


def slab():
    """A floor of 4 x 2, walls' tops 3 above it, at y = 0 and y = -3, and one stray far away and one high above."""
    x, z = np.meshgrid(np.linspace(-2, 2, 81), np.linspace(5, 7, 41))
    floor = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], axis=1)
    ceiling = floor - (0, 3, 0)
    return splats(np.concatenate([floor, ceiling, [[100.0, 0, 6], [0, -50, 6]]]))


def test_a_floor_plan_is_to_scale_and_covers_the_scene_without_strays():
    plan = floor_plan(slab(), UP, 300, 0.05)
    camera = plan.camera
    assert camera.W == 300 and plan.width == pytest.approx(1.2 * 4, rel=0.03)
    assert plan.height == pytest.approx(1.2 * 2, rel=0.05)
    assert plan.top == pytest.approx(3) and plan.cut is None
    # x is to the right, +z is at the top, and a unit is fx px everywhere
    at = np.array([camera.project(camera.world_to_cam(p))[:2] for p in [(0, 0, 6), (1, -2, 6), (1, -1, 6.5)]])
    np.testing.assert_allclose(at[0], ((camera.W - 1) / 2, (camera.H - 1) / 2), atol=1)
    np.testing.assert_allclose(np.diff(at, axis=0), [(camera.fx, 0), (0, -0.5 * camera.fx)], atol=1e-9)
    depth = camera.world_to_cam((0, -50, 6))[2]
    assert 0.05 < depth < 0.06, "the highest splat is just drawn"


def test_a_cut_leaves_out_what_is_higher():
    plan = floor_plan(slab(), UP, 100, 0.05, cut=1.5)
    assert plan.cut == 1.5 and plan.top == pytest.approx(3)
    ys = np.array([0.0, -1.4, -1.6, -3.0])
    depths = plan.camera.world_to_cam(np.stack([0 * ys, ys, 6 + 0 * ys], axis=1))[:, 2]
    assert ((depths > 0.05) == (ys > -1.5)).all()
    assert floor_plan(slab(), UP, 100, 0.05, cut=1e3).cut is None


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 0.0, 2.0), (0.0, 0.6, -0.8), (1.0, 0.0, 0.0)])
def test_a_plan_looks_down_along_any_up_direction(up):
    camera = floor_plan(slab(), up, 64, 0.05).camera
    np.testing.assert_allclose(camera.R[2], -np.array(up) / np.linalg.norm(up), atol=1e-12)
    north = np.array([0, 0, 1.0]) if abs(up[2]) < 1 else np.array([1.0, 0, 0])
    assert -camera.R[1] @ north > 0.5 and abs(camera.R[0] @ north) < 1e-9


def test_a_single_splat_has_a_plan_and_none_has_none():
    plan = floor_plan(splats([(1.0, 2.0, 3.0)], scales=0.5), UP, 30, 0.05)
    assert (plan.camera.W, plan.camera.H) == (30, 30) and plan.width == pytest.approx(3)
    with pytest.raises(ArgumentError, match="nothing to look at"):
        floor_plan(splats(np.zeros((0, 3))), UP, 30, 0.05)


def test_a_distant_shell_does_not_shrink_a_plan():
    rng = np.random.default_rng(0)
    sky = rng.normal(size=(400, 3))
    sky *= 300 / np.linalg.norm(sky, axis=1, keepdims=True)
    room = rng.uniform(-1, 1, (2000, 3))
    alone, under = (floor_plan(splats(p), UP, 64, 0.05) for p in (room, np.concatenate([room, sky])))
    assert under.width == pytest.approx(alone.width) and under.top == pytest.approx(alone.top)


def test_the_surroundings_of_a_subject_do_not_shrink_its_plan():
    """A tenth of the opacity lies up to 50 units away, as behind the subject of an outdoor capture."""
    rng = np.random.default_rng(0)
    subject, around = rng.uniform(-1, 1, (1800, 3)), rng.uniform(-50, 50, (200, 3))
    plan = floor_plan(splats(np.concatenate([subject, around])), UP, 64, 0.05)
    # the quartiles are near -0.5 and 0.5, and the fences 1.5 beyond them
    assert 1.2 * 3.5 < plan.width < 1.2 * 5


def test_maps_follow_the_depth_of_the_lens():
    """A disc in a plane, seen obliquely: planar depth along a fisheye's ray and a panorama's is the distance."""
    board = splats([(1.5, 0.3, 1.0)], scales=torch.tensor([[0.4, 0.4, 1e-3]]), opacity=0.99)
    pinhole = Camera.looking_at((0, 0, 0), (1.5, 0.3, 1.0), 50, 50, 40, 60)
    for camera in (fisheye(pinhole, 120, 90), panorama(pinhole, WORLD_UP, 240)):
        maps, _ = render_maps(board, camera, ["planar-depth", "normal", "alpha"])
        seen = maps["alpha"] > 0.5
        rays = torch.from_numpy(camera.rays())[seen]
        assert seen.sum() > 50 and torch.allclose(rays.norm(dim=1), torch.ones(1, dtype=torch.float64))
        places = rays * maps["planar-depth"][seen][:, None].double()
        assert torch.allclose(places[:, 2], torch.ones(1, dtype=torch.float64), atol=1e-9)
        assert torch.allclose(maps["normal"][seen], torch.tensor([0.0, 0, -1.0], dtype=torch.float64))
        features = distortion_features(splats([(0, 0, 4.0), (3.0, 0, 4.0), (0, 0, -2.0)]), camera)
        assert torch.allclose(features[:, 0], torch.tensor([0.0, 1.0, -2.0], dtype=torch.float64))


def test_normals_face_an_orthographic_camera_however_far_aside_they_are():
    """The normal of a disc at the side is turned towards the direction of view, not towards the camera's centre."""
    tilt = math.radians(10)  # about z: towards the centre's side it would be turned the other way
    disc = splats([(8.0, 1.0, 0.0)], scales=torch.tensor([[0.4, 1e-3, 0.4]]))
    disc.quats[0] = torch.tensor([math.cos(tilt / 2), 0, 0, math.sin(tilt / 2)])
    down = Camera.looking_at((0, 0, 0), (0, 1, 0), 20, 20, 40, 60, (0, 0, 1))
    normal = torch.tensor([[math.sin(tilt), -math.cos(tilt), 0.0]], dtype=torch.float64)
    assert torch.allclose(facing_normals(disc, orthographic(down, 1.0)), normal)
    assert torch.allclose(facing_normals(disc, down), -normal)
