"""The usual call of `rasterization` has the values and gradients of the stages that every other call takes."""

import pytest
import torch

import gsplat_witness
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.compat.gsplat import rasterization

W, H = 24, 18
ROUNDING = (
    1e-11  # both compute in float64, in another order; sums of at most W H = 432 numbers of size 1 to 100
)
NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")


def tensors(dtype=torch.float64, lead=(), count=40):
    """Return the tensors of one scene and one camera; `lead` are further axes of size 1."""
    made = gsplat_witness.scene(count=count, cameras=1, dtype=dtype)
    return {
        name: made[name].detach().expand(*lead, *made[name].shape).clone().requires_grad_() for name in NAMES
    }


def drawn(given, **options):
    """Return image, alphas, what `meta` has of the geometry, and the gradients of a weighted sum of all of them."""
    images, alphas, meta = rasterization(**given, width=W, height=H, **options)
    meta["means2d"].retain_grad()
    outputs = {"images": images, "alphas": alphas}
    outputs |= {name: meta[name] for name in ("means2d", "depths", "conics", "opacities")}
    g = torch.Generator().manual_seed(3)
    shown = meta["radii"].amin(dim=-1) > 0  # what is not drawn has no meaning in the tables
    loss = 0.0
    for name, each in outputs.items():
        weights = torch.randn(each.shape, generator=g, dtype=torch.float64).to(each)
        if name not in ("images", "alphas"):
            weights = weights * shown.view(*shown.shape, *([1] * (each.ndim - shown.ndim)))
        loss = loss + (weights * each).sum()
    loss.backward()
    outputs |= {f"gradient of {name}": tensor.grad for name, tensor in given.items()}
    outputs |= {"radii": meta["radii"], "gradient of means2d": meta["means2d"].grad}
    outputs |= {"absgrad": meta["means2d"].absgrad} if options.get("absgrad") else {}
    return {name: each.detach() for name, each in outputs.items()}, meta


def step(meta):
    """Return the name of the step of the graph that made the centres."""
    return type(meta["means2d"].grad_fn).__name__.removesuffix("Backward")


@pytest.mark.parametrize("packed", [False, True], ids=["all", "packed"])
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_values_and_gradients_are_those_of_the_stages(packed, degree):
    options = {"packed": packed, "sh_degree": degree, "absgrad": True}
    found, meta = drawn(tensors(), **options)
    # a background of zeros changes nothing, and only the stages draw one
    wanted, other = drawn(tensors(), backgrounds=torch.zeros(1, 3).double(), **options)
    assert (step(meta), step(other)) == ("_OnScreen", "_Stage")
    assert meta.keys() == other.keys() and found.keys() == wanted.keys()
    for name, value in wanted.items():
        assert found[name].shape == value.shape and found[name].dtype == value.dtype, name
        assert float((found[name] - value).abs().max()) <= ROUNDING * max(1.0, float(value.abs().max())), name
    assert all(float(found[f"gradient of {name}"].abs().max()) > 0 for name in NAMES)


def test_leading_axes_of_one_keep_their_shapes():
    (flat, one), (nested, other) = (
        drawn(tensors(lead=lead), sh_degree=1, packed=False) for lead in ((), (1,))
    )
    assert step(one) == step(other) == "_OnScreen"
    for name, value in flat.items():
        assert torch.equal(nested[name].reshape(value.shape), value), name
    assert nested["images"].shape == (1, 1, H, W, 3) and nested["means2d"].shape == (1, 1, 40, 2)


def test_coefficients_of_a_camera_get_their_gradient():
    given = tensors(torch.float32)
    wanted, _ = drawn(given, sh_degree=3)
    own = tensors(torch.float32)
    own["colors"] = own["colors"].detach()[None].requires_grad_()
    found, meta = drawn(own, sh_degree=3)
    assert step(meta) == "_OnScreen"
    assert torch.equal(found["gradient of colors"][0], wanted["gradient of colors"])


def test_sparse_gradients_are_the_dense_ones():
    (wanted, _), (found, meta) = (
        drawn(tensors(), sh_degree=2, sparse_grad=sparse) for sparse in (False, True)
    )
    assert step(meta) == "_OnScreen"
    for name in ("means", "quats", "scales"):
        sparse = found[f"gradient of {name}"]
        assert sparse.is_sparse and torch.equal(sparse.to_dense(), wanted[f"gradient of {name}"]), name


@pytest.mark.parametrize("count", [0, 3])
def test_an_image_without_gaussians_is_black(count):
    given = {name: tensor.detach() for name, tensor in tensors(count=4).items()}
    given = {name: t if name in ("viewmats", "Ks") else t[:count] for name, t in given.items()}
    given["means"] = given["means"] * 0 - 5.0  # behind the camera
    for tensor in given.values():
        tensor.requires_grad_()
    images, alphas, meta = rasterization(**given, width=W, height=H, sh_degree=3)
    (images.sum() + alphas.sum()).backward()
    assert not images.any() and not alphas.any() and meta["means2d"].shape == (0, 2)
    assert all(not tensor.grad.any() for tensor in given.values())


@pytest.mark.parametrize("threads", [2, 3])
def test_the_bits_do_not_depend_on_the_threads(threads):
    found = []
    for number in (1, threads):
        torch.set_num_threads(number)
        try:
            found.append(drawn(tensors(torch.float32, count=12_000), sh_degree=3, absgrad=True)[0])
        finally:
            torch.set_num_threads(1)
    for name, value in found[0].items():
        assert torch.equal(found[1][name], value), name


def test_second_derivatives_are_refused_by_name():
    given = tensors()
    images, _, _ = rasterization(**given, width=W, height=H, sh_degree=1)
    with pytest.raises(ArgumentError, match="gsplat's rasterization has first derivatives only"):
        torch.autograd.grad(images.sum(), given["means"], create_graph=True)


def test_a_second_backward_pass_needs_the_graph():
    given = tensors()
    images, _, _ = rasterization(**given, width=W, height=H, sh_degree=1)
    (once,) = torch.autograd.grad(images.sum(), given["means"], retain_graph=True)
    (twice,) = torch.autograd.grad(images.sum(), given["means"])
    assert torch.equal(once, twice)
    with pytest.raises(RuntimeError, match="retain_graph=True"):
        torch.autograd.grad(images.sum(), given["means"])
