"""The loss on patches of neighbouring photos, natively and from its definition."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.ops.patches import (
    LEAST_SPREAD,
    MOST,
    RADIUS,
    GreyPhoto,
    Grid,
    patch_error,
    patch_error_in_torch,
)
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.photo import Photo

NORMAL = np.array([0.2, 0.1, -0.97]) / np.linalg.norm([0.2, 0.1, -0.97])
"""The plane NORMAL . x = 0 through the origin, which cameras at z < 0 see from its front."""


def paint(points):
    """Return a smooth pattern of a plane, 0 to 255, whose waves are 6 px or longer in the photos below."""
    x, y = points[..., 0], points[..., 1]
    return 128 + 60 * np.sin(9 * x + 2 * y) + 50 * np.cos(8 * y - 3 * x)


def photographed(camera, counts=None):
    """Return the photo of the plane, and the true depth (H, W)."""
    rays = camera.rays()
    depth = -(NORMAL @ camera.eye) / (rays @ NORMAL)
    points = camera.eye + depth[..., None] * rays
    return GreyPhoto(camera, np.rint(paint(points)).astype(np.uint8), counts), depth


def two_views(H=40, W=52):
    """Return two photos of the plane from 16 degrees apart, and the maps of the first: normals, depth, alpha."""
    views = [Camera.looking_at((x, -0.3, -3), (0, 0, 0), 1.3 * W, 1.25 * W, H, W) for x in (0.4, -0.4)]
    (photo, depth), (other, _) = (photographed(camera) for camera in views)
    generator = torch.Generator().manual_seed(0)
    alpha = 0.92 + 0.07 * torch.rand(H, W, dtype=torch.float64, generator=generator)
    normals = torch.from_numpy(NORMAL) * (0.9 * alpha[..., None])
    return photo, other, [normals, torch.from_numpy(depth) * alpha, alpha]


def disturbed(maps, amount=0.02):
    """Return the maps with depth and normals that are off by about `amount`, as leaves."""
    generator = torch.Generator().manual_seed(1)
    normals, depth, alpha = maps
    noise = [torch.randn(t.shape, dtype=torch.float64, generator=generator) for t in (normals, depth)]
    return [(t + amount * n).requires_grad_() for t, n in zip((normals, depth), noise, strict=True)] + [
        alpha.clone().requires_grad_()
    ]


def test_the_true_surface_has_the_least_loss():
    """Photos are rounded to whole levels, and their interpolation errs by h² f'' / 8: together below 1 % of a patch."""
    photo, other, maps = two_views()
    grid = Grid(3)
    true = patch_error(*maps, photo, other, grid)
    assert true.learning > 60 and float(true.value) < 1e-2
    for change in (0.9, 0.97, 1.03, 1.1):
        moved = patch_error(maps[0], change * maps[1], maps[2], photo, other, grid)
        assert float(moved.value) > 5 * float(true.value)
    turned = maps[0] + maps[2][..., None] * torch.tensor([0.4, 0.0, 0.0], dtype=torch.float64)
    assert float(patch_error(turned, maps[1], maps[2], photo, other, grid).value) > 2 * float(true.value)


def test_brightness_and_contrast_do_not_matter():
    photo, other, maps = two_views()
    darker = dataclasses.replace(other, pixels=(other.pixels // 2 + 20).astype(np.uint8))
    values = [float(patch_error(*maps, photo, seen, Grid(3)).value) for seen in (other, darker)]
    assert values[1] == pytest.approx(values[0], abs=2e-3)  # half the levels: twice the rounding


def test_the_native_loss_is_its_definition():
    photo, other, maps = two_views()
    counts = np.ones(photo.pixels.shape, dtype=bool)
    counts[10:14, 20:23] = False
    photo = dataclasses.replace(photo, counts=counts)
    other = dataclasses.replace(other, counts=counts[::-1].copy())
    maps[2][20] = 0.5  # no surface
    maps[0][:, 30] = 0.0
    maps[1][5] = 0.0
    inputs = disturbed(maps, 0.1)
    found, expected = (
        f(*inputs, photo, other, Grid(2, 1, 0), 1.7) for f in (patch_error, patch_error_in_torch)
    )
    assert found.learning == expected.learning > 60
    assert abs(found.value.item() - expected.value.item()) < 1e-13 and expected.value.item() > 1e-2
    for one, other_one in zip(
        torch.autograd.grad(found.value, inputs), torch.autograd.grad(expected.value, inputs), strict=True
    ):
        torch.testing.assert_close(one, other_one, rtol=0, atol=1e-12)
        assert other_one.abs().max() > 1e-4


def test_gradients_of_the_loss_on_patches():
    """The loss is smooth where no sample crosses a pixel's border and no patch reaches a bound.

    With steps of 1e-6 samples move by less than 1e-4 px. Those of this scene are farther from borders, and no
    correlation is within 1e-4 of the bound; otherwise differences and gradients would disagree by whole slopes.
    """
    photo, other, maps = two_views(26, 30)
    inputs = disturbed(maps, 0.01)

    def value(*given):
        return patch_error(*given, photo, other, Grid(6, 4, 4), 30.0).value

    assert torch.autograd.gradcheck(value, inputs, eps=1e-6, atol=1e-6)


def test_the_loss_has_the_same_bits_for_any_number_of_threads():
    photo, other, maps = two_views(67, 91)
    inputs = [t.detach().float().requires_grad_() for t in disturbed(maps)]
    seen, before = set(), torch.get_num_threads()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            loss = patch_error(*inputs, photo, other, Grid(4))
            gradients = torch.autograd.grad(loss.value, inputs)
            seen.add((float(loss.value.detach()), *(g.numpy().tobytes() for g in gradients)))
    finally:
        torch.set_num_threads(before)
    assert len(seen) == 1


def test_float32_maps():
    """Rounded maps move samples by fx 2^-24 relative to the depth: 3e-5 px here, a slope of 20 levels of 60 each."""
    photo, other, maps = two_views()
    inputs = disturbed(maps)
    narrow = patch_error(*(t.detach().float() for t in inputs), photo, other, Grid(3))
    assert float(narrow.value) == pytest.approx(
        patch_error(*inputs, photo, other, Grid(3)).value.item(), abs=1e-4
    )


@pytest.mark.parametrize("case", ["flat", "behind", "aside", "turned away", "tiny", "unlike"])
def test_what_has_no_neighbour_learns_nothing(case):
    photo, other, maps = two_views()
    if case == "flat":  # noise of less than LEAST_SPREAD
        noise = np.random.default_rng(0).integers(0, 2, other.pixels.shape)
        assert noise.std() < LEAST_SPREAD
        other = dataclasses.replace(other, pixels=noise.astype(np.uint8))
    elif case in ("behind", "aside"):
        centre = (0, 0, -6) if case == "behind" else (9, 0, -3)
        camera = Camera.looking_at((0, 0, -3), centre, 60, 60, 40, 52)
        other = GreyPhoto(camera, other.pixels)
    elif case == "turned away":
        maps[0] = -maps[0]
    elif case == "tiny":
        other = GreyPhoto(dataclasses.replace(other.camera, H=1, W=1), other.pixels[:1, :1])
    else:  # correlation below 1 - MOST
        other = dataclasses.replace(other, pixels=255 - other.pixels)
    inputs = [t.detach().requires_grad_() for t in maps]
    for f in (patch_error, patch_error_in_torch):
        loss = f(*inputs, photo, other, Grid(3))
        assert loss.learning == 0
        gradients = torch.autograd.grad(loss.value, inputs, allow_unused=True)
        assert not any(g is not None and g.any() for g in gradients)
        assert (
            (float(loss.value.detach()) > 0.5 * MOST * (1 - 2 * RADIUS / 40))
            if case == "unlike"
            else float(loss.value.detach()) == 0
        )


def test_a_photo_without_colours():
    image = np.array([[[0, 1, 1], [255, 255, 255]], [[10, 20, 33], [1, 0, 0]]], dtype=np.uint8)
    alpha = np.array([[255, 255], [100, 255]], dtype=np.uint8)
    mask = np.array([[True, False], [True, True]])
    camera = Camera.looking_at((0, 0, -3), (0, 0, 0), 2, 2, 2, 2)
    grey = GreyPhoto.of(Photo(image, alpha, mask), camera)
    assert grey.pixels.tolist() == [[1, 255], [21, 0]]
    assert grey.counts.tolist() == [[True, False], [False, True]]
    assert GreyPhoto.of(Photo(image), camera).counts is None
    floats = GreyPhoto.of(Photo(image / 255.0), camera)
    assert floats.pixels.tolist() == grey.pixels.tolist()


def test_wrong_patches_are_named(as_shipped):
    photo, other, maps = two_views()
    with pytest.raises(ShapeError, match="depth"):
        patch_error(maps[0], maps[1][:-1], maps[2], photo, other, Grid(3))
    with pytest.raises(ArgumentError, match="alpha: is torch.float32"):
        patch_error(maps[0], maps[1], maps[2].float(), photo, other, Grid(3))
    with pytest.raises(ArgumentError, match="stride"):
        patch_error(*maps, photo, other, Grid(0))
    with pytest.raises(ShapeError, match="pixels"):
        GreyPhoto(photo.camera, photo.pixels[1:])
