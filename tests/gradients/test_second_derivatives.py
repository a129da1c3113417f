"""Functions with gradients by hand refuse to be differentiated twice; the backend torch has second derivatives."""

import importlib
import pkgutil

import numpy as np
import pytest
import torch

import gsplat_edu
from gsplat_edu import Camera, Gaussians, load_backend, render
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.compat.gsplat import rasterization
from gsplat_edu.ops.depth import DepthRule, depth_error
from gsplat_edu.ops.losses import l1_ssim, l1_ssim_in_torch
from gsplat_edu.ops.recolor import recolored_in_torch, recolored_natively
from gsplat_edu.render.planes import facing_normals

CAMERA = Camera.looking_at(eye=[0, 0, -3], target=[0, 0, 0], fx=16, fy=16, H=16, W=16)
OPTIONAL = (
    "triton",
    "wgpu",
    "pycolmap",
    "dask",
    "distributed",
    "xatlas",
    "coacd",
    "pxr",
    "uvicorn",
    "starlette",
)


def functions():
    """Return all autograd functions of the package, after importing every module whose packages are installed."""
    for module in pkgutil.walk_packages(gsplat_edu.__path__, "gsplat_edu."):
        if module.name.endswith("__main__"):
            continue
        try:
            importlib.import_module(module.name)
        except ImportError as error:
            assert (error.name or "").split(".")[0] in OPTIONAL, f"{module.name}: {error}"
    found, classes = [], [torch.autograd.Function]
    while classes:
        for kind in classes.pop().__subclasses__():
            classes.append(kind)
            found += [kind] if kind.__module__.startswith("gsplat_edu.") else []
    return sorted(set(found), key=lambda kind: (kind.__module__, kind.__name__))


def test_every_autograd_function_has_the_guard():
    """With gradients enabled, as autograd does for create_graph, a backward pass raises before it looks at anything."""
    found = functions()
    names = {kind.__name__ for kind in found}
    assert {
        "_Rasterize",
        "_L1Ssim",
        "_Recolored",
        "_PatchError",
        "_NormalError",
        "_DepthError",
        "_Normals",
    } <= names
    for kind in found:
        with (
            torch.enable_grad(),
            pytest.raises(ArgumentError, match="create_graph: .* first derivatives only; .* use"),
        ):
            kind.backward(None, None)


