"""torch.compile, torch.func, forward mode, autocast and half precision around renders and losses."""

import numpy as np
import pytest
import torch

from gsplat_edu import Camera, Gaussians, render
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.ops.losses import l1, l1_ssim, l1_ssim_in_torch, photo_loss

CAMERA = Camera.looking_at(eye=[0, 0, -3], target=[0, 0, 0], fx=16, fy=16, H=16, W=16)
TARGET = torch.full((16, 16, 3), 0.4)
HALVES = (torch.float16, torch.bfloat16)

pytestmark = pytest.mark.filterwarnings(
    "ignore:`torch.jit:DeprecationWarning"
)  # torch's own forward mode uses it


@pytest.fixture
def scene():
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return 0.3 * torch.randn(*shape, generator=generator)

    quats = draw(5, 4) / 3 + torch.tensor([1.0, 0, 0, 0])
    return Gaussians(draw(5, 3), quats, draw(5, 3) - 1.0, draw(5, 1, 3), draw(5, 3, 3), draw(5))


def with_means(scene, means):
    return Gaussians(**(scene.tensors() | {"means": means}))


def loss_of(scene, backend="auto"):
    """Return a function of the means that calls a render and each loss."""

    def loss(means):
        image = render(with_means(scene, 1.0 * means), CAMERA, backend=backend).image
        mask = torch.ones(16, 16, dtype=torch.bool)
        terms = l1(image, TARGET) + l1_ssim(image, TARGET) + l1_ssim_in_torch(image, TARGET)
        return 2.0 * terms + photo_loss(image, TARGET, mask) + means.square().sum()

    return loss


def value_and_gradient(loss, means):
    leaf = means.clone().requires_grad_()
    value = loss(leaf)
    value.backward()
    return value.detach(), leaf.grad


@pytest.mark.parametrize("backend", ["eager", pytest.param("inductor", marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore")
def test_a_compiled_function_gives_the_bits_of_the_plain_one(scene, backend):
    torch.compiler.reset()
    loss = loss_of(scene)
    value, gradient = value_and_gradient(loss, scene.means)
    compiled = torch.compile(loss, backend=backend)
    for _ in range(2):  # the first call compiles
        again, its_gradient = value_and_gradient(compiled, scene.means)
        assert torch.allclose(again, value, rtol=1e-6)
        assert torch.allclose(its_gradient, gradient, rtol=1e-5, atol=1e-7)


@pytest.mark.filterwarnings("ignore")
def test_a_whole_step_can_be_compiled(scene):
    torch.compiler.reset()
    loss = loss_of(scene)

    def step(means):
        value = loss(means)
        value.backward()
        return value.detach()

    plain, compiled = (scene.means.clone().requires_grad_() for _ in range(2))
    expected = step(plain)
    assert torch.allclose(torch.compile(step, backend="eager")(compiled), expected, rtol=1e-6)
    assert torch.allclose(compiled.grad, plain.grad, rtol=1e-5, atol=1e-7)


def transforms(loss, means):
    ones = torch.ones_like(means)
    return {
        "grad": lambda: torch.func.grad(loss)(means),
        "vjp": lambda: torch.func.vjp(loss, means)[1](torch.tensor(1.0)),
        "jvp": lambda: torch.func.jvp(loss, (means,), (ones,)),
        "vmap": lambda: torch.vmap(loss)(means[None]),
        "hessian": lambda: torch.func.hessian(loss)(means),
        "double backward": lambda: torch.autograd.functional.hvp(loss, means, ones),
        "forward mode": lambda: forward_mode(loss, means, ones),
    }


def forward_mode(loss, means, tangent):
    with torch.autograd.forward_ad.dual_level():
        return loss(torch.autograd.forward_ad.make_dual(means, tangent))


@pytest.mark.parametrize("name", transforms(None, torch.zeros(1)))
@pytest.mark.parametrize("what", ["render", "l1_ssim"])
def test_what_differentiates_the_kernels_otherwise_is_refused_in_one_line(scene, name, what):
    def loss(values):
        if what == "render":
            return render(with_means(scene, values), CAMERA).image.sum()
        return l1_ssim(values, TARGET)

    given = scene.means if what == "render" else torch.full((16, 16, 3), 0.5)
    with pytest.raises(ArgumentError, match='backend="torch"') as caught:
        transforms(loss, given)[name]()
    assert "\n" not in str(caught.value)


def test_the_backend_torch_has_what_the_message_says(scene):
    def loss(means):
        image = render(with_means(scene, means), CAMERA, backend="torch").image
        return l1_ssim_in_torch(image, TARGET)

    means = scene.means
    _, expected = value_and_gradient(loss, means)
    assert torch.allclose(torch.func.grad(loss)(means), expected, rtol=1e-4, atol=1e-7)
    tangent = torch.linspace(-1, 1, means.numel()).reshape(means.shape)
    _, slope = torch.func.jvp(loss, (means,), (tangent,))
    assert np.isclose(float(slope), float((expected * tangent).sum()), rtol=1e-3)
    _, product = torch.autograd.functional.hvp(loss, means, tangent)
    assert product.isfinite().all() and product.any()
    with pytest.raises(ArgumentError, match='^vmap: .*backend="torch" as well'):
        torch.vmap(loss)(means[None])


@pytest.mark.parametrize("dtype", HALVES)
def test_half_precision_is_refused_by_name(as_shipped, scene, dtype):
    with pytest.raises(ArgumentError, match=r"^quats: is b?float16, .*use quats.float\(\)$"):
        Gaussians(**(scene.tensors() | {"quats": scene.quats.to(dtype)}))
    with pytest.raises(ArgumentError, match=r"^means: is b?float16"):
        scene.map(lambda tensor: tensor.to(dtype))
    for loss in (l1, l1_ssim, l1_ssim_in_torch, photo_loss):
        for name, image, target in (
            ("image", TARGET.to(dtype), TARGET.to(dtype)),
            ("target", TARGET, TARGET.to(dtype)),
        ):
            with pytest.raises(ArgumentError, match=rf"^{name}: is b?float16, .*use {name}.float\(\)$"):
                loss(image, target)
    features = torch.ones(5, 2, dtype=dtype)
    with pytest.raises(ArgumentError, match="^features: are torch.b?float16"):
        render(scene, CAMERA, features=features)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_autocast_changes_no_bit(scene, backend):
    loss = loss_of(scene, backend)
    value, gradient = value_and_gradient(loss, scene.means)
    leaf = scene.means.clone().requires_grad_()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        again = loss(leaf)
        assert torch.is_autocast_enabled("cpu")
        made = torch.ones(5, 3) @ torch.ones(3, 2)  # as a network's output
        features = render(scene, CAMERA, features=made, backend=backend).features
        assert made.dtype == torch.bfloat16 and features.dtype == torch.float32
        assert l1_ssim(TARGET.bfloat16(), TARGET).dtype == torch.float32
    again.backward()
    assert torch.equal(again, value) and torch.equal(leaf.grad, gradient)
