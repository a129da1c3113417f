"""The left and the right edge of a panorama meet: what compares neighbouring pixels goes on across them.

A panorama that is turned by any number of columns, with its photo, shows the same pixels in another order, so every
loss is the same up to rounding. That holds for a centre of the image at any column, too: longitudes jump from 180 to
-180 degrees there, and pixels do not notice.
"""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu import Camera, Gaussians
from gsplat_edu.ops.depth import DepthRule, depth_error
from gsplat_edu.ops.patches import GreyPhoto, Grid, patch_error, patch_error_in_torch
from gsplat_edu.ops.surface import normal_error, normal_error_in_torch
from gsplat_edu.parts.given_depth.term import DepthTerm
from gsplat_edu.parts.surface.terms import Turns
from gsplat_edu.render.api import render
from gsplat_edu.render.planes import facing_normals
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import look_at
from gsplat_edu.scene.given_depth import GivenDepth
from gsplat_edu.scene.shutter import RollingShutter
from gsplat_edu.scene.views import View
from gsplat_edu.train.feed import Draw, Target
from gsplat_edu.train.rendered import Rendered
from native.test_lens_surfaces import MOVING, maps_of, photographed, posed

SIDE, W = 40, 80
EYES = ((0.2, -0.2, 0.2), (-0.1, -0.1, 0.2))

TURNS = [(1, 0.0), (3, 0.0), (40, 0.0), (79, 0.0), (0, 1.0), (17, 2.5), (52, -3.1)]
"""Columns by which pixels move to the right, and the angle in radians by which the middle turns beside that."""


def turned(camera, columns, angle):
    """Return the panorama whose pixel `u + columns` has the ray of this one's pixel u, u + columns modulo W."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ camera.R
    middle = camera.cx + columns - camera.fx * angle
    plain = Camera(R, camera.eye, camera.fx, camera.fy, middle, camera.cy, camera.H, camera.W)
    shutter = camera.shutter
    if shutter is not None:  # its turn is in the camera's axes
        turn = R @ camera.R.T @ shutter.turn
        shutter = RollingShutter(tuple(turn), tuple(shutter.shift), shutter.readout)
    return plain.through(camera.projection, shutter)


def rolled(photo, columns, angle):
    return GreyPhoto(
        turned(photo.camera, columns, angle), np.ascontiguousarray(np.roll(photo.pixels, columns, axis=1))
    )


def pair(moving):
    photos = [photographed(posed(eye, "panorama", SIDE)) for eye in EYES]
    if not moving:
        return photos
    shutters = (MOVING, RollingShutter((0.01, 0.03, -0.02), (-0.04, 0.01, 0.02), "up"))
    moved = [p.camera.through(p.camera.projection, s) for p, s in zip(photos, shutters, strict=True)]
    return [photographed(camera) for camera in moved]


def rolled_leaves(inputs, columns):
    return [t.detach().roll(columns, dims=1).requires_grad_() for t in inputs]


def splats_on_the_ball(count=500):
    """Return flat splats that cover the ball of `ball_depth`, of radius 2, several times."""
    rng = np.random.default_rng(1)
    index = np.arange(count) + 0.5
    z, turn = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    quats = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(count)], axis=1)
    return Gaussians(
        means=torch.tensor(rng.uniform(1.97, 2.03, (count, 1)) * normals),
        quats=torch.tensor(quats),
        log_scales=torch.tensor(np.log(np.tile([0.3, 0.3, 0.02], (count, 1)))),
        sh0=torch.zeros(count, 1, 3, dtype=torch.float64),
        sh_rest=torch.zeros(count, 0, 3, dtype=torch.float64),
        logit_opacities=torch.full((count,), 1.5, dtype=torch.float64),
    )


@pytest.mark.parametrize(("columns", "angle"), TURNS)
def test_a_turned_panorama_has_the_same_rays(columns, angle):
    """A longitude of up to 2 pi is off by its rounding, which times W is the error of a ray in pixels."""
    camera = posed(EYES[0], "panorama", SIDE).through(posed(EYES[0], "panorama", SIDE).projection, MOVING)
    other = turned(camera, columns, angle)
    for own, found in ((camera.rays(), other.rays()), (camera.origins(), other.origins())):
        np.testing.assert_allclose(np.roll(own, columns, axis=1), found, rtol=0, atol=1e-14)
        assert np.isfinite(found).all()


@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize(("columns", "angle"), TURNS)
def test_normals_have_the_same_loss_wherever_the_seam_is(columns, angle, moving):
    """The difference of rays two columns apart is wrong by W eps of its size, and so is each pixel's cosine."""
    camera = pair(moving)[0].camera
    inputs = maps_of(camera, 0.003)
    others = rolled_leaves(inputs, columns)
    one, other = (
        normal_error(*inputs, camera, 1.7),
        normal_error(*others, turned(camera, columns, angle), 1.7),
    )
    assert abs(float((one - other).detach())) < 10 * W * 2.3e-16 and float(one.detach()) > 1e-5
    for own, found in zip(torch.autograd.grad(one, inputs), torch.autograd.grad(other, others), strict=True):
        scale = float(own.abs().max())
        torch.testing.assert_close(own.roll(columns, dims=1), found, rtol=0, atol=1e-11 * scale)
        assert own[1:-1, 0].any() and own[1:-1, -1].any()


