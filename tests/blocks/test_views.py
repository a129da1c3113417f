"""The share of an image that a cell covers, by its airspace and by a coarse model, and the Gaussians in any view."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from gsplat_edu.blocks.plan import Area, Cell, Ground
from gsplat_edu.blocks.seams import strip_masks, strip_width
from gsplat_edu.blocks.views import ENOUGH, airspace_shares, assigned, in_any_view, seen_shares
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.projection import Projection
from gsplat_edu.scene.views import View
from lens_scenes import LENSES, around, lens_camera

GROUND = Ground((0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)))
AREA = Area(GROUND, (-10.0, -10.0), (10.0, 10.0), (0.0, 0.01))
DEPTH = RenderSettings(depth=True)
HALVES = [Cell((-math.inf, -math.inf), (0.0, math.inf)), Cell((0.0, -math.inf), (math.inf, math.inf))]


def downwards(x, high=5.0):
    eye = np.array([x, -high, 0.0])
    return Camera(look_at(eye, [x, 0.0, 0.0], up=(0.0, 0.0, -1.0)), eye, 40.0, 40.0, 31.5, 23.5, 48, 64)


def carpet(y=0.0, low=-8.0, high=8.0):
    """Opaque flat Gaussians that cover the ground."""
    a, b = np.meshgrid(np.arange(low, high, 0.25), np.arange(-8, 8, 0.25))
    means = torch.tensor(np.stack([a.ravel(), np.full(a.size, y), b.ravel()], axis=1), dtype=torch.float32)
    n = len(means)
    return Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        log_scales=torch.log(torch.tensor([[0.2, 0.02, 0.2]])).repeat(n, 1),
        sh0=torch.zeros(n, 1, 3),
        sh_rest=torch.zeros(n, 0, 3),
        logit_opacities=torch.full((n,), 5.0),
    )


def shows(gaussians, cameras, cells=HALVES):
    def with_features(scene, camera, features):
        return render(scene, camera, features=features, backend="cpu")

    return seen_shares(AREA, gaussians, with_features, cameras, cells)


@pytest.mark.parametrize("x", [0.0, 1.0, -2.0, 9.0])
def test_both_measures_agree_on_flat_ground(x):
    # Seen from 5 above, the image is 64 / 40 * 5 = 8 wide, and its left side is at x - 4.
    left = np.clip((4 - x) / 8, 0, 1)
    (air,) = airspace_shares(AREA, [downwards(x)], HALVES)
    # There are 16 columns of rays. At x = 9, the ground ends inside the image.
    assert air[0] == pytest.approx(left, abs=1 / 16)
    if x < 9:
        (seen,) = shows(carpet(), [downwards(x)])
        assert seen[0] == pytest.approx(left, abs=0.03) and seen.sum() == pytest.approx(1, abs=0.03)


def test_hidden_ground_does_not_count():
    roof = carpet(y=-2.0, low=-8.0, high=0.0)  # over the left half only, above the ground
    camera = downwards(-4.0)
    # The roof is 3 below the camera and ends 4 to its right, outside the image, so it hides all ground.
    ground = carpet(low=-2.0)
    cells = [
        Cell((-math.inf, -math.inf), (-2.0, math.inf)),
        Cell((-2.0, -math.inf), (0.0, math.inf)),
        HALVES[1],
    ]
    (bare,) = shows(carpet(), [camera], cells)
    (hidden,) = shows(Gaussians.concatenated([roof, ground]), [camera], cells)
    np.testing.assert_allclose(bare, [0.75, 0.25, 0.0], atol=0.03)
    # The image shows 4.8 units of the roof, from -6.4 to -1.6; the part left of -2 is 4.4 of them.
    np.testing.assert_allclose(hidden, [4.4 / 4.8, 0.4 / 4.8, 0.0], atol=0.04)


def test_a_view_belongs_to_all_blocks_that_it_shows_enough_of_and_to_one_at_least(city):
    """One view shows both halves, one mostly the right half, and two beside the carpet show nothing."""
    places = {"both": 0.0, "mostly right": 4.25 - 8 * ENOUGH / 2, "blind left": -30.0, "blind right": 30.0}
    views = [View(downwards(x), np.zeros((48, 64, 3)), name=name) for name, x in places.items()]
    points = carpet().means.double().numpy()
    capture = dataclasses.replace(load_dataset(city), train=tuple(views), test=())
    found = assigned(capture, AREA, points, 2, lambda cameras, cells: shows(carpet(), cameras, cells), 1)
    names = {side: set(block.train) for side, block in zip(("left", "right"), found, strict=True)}
    assert found[0].core.high[0] == pytest.approx(0.0, abs=0.5)
    assert names == {"left": {"both", "blind left"}, "right": {"both", "mostly right", "blind right"}}


def test_more_cells_than_channels_take_several_renders():
    strips = [Cell((a, -math.inf), (a + 0.5, math.inf)) for a in np.arange(-10, 10, 0.5)]
    (shares,) = shows(carpet(), [downwards(0.0)], strips)
    assert len(strips) == 40 and shares.sum() == pytest.approx(1, abs=0.03)
    inside = [i for i, cell in enumerate(strips) if -3.5 <= cell.low[0] < 3.0]
    np.testing.assert_allclose(shares[inside], 0.5 / 8, atol=0.02)


def test_only_gaussians_beside_the_view_are_left_out():
    scene = carpet()
    cameras = [downwards(-3.0), downwards(2.0, high=3.0)]
    shown = in_any_view(scene, cameras)
    assert 0.2 < shown.mean() < 0.9
    kept = scene.map(lambda t: t[torch.from_numpy(shown)])
    for camera in cameras:  # alpha falls below 1/255 within 3.4 standard deviations
        whole, part = (render(g, camera, backend="cpu").image for g in (scene, kept))
        assert float((whole - part).abs().max()) < 0.01
    drawn = np.zeros(len(scene), dtype=bool)
    for camera in cameras:
        drawn[render(scene, camera, backend="cpu").visible.numpy()] = True
    lost = drawn & ~shown
    assert lost.mean() < 0.02


@pytest.mark.parametrize("name", LENSES)
def test_a_lens_loses_no_gaussian_that_it_draws(name):
    """With the Gaussians in the cone of the lens only, its image is the same, behind a rolling shutter too."""
    camera, scene = lens_camera(name, 60, 48), around(400, seed=5).gaussians(torch.float32)
    scene = dataclasses.replace(scene, log_scales=scene.log_scales - 1.0)
    if camera.projection.kind == "fisheye":  # up to 80 degrees from the axis instead of 160
        narrow = dataclasses.replace(camera.intrinsics, fx=2 * camera.fx, fy=2 * camera.fy)
        camera = Camera.posed(camera.R, camera.eye, narrow, camera.shutter)
    settings = RenderSettings(jacobian_limit=1.3)
    shown = in_any_view(scene, [camera])
    whole, part = (
        render(g, camera, settings=settings, backend="cpu").image
        for g in (scene, scene.map(lambda t: t[torch.from_numpy(shown)]))
    )
    assert float((whole - part).abs().max()) < 0.02 and float(whole.max()) > 0.1
    whole_sphere = camera.projection.kind in ("equirectangular", "orthographic")
    assert shown.all() if whole_sphere else 0.1 < shown.mean() < 0.95


@pytest.mark.parametrize("projection", [Projection("fisheye"), Projection("equirectangular")])
def test_places_near_a_cut_are_found_through_a_lens(projection):
    """The pixels of the mask are those whose rays meet the ground near the cut."""
    pinhole = downwards(0.0)
    if projection.kind == "equirectangular":
        camera = Camera.panorama(pinhole.R, pinhole.eye, 48, 96)
    else:
        camera = Camera(pinhole.R, pinhole.eye, 20.0, 20.0, 31.5, 31.5, 64, 64).through(projection)
    (mask,) = strip_masks(
        AREA, HALVES, carpet(), [camera], lambda g, c: render(g, c, settings=DEPTH, backend="cpu")
    )
    rays = camera.rays()
    with np.errstate(divide="ignore", invalid="ignore"):
        there = camera.eye + (5.0 / rays[..., 1:2]) * rays
    ground = (rays[..., 1] > 0.5) & (np.abs(there[..., ::2]) < 7).all(axis=-1)
    true = np.abs(there[..., 0]) < strip_width(AREA, HALVES)
    assert ground.sum() > 200 and (mask == true)[ground].mean() > 0.95 and mask[ground].any()
    assert not mask[rays[..., 1] < 0].any()


def test_a_sky_behind_the_scene_moves_no_place_near_a_cut():
    """A camera over the cut sees the ground through thin splats, and a shell of sky 300 away through the gaps."""
    thin = dataclasses.replace(carpet(), logit_opacities=torch.full((len(carpet()),), -0.5))
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(600, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    shell = Gaussians(
        means=torch.tensor(300.0 * directions, dtype=torch.float32),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(600, 1),
        log_scales=torch.full((600, 3), math.log(15.0)),
        sh0=torch.zeros(600, 1, 3),
        sh_rest=torch.zeros(600, 0, 3),
        logit_opacities=torch.full((600,), 3.0),
    )
    # the view is tilted: its upper rows look over the end of the carpet into the sky
    eye = np.array([0.0, -5.0, 0.0])
    camera = Camera(look_at(eye, [0.0, 0.0, 6.0]), eye, 40.0, 40.0, 31.5, 23.5, 48, 64)
    whole = Gaussians.concatenated([thin, shell])
    settings = dataclasses.replace(DEPTH, jacobian_limit=1.3)  # the ground goes on beside the camera
    (mask,) = strip_masks(
        AREA, HALVES, whole, [camera], lambda g, c: render(g, c, settings=settings, backend="cpu")
    )
    rays = camera.rays()
    with np.errstate(divide="ignore", invalid="ignore"):
        there = camera.eye + (5.0 / rays[..., 1:2]) * rays
    ground = (rays[..., 1] > 0.1) & (np.abs(there[..., ::2]) < 7).all(axis=-1)
    true = np.abs(there[..., 0]) < strip_width(AREA, HALVES)
    assert true[ground].sum() > 60 and (mask == true)[ground].mean() > 0.95
    assert not mask[rays[..., 1] < 0.1].any()


def test_the_airspace_of_a_panorama_is_measured_by_its_rays():
    """Half of the directions of a panorama over the cut look down, a quarter on each side."""
    pinhole = downwards(0.0)
    (air,) = airspace_shares(
        Area(GROUND, (-500.0, -500.0), (500.0, 500.0), (0.0, 0.01)),
        [Camera.panorama(look_at(pinhole.eye, pinhole.eye + np.array([0, 0, 1])), pinhole.eye, 48, 96)],
        HALVES,
    )
    np.testing.assert_allclose(air, 0.25, atol=0.01)
