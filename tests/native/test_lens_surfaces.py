"""The losses on normals and on patches through lenses and rolling shutters: definition, gradients, bits."""

import numpy as np
import pytest
import torch

from gsplat_edu import Camera
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.ops.patches import GreyPhoto, Grid, patch_error, patch_error_in_torch
from gsplat_edu.ops.surface import normal_error, normal_error_in_torch
from gsplat_edu.scene.camera import look_at
from gsplat_edu.scene.projection import PINHOLE, Distortion, Projection
from gsplat_edu.scene.shutter import RollingShutter

FISHEYE = Projection("fisheye", Distortion.of(k1=-0.02, p1=0.001))
DISTORTED = Projection("perspective", Distortion.of(k1=-0.12, k2=0.03, p1=0.002, p2=-0.001))
MOVING = RollingShutter((0.02, -0.04, 0.03), (0.05, 0.02, -0.03), "down")
SIDEWAYS = RollingShutter((0.02, -0.04, 0.03), (0.05, 0.02, -0.03), "left")

LENSES = {
    "fisheye": (FISHEYE, None),
    "panorama": (Projection("equirectangular"), None),
    "distorted": (DISTORTED, None),
    "rows": (PINHOLE, MOVING),
    "columns": (FISHEYE, SIDEWAYS),
}
"""Lenses and shutters. The fisheye sees 250 degrees from side to side, so many pixels look backwards; its corners have
no ray."""


def posed(eye, name, side=40):
    """Return a camera in the middle of the ball of `Ball`, looking along a slanted direction."""
    projection, shutter = LENSES[name]
    R = look_at(eye, np.add(eye, (0.3, 0.2, 1.0)))
    if projection.kind == "equirectangular":
        return Camera.panorama(R, eye, side, 2 * side)
    middle, H = (side - 1) / 2, side - 2
    focal = side / np.radians(250) if projection.kind == "fisheye" else 0.9 * side
    plain = Camera(R, eye, focal, 0.97 * focal, middle + 0.4, middle - 0.8, H, side)
    return plain.through(projection, shutter)


def seen_rays(camera):
    rays = camera.rays()
    held = np.isfinite(rays).all(axis=-1)
    return np.where(held[..., None], rays, 0.0), held


def ball_depth(camera):
    """Return the depth of a ball of radius 2 around the origin, seen from inside, and its normals; 0 without a ray."""
    rays, held = seen_rays(camera)
    start = camera.origins()
    a, b, c = (rays**2).sum(-1), (rays * start).sum(-1), (start**2).sum(-1) - 4
    with np.errstate(all="ignore"):
        z = np.where(held, (np.sqrt(b * b - a * c) - b) / a, 0.0)
    return z, -(start + z[..., None] * rays) / 2


def paint(points):
    """Return a smooth pattern, 0 to 255, whose waves are 6 px or longer in the photos below."""
    x, y, z = np.moveaxis(points, -1, 0)
    return 128 + 45 * np.sin(3.1 * x + 1.2 * z) + 40 * np.cos(2.9 * y - 1.4 * x) + 35 * np.sin(3 * z + y)


def photographed(camera):
    _, normals = ball_depth(camera)
    return GreyPhoto(camera, np.rint(paint(-2 * normals)).astype(np.uint8))


def maps_of(camera, noise, dtype=torch.float64):
    """Return normals, depth and alpha of the ball, with depth off by about `noise`, normals by 20 times that."""
    z, normals = ball_depth(camera)
    generator = torch.Generator().manual_seed(0)
    alpha = 0.92 + 0.07 * torch.rand(z.shape, dtype=torch.float64, generator=generator)
    off = [
        noise * torch.randn(t.shape, dtype=torch.float64, generator=generator).numpy() for t in (z, normals)
    ]
    z = np.where(z > 0, z + off[0], 1.0)  # a depth where there is no ray: it must not count
    turned = torch.nn.functional.normalize(torch.from_numpy(normals + 20 * off[1]), dim=-1)
    maps = (alpha[..., None] * turned, alpha * torch.from_numpy(z), alpha)
    return [t.to(dtype).requires_grad_() for t in maps]


def test_the_fisheye_sees_past_90_degrees_and_has_no_rays_in_its_corners():
    camera = posed((0.1, 0.0, 0.2), "fisheye")
    rays, held = seen_rays(camera)
    assert (rays[held] @ camera.R[2]).min() < -0.5 and 4 < (~held).sum() < held.size / 3


@pytest.mark.parametrize("name", LENSES)
def test_the_native_loss_on_normals_is_its_definition(name, isa):
    camera = posed((0.1, -0.2, 0.2), name)
    inputs = maps_of(camera, 0.003)
    inputs[2].data[14, 15] = 0.0  # nothing is drawn there
    values = [f(*inputs, camera, 1.7) for f in (normal_error, normal_error_in_torch)]
    assert abs(values[0] - values[1]) < 1e-13 and values[1] > 1e-5
    found, expected = (torch.autograd.grad(value, inputs) for value in values)
    _, held = seen_rays(camera)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)
        assert other.abs().max() > 1e-5 and not one[torch.from_numpy(~held)].any()


@pytest.mark.parametrize("name", LENSES)
def test_gradients_of_the_loss_on_normals(name):
    """The mask of pixels with a normal is constant near the inputs: no alpha is 0, no depth within 1e-4 of a jump.

    The loss is smooth then, because no two tangents are parallel. Alpha is a factor, which
    counts as a constant; its gradient is compared with that of the definition above.
    """
    camera = posed((0.1, -0.2, 0.2), name, 13)
    inputs = maps_of(camera, 0.002)
    alpha = inputs[2].detach()
    assert normal_error(*inputs, camera, 40.0).item() > 3e-3
    assert torch.autograd.gradcheck(
        lambda *given: normal_error(*given, alpha, camera, 40.0), inputs[:2], eps=1e-6, atol=1e-6
    )