@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize(("columns", "angle"), TURNS)
def test_patches_have_the_same_loss_wherever_the_seam_is(columns, angle, moving):
    """A point in the other photo is off by some W eps px, its value by 255 times that, which a spread of 2 divides."""
    photo, other = pair(moving)
    inputs = maps_of(photo.camera, 0.01)
    others, stride = rolled_leaves(inputs, columns), 4
    one = patch_error(*inputs, photo, other, Grid(stride))
    two = patch_error(
        *others,
        rolled(photo, columns, angle),
        rolled(other, 11 * columns, -angle),
        Grid(stride, columns % stride),
    )
    assert one.learning == two.learning > 40
    assert abs(float((one.value - two.value).detach())) < 128 * 10 * W * 2.3e-16
    gradients = (torch.autograd.grad(each.value, leaves) for each, leaves in ((one, inputs), (two, others)))
    for own, found in zip(*gradients, strict=True):
        scale = float(own.abs().max())
        torch.testing.assert_close(own.roll(columns, dims=1), found, rtol=0, atol=1e-9 * scale)


def test_patches_at_the_seam_learn():
    """Patches around the first column have three columns on the other side; those at the poles are none."""
    photo, other = pair(False)
    inputs = maps_of(photo.camera, 0.01)
    found = [f(*inputs, photo, other, Grid(4)) for f in (patch_error, patch_error_in_torch)]
    assert found[0].learning == found[1].learning
    for each in found:
        gradient = torch.autograd.grad(each.value, inputs[1])[0]
        assert int((gradient[:, 0] != 0).sum()) > 4 and not gradient[[0, -1]].any()


def test_a_pixel_that_does_not_count_reaches_across_the_seam():
    photo, other = pair(False)
    inputs, counts = maps_of(photo.camera, 0.01), np.ones((SIDE, W), bool)
    counts[:, -2] = False
    masked = dataclasses.replace(photo, counts=counts)
    for given in ((masked, other), (photo, dataclasses.replace(other, counts=counts))):
        found, expected = (f(*inputs, *given, Grid(4)) for f in (patch_error, patch_error_in_torch))
        assert 0 < found.learning == expected.learning < patch_error(*inputs, photo, other, Grid(4)).learning
    gradient = torch.autograd.grad(patch_error(*inputs, masked, other, Grid(4)).value, inputs[1])[0]
    assert not gradient[:, 0].any() and gradient[:, 4].any()


@pytest.mark.parametrize("function", [normal_error, normal_error_in_torch])
def test_gradients_of_normals_at_the_seam(function):
    """Only the depths of the two edges are inputs.

    Smooth, because every alpha is above 0 and a step of 1e-6 carries no depth over the bound of a jump.
    """
    camera = posed((0.1, -0.2, 0.2), "panorama", 20)
    normals, depth, alpha = (t.detach() for t in maps_of(camera, 0.002))

    def value(edges):
        full = torch.cat([edges[:, :1], depth[:, 1:-1], edges[:, 1:]], dim=1)
        return function(normals, full, alpha, camera, 40.0)

    edges = depth[:, [0, -1]].requires_grad_()
    gradient = torch.autograd.grad(value(edges), edges)[0]
    assert int((gradient != 0).all(dim=1).sum()) > 8
    assert torch.autograd.gradcheck(value, (edges,), eps=1e-6, atol=1e-6)


def test_gradients_of_patches_at_the_seam():
    """Smooth, as samples are farther from pixels' borders than a step moves them, and no loss is near its bound.

    Of the centres, 7 columns apart, those in column 0 have patches across the seam.
    """
    photo, other = (photographed(posed(eye, "panorama", 18)) for eye in EYES)
    inputs = maps_of(photo.camera, 0.004)
    grid = Grid(7, 0, 6)

    def value(*given):
        return patch_error(*given, photo, other, grid, 30.0).value

    gradient = torch.autograd.grad(value(*inputs), inputs[1])[0]
    assert int((gradient[:, 0] != 0).sum()) > 1
    assert torch.autograd.gradcheck(value, inputs, eps=1e-6, atol=1e-5)


