"""The loss on normals and the normals of Gaussians, natively and from their definitions, on every instruction set."""

import dataclasses

import pytest
import torch

from gsplat_edu import Camera
from gsplat_edu.base.threads import one_thread
from gsplat_edu.ops.surface import (
    JUMP,
    normal_error,
    normal_error_in_torch,
    normals_of_depth,
    planar_depth,
)
from gsplat_edu.render.planes import facing_normals, facing_normals_in_torch
from native_scenes import smooth_scene


def maps_of_a_bumpy_surface(H, W, dtype=torch.float64):
    """Return a camera, and normals, depth and alpha of a wavy surface with normals that are 0.1 off."""
    camera = Camera.looking_at((0.3, -0.5, -3), (0, 0, 0), 1.1 * W, 1.05 * W, H, W)
    generator = torch.Generator().manual_seed(0)
    rays = torch.from_numpy(camera.rays())
    v, u = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    z = 3 + 0.3 * torch.sin(6 * u / W) + 0.2 * torch.cos(7 * v / H).double()
    noise = 0.1 * torch.randn(H, W, 3, dtype=torch.float64, generator=generator)
    normals = torch.nn.functional.normalize(normals_of_depth(z, rays) + noise, dim=-1)
    alpha = 0.6 + 0.4 * torch.rand(H, W, dtype=torch.float64, generator=generator)
    tensors = (normals * alpha[..., None], z * alpha, alpha)
    return camera, [tensor.to(dtype).requires_grad_() for tensor in tensors]


def test_the_native_loss_on_normals_is_its_definition(isa):
    camera, inputs = maps_of_a_bumpy_surface(9, 13)
    inputs[2].data[4, 5] = 0.0  # nothing is drawn there
    inputs[1].data[4, 5] = 0.0
    inputs[1].data[:, 9] *= 1 + 2 * JUMP  # an edge
    values = [f(*inputs, camera, 1.7) for f in (normal_error, normal_error_in_torch)]
    assert abs(values[0] - values[1]) < 1e-14 and values[1] > 1e-4
    found, expected = (torch.autograd.grad(value, inputs) for value in values)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-14)
        assert other.abs().max() > 1e-5


def test_gradients_of_the_loss_on_normals(isa):
    """The mask of pixels with a normal is constant near the inputs: no alpha is 0, and no depth jumps.

    Alpha is a factor, which counts as a constant; its gradient is compared with that of the definition above.
    """
    camera, inputs = maps_of_a_bumpy_surface(7, 8)
    alpha = inputs[2].detach()
    assert torch.autograd.gradcheck(
        lambda *given: normal_error(*given, alpha, camera, 40.0), inputs[:2], eps=1e-6, atol=1e-7
    )
    normals = inputs[0].detach()
    rays = torch.from_numpy(camera.rays())
    assert torch.autograd.gradcheck(lambda z: normals_of_depth(z, rays), (inputs[1],), eps=1e-6, atol=1e-6)
    planes = torch.cat([normals, -inputs[1].detach()[..., None]], dim=-1).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: planar_depth(p, rays), (planes,), eps=1e-7, atol=1e-5)


def test_the_loss_has_the_same_bits_for_any_number_of_threads():
    camera, inputs = maps_of_a_bumpy_surface(67, 91, torch.float32)
    seen = set()
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            value = normal_error(*inputs, camera)
            gradients = torch.autograd.grad(value, inputs)
            seen.add((float(value.detach()), *(g.numpy().tobytes() for g in gradients)))
    finally:
        torch.set_num_threads(before)
    assert len(seen) == 1


def test_float32_and_flat_surfaces():
    camera, inputs = maps_of_a_bumpy_surface(30, 40, torch.float32)
    wide = [tensor.detach().double() for tensor in inputs]
    # Tangents are differences of neighbouring points, so roundings of 2^-24 grow by z / |t| = fx / 2.
    assert abs(normal_error(*inputs, camera) - normal_error(*wide, camera)) < 22 * 2.0**-23
    rays = torch.from_numpy(camera.rays())
    toward = torch.tensor([0.0, 0.0, -1.0, -2.5], dtype=torch.float64)
    depth = planar_depth(toward.expand(30, 40, 4), rays)
    normals = normals_of_depth(depth, rays)
    opaque = torch.ones_like(depth)
    assert float(normal_error(normals, depth, opaque, camera)) < 1e-15
    assert (normals[1:-1, 1:-1] - toward[:3]).abs().max() < 1e-12 and not normals[0].any()
    assert normal_error(normals, depth, 0 * opaque, camera) == 0


@pytest.mark.parametrize("seed", range(3))
def test_normals_of_gaussians_natively_and_in_torch(seed, isa):
    scene = smooth_scene(seed)
    scene.quats[1] = 0
    gaussians = scene.gaussians().trainable()
    native = facing_normals(gaussians, scene.camera)
    with one_thread():
        dense = facing_normals_in_torch(gaussians, scene.camera.eye)
    torch.testing.assert_close(native, dense, rtol=0, atol=1e-14)
    assert not native[1].any()
    seeds = torch.randn(native.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    found, expected = (torch.autograd.grad(out, gaussians.quats, seeds)[0] for out in (native, dense))
    defined = torch.arange(len(found)) != 1
    torch.testing.assert_close(found[defined], expected[defined], rtol=0, atol=1e-13)
    assert not found[1].any()


def test_huge_tiny_and_broken_quaternions_have_finite_normals():
    scene = smooth_scene(0)
    gaussians = scene.gaussians()
    quats = gaussians.quats.clone()
    reference = facing_normals(gaussians, scene.camera)
    quats[0] *= 1e200
    quats[2] *= 1e-200
    quats[3] = float("nan")
    found = facing_normals(dataclasses.replace(gaussians, quats=quats), scene.camera)
    torch.testing.assert_close(found[[0, 2]], reference[[0, 2]], rtol=0, atol=1e-14)
    assert not found[3].any() and found.isfinite().all()