@pytest.mark.parametrize("name", LENSES)
def test_the_true_normals_have_the_least_loss(name):
    camera = posed((0.1, -0.2, 0.2), name, 120)
    exact, off = (normal_error(*maps_of(camera, noise), camera).item() for noise in (0.0, 0.002))
    assert 8 * exact < off


@pytest.mark.parametrize("name", LENSES)
def test_patches_of_the_true_surface_agree(name):
    photo, other = (photographed(posed(eye, name, 80)) for eye in ((0.2, -0.2, 0.2), (-0.1, -0.1, 0.2)))
    normals, depth, alpha = (t.detach() for t in maps_of(photo.camera, 0.0))
    true = patch_error(normals, depth, alpha, photo, other, Grid(4))
    assert true.learning > 40
    for change in (0.85, 1.15):
        moved = patch_error(normals, change * depth, alpha, photo, other, Grid(4))
        assert float(moved.value) > 2 * float(true.value)


@pytest.mark.parametrize("name", [*LENSES, "mixed"])
def test_the_native_loss_on_patches_is_its_definition(name):
    first, second = ("fisheye", "panorama") if name == "mixed" else (name, name)
    photo, other = (
        photographed(posed((0.2, -0.2, 0.2), first)),
        photographed(posed((-0.1, -0.1, 0.2), second)),
    )
    inputs = maps_of(photo.camera, 0.02)
    found, expected = (
        f(*inputs, photo, other, Grid(3, 1, 0), 1.7) for f in (patch_error, patch_error_in_torch)
    )
    assert found.learning == expected.learning > 10
    assert abs(found.value.item() - expected.value.item()) < 1e-12 and expected.value.item() > 3e-4
    for one, other_one in zip(
        torch.autograd.grad(found.value, inputs), torch.autograd.grad(expected.value, inputs), strict=True
    ):
        torch.testing.assert_close(one, other_one, rtol=0, atol=1e-10)
        assert other_one.abs().max() > 1e-4


@pytest.mark.parametrize("name", LENSES)
def test_gradients_of_the_loss_on_patches(name):
    """The loss is smooth where no sample crosses a pixel's border and no patch reaches a bound.

    With steps of 1e-6 samples move by less than 1e-4 px. Those of this scene are farther from borders, and no
    correlation is within 1e-4 of the bound.
    """
    photo, other = (photographed(posed(eye, name, 26)) for eye in ((0.2, -0.2, 0.2), (-0.1, -0.1, 0.2)))
    inputs = maps_of(photo.camera, 0.004)

    def value(*given):
        return patch_error(*given, photo, other, Grid(6, 4, 4), 30.0).value

    assert patch_error(*inputs, photo, other, Grid(6, 4, 4)).learning > 2
    assert torch.autograd.gradcheck(value, inputs, eps=1e-6, atol=1e-5, fast_mode=True)


@pytest.mark.parametrize("name", LENSES)
def test_the_losses_have_the_same_bits_for_any_number_of_threads(name):
    photo, other = (photographed(posed(eye, name, 67)) for eye in ((0.2, -0.2, 0.2), (-0.1, -0.1, 0.2)))
    inputs = maps_of(photo.camera, 0.01, torch.float32)
    seen, before = set(), torch.get_num_threads()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            values = normal_error(*inputs, photo.camera), patch_error(*inputs, photo, other, Grid(4)).value
            gradients = [g for value in values for g in torch.autograd.grad(value, inputs)]
            seen.add((*(float(v.detach()) for v in values), *(g.numpy().tobytes() for g in gradients)))
    finally:
        torch.set_num_threads(before)
    assert len(seen) == 1


def test_a_lens_at_rest_without_distortion_is_a_pinhole():
    plain = posed((0.1, -0.2, 0.2), "distorted").through()
    lens = plain.through(Projection("perspective", Distortion()))
    photo, other = (
        photographed(plain),
        photographed(Camera.posed(plain.R, (-0.1, -0.1, 0.2), plain.intrinsics)),
    )
    inputs = maps_of(plain, 0.01)
    torch.testing.assert_close(normal_error(*inputs, plain), normal_error(*inputs, lens), rtol=0, atol=1e-14)
    values = [
        patch_error(*inputs, GreyPhoto(camera, photo.pixels), other, Grid(3)).value
        for camera in (plain, lens)
    ]
    torch.testing.assert_close(*values, rtol=0, atol=1e-13)


def test_orthographic_photos():
    """Their normals have a loss by torch, since rays do not begin at one point; patches are refused."""
    flat = Camera(np.eye(3), (0, 0, -3), 20, 20, 20, 15, 30, 40).through(Projection("orthographic"))
    normals = torch.zeros(30, 40, 3, dtype=torch.float64)
    normals[..., 2] = -1
    depth = torch.full((30, 40), 3.0, dtype=torch.float64)
    assert float(normal_error(normals, depth, torch.ones_like(depth), flat)) < 1e-15
    photo = GreyPhoto(flat, np.zeros((30, 40), np.uint8))
    with pytest.raises(ArgumentError, match="photo: is orthographic"):
        patch_error(normals, depth, torch.ones_like(depth), photo, photo, Grid(3))