@pytest.mark.parametrize(
    "rule", [DepthRule(0.7, bend=0.5), DepthRule(0.3, extent=2.5)], ids=["maps", "points"]
)
def test_samples_of_depth_at_the_seam(rule):
    """Samples lie between the last and the first column; none is at a kink: alpha is above its bound, z not given."""
    rng = np.random.default_rng(0)
    alpha = torch.tensor(rng.uniform(0.55, 1.0, (7, 9)), requires_grad=True)
    depth = torch.tensor(rng.uniform(1.2, 1.6, (7, 9)), requires_grad=True)
    pixels = torch.tensor(np.stack([rng.uniform(8.05, 8.95, 30), rng.uniform(0.1, 5.9, 30)], axis=1))
    given, weights = (torch.tensor(rng.uniform(*ends, 30)) for ends in ((3.0, 4.0), (0.1, 1.0)))

    def value(depth, alpha, pixels=pixels):
        return depth_error(depth, alpha, pixels, given, weights, rule, wraps=True)

    assert depth_error(depth, alpha, pixels, given, weights, rule) == 0  # outside of any other image
    assert value(depth, alpha) > 0 and torch.autograd.gradcheck(value, (depth, alpha), eps=1e-7)
    for columns in (-9, 2, 9, 13):
        moved = pixels + torch.tensor([columns, 0.0])
        found = value(depth.roll(columns, dims=1), alpha.roll(columns, dims=1), moved)
        # a share is off by the rounding of a column of at most 22, twice; alpha may be half of a share's factor
        torch.testing.assert_close(found, value(depth, alpha), rtol=100 * 22 * 2.3e-16, atol=0)
    edge = torch.tensor([[-1e-20, 2.0], [-0.0, 2.0]], dtype=torch.float64)  # rounded up, it is W
    first = [
        depth_error(depth, alpha, edge[i : i + 1], given[:1], weights[:1], rule, wraps=True) for i in (0, 1)
    ]
    assert first[0] == first[1]


def test_the_losses_of_rendered_gaussians_do_not_depend_on_the_heading():
    """Columns move by whole tiles, so that each tile composites the same splats and ends at the same one.

    A mean is off by W eps px or so; each of three losses and its gradients are smooth there.
    """
    gaussians, eye = splats_on_the_ball(), (0.1, 0.0, 0.2)
    R = look_at(eye, (0.4, 0.2, 1.2))
    camera, near = Camera.panorama(R, eye, 48, 96), Camera.panorama(R, (0.3, 0.1, 0.1), 48, 96)
    rng = np.random.default_rng(0)
    pixels = torch.tensor(rng.uniform((-0.5, 1), (95.5, 46), (300, 2)))
    given, weights = (torch.tensor(rng.uniform(*ends, 300)) for ends in ((3.0, 4.0), (0.1, 1.0)))
    grey, beside = photographed(camera).pixels, photographed(near)

    def losses(columns):
        seen = turned(camera, columns, columns / camera.fx)  # the middle of the image stays its centre
        assert abs(seen.cx - camera.cx) < 1e-12
        leaves = dataclasses.replace(gaussians, means=gaussians.means.clone().requires_grad_())
        features = facing_normals(leaves, seen)
        out = render(leaves, seen, settings=RenderSettings(depth=True), features=features, backend="cpu")
        photo = GreyPhoto(seen, np.ascontiguousarray(np.roll(grey, columns, axis=1)))
        at = pixels + torch.tensor([columns, 0.0])
        terms = (
            normal_error(out.features, out.depth, out.alpha, seen),
            patch_error(out.features, out.depth, out.alpha, photo, beside, Grid(3, columns % 3)).value,
            depth_error(out.depth, out.alpha, at, given, weights, DepthRule(), wraps=True),
        )
        return torch.stack(terms).detach(), [
            torch.autograd.grad(term, leaves.means, retain_graph=True)[0] for term in terms
        ]

    values, gradients = losses(0)
    assert (values > 1e-4).all()
    for columns in (16, 48, 80):
        found, moved = losses(columns)
        torch.testing.assert_close(found, values, rtol=1e-10, atol=0)
        for one, other in zip(gradients, moved, strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=1e-9 * float(one.abs().max()))


def test_the_term_of_a_training_counts_samples_at_the_seam():
    """All given depth lies between the last and the first column, at half of the rendered depth."""
    gaussians = splats_on_the_ball()
    camera = Camera.panorama(look_at((0.1, 0.0, 0.2), (0.4, 0.2, 1.2)), (0.1, 0.0, 0.2), 48, 96)
    out = render(gaussians, camera, settings=RenderSettings(depth=True), backend="cpu")
    rows = np.arange(4.0, 44.0)
    rays = np.stack([np.full(40, (95.5 - camera.cx) / camera.fx), (rows - camera.cy) / camera.fy], axis=1)
    given = GivenDepth(rays, np.full(40, 1.0))
    photo = np.zeros((48, 96, 3), np.uint8)
    view = View(camera, photo, name="r.png").with_depth(lambda: given)
    target = Target(torch.from_numpy(photo), None)
    rendered = Rendered(gaussians, Draw(0, view, None), out, out.image, target, 0)
    term = DepthTerm(1.0, 1.0, 2.0, Turns(0))
    mean = (out.depth[:, [0, -1]].sum(dim=1) / out.alpha[:, [0, -1]].sum(dim=1))[4:44]
    assert float(term(rendered)) == pytest.approx(float((mean - 1).abs().mean()) - 0.01, rel=1e-5)
