"""Only tiles with a needed pixel are drawn, and their pixels and all gradients have the bits of the whole render."""

import numpy as np
import pytest
import torch

from gsplat_edu import ArgumentError, ShapeError
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from native_scenes import SCENES, random

STATISTICS = ("absgrad", "weight_sum", "weight_max", "pixels", "error_sum")


def marked(camera, spots):
    """Return an image of false in which rectangles (row, column, height, width) are true."""
    needed = torch.zeros(camera.H, camera.W, dtype=torch.bool)
    for top, left, high, wide in spots:
        needed[top : top + high, left : left + wide] = True
    return needed


def differentiated(gaussians, camera, needed, draw_all):
    """Render with features and all depths, and differentiate a random loss of the needed pixels."""
    generator = torch.Generator().manual_seed(3)
    gaussians = gaussians.trainable()
    features = torch.rand(len(gaussians), 5, generator=generator).to(gaussians.means).requires_grad_()
    settings = RenderSettings(depth=True, median_depth=True)
    given = None if draw_all else needed
    out = render(gaussians, camera, settings=settings, features=features, needed=given, backend="cpu")
    errors = torch.rand(camera.H, camera.W, generator=generator).to(gaussians.means)
    collected = out.collect(*STATISTICS, errors=errors)
    images = {"image": out.image, "transmittance": out.transmittance, "depth": out.depth}
    images |= {"features": out.features}
    loss = torch.zeros((), dtype=gaussians.means.dtype)
    for image in images.values():
        weights = torch.randn(image.shape, generator=generator, dtype=torch.float64).to(image)
        loss = loss + (image * weights * needed.reshape(needed.shape + (1,) * (image.ndim - 2))).sum()
    loss.backward()
    found = {name: tensor.grad for name, tensor in gaussians.tensors().items()}
    found |= {"features' gradient": features.grad, "norms": out.means2d_grad_norms()}
    found |= {name: image.detach()[needed] for name, image in images.items()}
    found["median"] = out.median_depth[needed]
    return out, found, collected()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_needed_pixels_and_gradients_have_the_bits_of_the_whole_render(isa, set_threads, dtype, threads):
    """Small and large Gaussians, some over hundreds of tiles; an image whose last tiles are cut."""
    set_threads(threads)
    scene = random(400, (410, 262), seed=4)
    gaussians = scene.gaussians(dtype)
    gaussians.log_scales[::20] += 2.5
    needed = marked(scene.camera, [(5, 5, 1, 1), (100, 200, 40, 3), (250, 390, 12, 20)])
    whole, expected, _ = differentiated(gaussians, scene.camera, needed, draw_all=True)
    part, found, statistics = differentiated(gaussians, scene.camera, needed, draw_all=False)
    assert torch.equal(part.visible, whole.visible)
    assert 0 < part.num_pairs < whole.num_pairs / 4
    for name, values in expected.items():
        assert torch.equal(found[name], values), name
    tiles = torch.nn.functional.max_pool2d(needed[None].float(), 16, ceil_mode=True)[0].bool()
    undrawn = ~tiles.repeat_interleave(16, 0).repeat_interleave(16, 1)[: needed.shape[0], : needed.shape[1]]
    assert bool(undrawn.any())
    assert torch.equal(part.transmittance[undrawn], torch.ones_like(part.transmittance[undrawn]))
    assert all(bool(torch.isfinite(values).all()) for values in statistics.values())


def test_statistics_count_drawn_tiles_only(isa):
    """Without a needed pixel nothing is drawn, and every sum is 0."""
    scene = SCENES["random"]
    nothing = marked(scene.camera, [])
    out, found, statistics = differentiated(scene.gaussians(torch.float64), scene.camera, nothing, False)
    assert out.num_pairs == 0 and len(out.visible) > 0
    assert all(not bool(values.any()) for values in statistics.values())
    assert not bool(found["means"].any())


@pytest.mark.parametrize("wide", [1, 17])
def test_panoramas_draw_needed_tiles_on_both_sides_of_the_seam(isa, wide):
    """A Gaussian at the seam is in tiles of both edges of the image; only one of them is needed."""
    scene = random(300, (96, 48), seed=5)
    camera = Camera.panorama(scene.camera.R, scene.camera.eye, 48, 96)
    needed = marked(camera, [(8, 96 - wide, 30, wide)])
    _, expected, _ = differentiated(scene.gaussians(torch.float64), camera, needed, draw_all=True)
    _, found, _ = differentiated(scene.gaussians(torch.float64), camera, needed, draw_all=False)
    for name, values in expected.items():
        assert torch.equal(found[name], values), name


def test_what_is_needed_is_checked():
    scene = SCENES["random"]
    gaussians, camera = scene.gaussians(torch.float32), scene.camera
    whole = marked(camera, [(0, 0, camera.H, camera.W)])
    for needed, error, message in (
        (whole[:-1], ShapeError, "needed"),
        (whole.byte(), ArgumentError, "torch.bool"),
    ):
        with pytest.raises(error, match=message):
            render(gaussians, camera, needed=needed, backend="cpu")
    with pytest.raises(ArgumentError, match="one by one"):
        render(gaussians, [camera, camera], needed=whole, backend="cpu")


def test_other_backends_give_the_needed_pixels():
    """The dense backend draws everything."""
    scene = SCENES["random"]
    needed = marked(scene.camera, [(3, 4, 9, 8)])
    dense = render(scene.gaussians(torch.float64), scene.camera, needed=needed, backend="torch").image
    tiles = render(scene.gaussians(torch.float64), scene.camera, needed=needed, backend="cpu").image
    np.testing.assert_allclose(tiles[needed].detach(), dense[needed].detach(), rtol=0, atol=1e-10)
