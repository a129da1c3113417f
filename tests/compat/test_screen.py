"""The native steps of gsplat's interface: projection through a pinhole, harmonics, and the order of compositing."""

import pytest
import torch

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.compat.gsplat import rasterization
from gsplat_edu.compat.screen import Lens, Solids, harmonic_colors, through_pinhole
from gsplat_edu.ops.kernels import kernel

LENS = Lens(30, 20, 0.3, 0.01, 1e10, 0.0)
B, C = 2, 2
N = 12_000  # torch splits operations on more than 32,768 numbers between threads


def cameras():
    viewmats = torch.eye(4).double().repeat(B, C, 1, 1)
    viewmats[..., :3, :] += 0.05 * torch.randn(B, C, 3, 4).double()  # any matrix, not only rotations
    viewmats[..., 2, 3] += 3.0
    Ks = torch.tensor([[30.0, 0.0, 15.0], [0.0, 32.0, 10.0], [0.0, 0.0, 1.0]]).double().repeat(B, C, 1, 1)
    return viewmats, Ks


def solids(count):
    means, quats = torch.randn(B, count, 3).double(), torch.randn(B, count, 4).double()
    return means, quats, 0.05 + 0.3 * torch.rand(B, count, 3).double()


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.mark.parametrize("direct", [False, True], ids=["scales", "covariances"])
def test_gradcheck_of_the_projection(direct):
    # Smooth but at the clamp of the Jacobian and at the near plane; no Gaussian here is within 1e-6 of them.
    means, quats, scales = solids(9)
    root = 0.3 * torch.randn(B, 9, 3, 3).double()
    full = root @ root.mT + 0.01 * torch.eye(3)
    covars = full[..., (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]
    shape = [covars] if direct else [quats, scales]
    inputs = [each.clone().requires_grad_() for each in (means, *cameras(), *shape)]

    def projected(means, viewmats, Ks, *shape):
        given = Solids(means, *shape) if direct else Solids(means, None, *shape)
        return through_pinhole(given, viewmats, Ks, LENS, 0.15)[:5]

    assert torch.autograd.gradcheck(projected, inputs, rtol=1e-5)


@pytest.mark.parametrize("degree", range(4))
def test_gradcheck_of_the_harmonics(degree):
    # polynomials of unit directions, smooth away from the direction 0; rows of two images, some of them in both
    directions = torch.randn(7, 3).double().requires_grad_()
    coefficients = torch.randn(6, 16, 3).double().requires_grad_()
    rows, ends = torch.tensor([5, 0, 2, 2, 1, 0, 4]), [3, 7]
    assert torch.autograd.gradcheck(
        lambda d, c: harmonic_colors(degree, d, c, rows, ends), [directions, coefficients]
    )


def test_an_image_without_gaussians_has_no_part_in_the_harmonics():
    coefficients = torch.randn(3, 4, 3).requires_grad_()
    harmonic_colors(1, torch.randn(2, 3), coefficients, torch.tensor([2, 0]), [0, 2, 2]).sum().backward()
    assert bool((coefficients.grad[1] == 0).all()) and bool((coefficients.grad[(0, 2), 0] != 0).all())


def test_the_bits_do_not_depend_on_the_threads():
    means, quats, scales = (each.float() for each in solids(N))
    viewmats, Ks = (each.float() for each in cameras())
    colors = torch.randn(B, N, 16, 3)
    opacities = torch.rand(B, N)

    def gradients(threads):
        torch.set_num_threads(threads)
        given = (means, quats, scales, opacities, colors, viewmats, Ks)
        inputs = [each.clone().requires_grad_() for each in given]
        images, alphas, meta = rasterization(*inputs, 30, 20, sh_degree=3, render_mode="RGB+ED")
        meta["means2d"].retain_grad()
        torch.autograd.backward([images, alphas], [torch.ones_like(images), torch.ones_like(alphas)])
        return [images, alphas, meta["means2d"].grad, *(each.grad for each in inputs)]

    before = torch.get_num_threads()
    try:
        one, three = gradients(1), gradients(3)
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(one, three, strict=True))


def test_equal_depths_keep_the_order_of_the_gaussians_and_nearer_ones_cover():
    means = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    colors = torch.eye(3)
    viewmats, Ks = torch.eye(4)[None].clone(), torch.tensor([[[30.0, 0, 15], [0, 30, 10], [0, 0, 1]]])
    viewmats[:, 2, 3] = 2.0
    rest = (torch.ones(3, 4), torch.ones(3, 3), torch.full((3,), 0.5), colors)
    images, _, _ = rasterization(means, *rest, viewmats, Ks, 30, 20)
    assert images[0, 10, 15].argsort(descending=True).tolist() == [1, 2, 0]


@pytest.mark.parametrize("rows", [[0, 3], [0, -1], [1, 1]], ids=["beyond", "negative", "twice"])
def test_rows_that_the_coefficients_lack_are_refused(rows):
    with pytest.raises(ValueError, match="harmonics: rows: have to be different rows of coefficients"):
        harmonic_colors(0, torch.ones(2, 3), torch.ones(3, 1, 3), torch.tensor(rows), [2])


def test_arrays_of_another_size_never_reach_the_kernels():
    arrays = {
        "means": torch.zeros(2, 3),
        "covars": None,
        "quats": torch.zeros(2, 4),
        "scales": torch.zeros(3, 3),
    }
    numbers = {"viewmat": [0.0] * 12, "K": [1.0] * 4, "size": (3, 3), "margin": 0.1, "eps2d": 0.3}
    with pytest.raises(ValueError, match=r"scales: has to be float32 of shape \(2, 3\)"):
        kernel("screen_f", torch.float32)(**arrays, **numbers, z_near=0.0, z_far=1.0)
    with pytest.raises(ValueError, match=r"spreads: has to be float64 of shape \(1, 3\)"):
        kernel("radii_f", torch.float64)(
            centres=torch.zeros(1, 2).double(), spreads=torch.zeros(1, 2).double()
        )


def test_second_derivatives_are_refused_by_name():
    means, quats, scales = solids(3)
    depths = through_pinhole(
        Solids(means.requires_grad_(), None, quats, scales), *cameras(), LENS, 0.15
    ).depths
    with pytest.raises(ArgumentError, match="gsplat's projection has first derivatives only"):
        torch.autograd.grad(depths.square().sum(), means, create_graph=True)