def scene(dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return 0.3 * torch.randn(*shape, generator=generator, dtype=torch.float64)

    quats = draw(5, 4) / 3 + torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    parts = [draw(5, 3), quats, draw(5, 3) - 1.0, draw(5, 1, 3), draw(5, 0, 3), draw(5)]
    return Gaussians(*(part.to(dtype) for part in parts))


def with_means(means, gaussians):
    return Gaussians(**(gaussians.tensors() | {"means": means}))


LOSSES = {
    "linear": lambda image: image.sum(),
    "quadratic": lambda image: image.square().mean(),
    "photometric": lambda image: l1_ssim_in_torch(image, torch.full_like(image, 0.4), 0.2),
}


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("how", ["create_graph", "hvp", "hessian", "penalty", "backward"])
def test_the_native_renderer_refuses_second_derivatives(loss, how):
    """A linear loss is the case that torch's own guard lets pass with zeros: its incoming gradient is constant."""
    gaussians, backend = scene(), load_backend("cpu")

    def value(means):
        return LOSSES[loss](render(with_means(means, gaussians), CAMERA, backend=backend).image)

    means = gaussians.means.clone().requires_grad_()
    with pytest.raises(ArgumentError, match='backend="torch"') as caught:
        if how == "create_graph":
            torch.autograd.grad(value(means), means, create_graph=True)
        elif how == "hvp":
            torch.autograd.functional.hvp(value, gaussians.means, torch.ones_like(means))
        elif how == "hessian":
            torch.autograd.functional.hessian(value, gaussians.means)
        elif how == "penalty":
            (slope,) = torch.autograd.grad(value(means), means, create_graph=True)
            slope.square().sum().backward()
        else:
            value(means).backward(create_graph=True)
    assert "\n" not in str(caught.value) and "cpu" in str(caught.value)
    torch.autograd.grad(value(means), means)  # first derivatives work all the same


def test_a_deferred_backward_pass_refuses_second_derivatives():
    gaussians = scene(torch.float32)
    leaves = Gaussians(**{name: tensor.requires_grad_() for name, tensor in gaussians.tensors().items()})
    output = render(leaves, CAMERA, backend=load_backend("cpu"))
    assert output.defer is not None
    output.defer()
    with pytest.raises(ArgumentError, match='backend="torch"'):
        output.image.sum().backward(create_graph=True)


def test_gsplats_interface_refuses_second_derivatives():
    gaussians = scene(torch.float32)
    K = torch.tensor([[[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]])
    view = torch.eye(4)[None].clone()
    view[0, 2, 3] = 3.0

    def value(means):
        colors = torch.full((5, 3), 0.6)
        image, *_ = rasterization(
            means,
            gaussians.quats,
            gaussians.log_scales.exp(),
            gaussians.logit_opacities.sigmoid(),
            colors,
            view,
            K,
            16,
            16,
        )
        return image.sum()

    with pytest.raises(ArgumentError, match='backend="torch"'):
        torch.autograd.functional.hvp(value, gaussians.means, torch.ones(5, 3))


def test_losses_refuse_second_derivatives():
    """Each names what has them."""
    image = torch.rand(
        16, 16, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    ).requires_grad_()
    target, matrix = torch.full_like(image, 0.3).detach(), torch.eye(3, 4, dtype=torch.float64)
    depth = image[..., 0]
    places, given = torch.tensor([[3.0, 4.0], [5.5, 6.5]]).double(), torch.ones(2, dtype=torch.float64)
    rule = DepthRule(1.0)
    gaussians = scene()
    quats = gaussians.quats.clone().requires_grad_()
    turned = Gaussians(**(gaussians.tensors() | {"quats": quats}))
    cases = {
        "l1_ssim_in_torch": lambda: (l1_ssim(image, target), image),
        "recolored_in_torch": lambda: (recolored_natively(image, matrix).sum(), image),
        "torch's own operations": lambda: (
            depth_error(depth, torch.ones_like(depth).detach(), places, given, given, rule), image,
        ),
        "facing_normals_in_torch": lambda: (facing_normals(turned, CAMERA).sum(), quats),
    }  # fmt: skip
    for name, case in cases.items():
        value, leaf = case()
        with pytest.raises(ArgumentError, match=name):
            torch.autograd.grad(value, leaf, create_graph=True)


@pytest.mark.parametrize("loss", LOSSES)
def test_the_backend_torch_has_second_derivatives(loss):
    """Hessian times vector, against central differences of first derivatives, which gradcheck covers.

    The scene is smooth: no colour at 0, no alpha at 0.99, depths apart; that no alpha passes 1 / 255 within the step is
    seen in the agreement. A step of 1e-5 has a truncation error of 1e-10 and a rounding error of 1e-11, relatively.
    """
    gaussians, backend = scene(), load_backend("torch")
    direction = torch.randn(5, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def value(means):
        return LOSSES[loss](render(with_means(means, gaussians), CAMERA, backend=backend).image)

    def slope(means):
        means = means.clone().requires_grad_()
        return torch.autograd.grad(value(means), means)[0]

    _, product = torch.autograd.functional.hvp(value, gaussians.means, direction)
    h = 1e-5
    expected = (slope(gaussians.means + h * direction) - slope(gaussians.means - h * direction)) / (2 * h)
    assert product.abs().max() > 1e-3, "the second derivative is no zero"
    np.testing.assert_allclose(product, expected, rtol=1e-5, atol=1e-7 * float(product.abs().max()))


def test_recoloring_by_torch_has_second_derivatives():
    image = torch.rand(
        4, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    ).requires_grad_()
    matrix = torch.eye(3, 4, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradgradcheck(recolored_in_torch, (image, matrix))
