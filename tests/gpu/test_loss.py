import math

import pytest
import torch

from gsplat_edu import ArgumentError
from gsplat_edu.ops import kernels
from gsplat_edu.ops.losses import l1_ssim

# Not `triton`, which is the name of this folder if the wheel is missing.
pytest.importorskip("triton.language", reason="triton is not installed")

from gsplat_edu.render.cuda import loss as module
from gsplat_edu.render.cuda.loss import l1_ssim_triton

U = 2.0**-24
"""Half a unit in the last place of float32: the largest relative error of one rounding."""


def blur(planes):
    """Blur (H, W, 3) along both axes by two products with dense matrices."""

    def matrix(n):
        apart = torch.arange(n, dtype=torch.float64)[:, None] - torch.arange(n)
        taps = torch.exp(-(apart**2) / (2 * 1.5**2)) * (apart.abs() <= 5)
        return taps / torch.exp(-(torch.arange(-5, 6, dtype=torch.float64) ** 2) / (2 * 1.5**2)).sum()

    return torch.einsum("ih,hwc,jw->ijc", matrix(planes.shape[0]), planes, matrix(planes.shape[1]))


def maps(x, y):
    """Return the means and the four factors of S."""
    mx, my = blur(x), blur(y)
    v, c = blur(x * x + y * y) - mx * mx - my * my, blur(x * y) - mx * my
    return mx, my, 2 * mx * my + 0.01**2, 2 * c + 0.03**2, mx * mx + my * my + 0.01**2, v + 0.03**2


def by_definition(x, y, weight):
    _, _, A1, A2, B1, B2 = maps(x, y)
    return (1 - weight) * (x - y).abs().mean() + weight * (1 - (A1 * A2 / (B1 * B2)).mean())


def natively(x, y, weight):
    return l1_ssim(x, y, weight)


REFERENCES = [by_definition] if kernels.REASON else [by_definition, natively]


def bounds(x, y, weight):
    """Bound the error of float32 against float64, for the loss and for each number of the gradient. Images are >= 0.

    The bound is the worst case to first order in U, plus 1/10 for the higher orders; e_z is the error of z, r_z the
    relative one. A blur along one axis rounds a term in its tap, its pair's sum, its product and five additions: 8 U,
    so 16 U along both. A square or product of bytes / 255 adds at most 8 U. So every blurred moment has a relative
    error of 24 U. The rest follows the rules for products and sums, with one rounding per operation and 4 U for the
    GPU's division. Errors of dS/dv and dS/dc recur in dS/dmx = free - 2 mx dS/dv - my dS/dc. Together, they change
    the gradient at x by e_dv times 2 |x - mx|, which is at most 2 |x - a| + 2 |mx - a| for any a, and by e_dc likewise.
    """
    mx, my, A1, A2, B1, B2 = maps(x, y)
    squares, product = blur(x * x + y * y), blur(x * y)
    e_mx, e_my = 24 * U * mx, 24 * U * my
    e_v = 24 * U * squares + 2 * mx * e_mx + 2 * my * e_my + 4 * U * (squares + mx * mx + my * my)
    e_c = 24 * U * product + mx * e_my + my * e_mx + 3 * U * (product + mx * my)
    r_A1 = 2 * (mx * e_my + my * e_mx) / A1 + 3 * U
    e_A2 = 2 * e_c + 3 * U * (2 * (product + mx * my) + 0.03**2)
    r_B1 = (2 * mx * e_mx + 2 * my * e_my) / B1 + 4 * U
    r_B2 = e_v / B2 + 2 * U
    inverse, r_inverse = 1 / (B1 * B2), r_B1 + r_B2 + 5 * U
    S = A1 * A2 * inverse
    e_S = S.abs() * (r_A1 + r_inverse + 2 * U) + A1 * inverse * e_A2
    dv, dc = S.abs() / B2, 2 * A1 * inverse
    e_dv = B1 * inverse * e_S + dv * (r_B1 + r_inverse + 2 * U)
    e_dc = dc * (r_A1 + r_inverse + 2 * U)
    # free = 2 (my A2 - mx S B2) / (B1 B2), and S B2 = A2 A1 / B1 independently of B2's error.
    slope = (my - mx * A1 / B1).abs()
    sizes = A2.abs() * (my + mx * A1 / B1)
    e_free = e_A2 * slope + A2.abs() * (e_my + A1 / B1 * e_mx + mx * A1 / B1 * (r_A1 + r_B1)) + 10 * U * sizes
    e_free = 2 * inverse * (e_free + A2.abs() * slope * r_inverse)
    size_dm = 2 * inverse * sizes + 2 * mx * dv + my * dc
    e_free += 2 * e_mx * dv + e_my * dc + 4 * U * size_dm
    e_d = 24 * U * (blur(size_dm) + 2 * x * blur(dv) + y * blur(dc)) + blur(e_free)
    for values, means, e in ((x, mx, 2 * e_dv), (y, my, e_dc)):
        a = values.mean()
        e_d += (values - a).abs() * blur(e) + blur((means - a).abs() * e)
    n = x.numel()
    e_gradient = (1 - weight) / n * 3 * U + weight / n * e_d
    # Sums are trees or pairwise, with at most 32 additions per number within its block and as many among blocks.
    lost = weight / n * (e_S + U + 70 * U * (1 - S).abs()) + (1 - weight) / n * 73 * U * (x + y)
    return 1.1 * lost.sum(), 1.1 * e_gradient


def images(size, kind, seed=0):
    """Return an image and a target whose numbers all differ by more than float32 rounding, so that L1 is smooth."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(*size, 3, generator=generator)
    target = torch.rand(*size, 3, generator=generator)
    if kind == "bytes":
        target = torch.randint(0, 256, (*size, 3), generator=generator, dtype=torch.uint8)
    if kind == "flat":  # variances near 0, where rounding is largest relative to C2
        image, target = 0.8 + 0.01 * (image - 0.5), torch.full((*size, 3), 203, dtype=torch.uint8)
    assert (image.double() - as_double(target)).abs().min() > 4 * U
    return image, target


def as_double(target):
    return target.double() / 255 if target.dtype == torch.uint8 else target.double()


def value_and_gradient(loss, image, target, weight):
    image = image.clone().requires_grad_()
    value = loss(image, target, weight)
    value.backward()
    return value.detach().cpu().double(), image.grad.cpu().double()


@pytest.mark.parametrize(
    ("size", "kind", "weight"),
    [
        *(((1, 1), "bytes", 0.2), ((3, 50), "floats", 1.0), ((3, 50), "bytes", 0.0), ((19, 23), "flat", 1.0)),
        *(
            ((19, 23), "bytes", 0.2),
            ((33, 48), "floats", 0.0),
            ((33, 48), "bytes", 1.0),
            ((33, 48), "flat", 0.2),
        ),
    ],
)
def test_value_and_gradient_match_float64(device, size, kind, weight):
    """The sizes are below the window or above one block, and not multiples of a block."""
    image, target = images(size, kind)
    value, gradient = value_and_gradient(l1_ssim_triton, image.to(device), target.to(device), weight)
    x, y = image.double(), as_double(target)
    e_value, e_gradient = bounds(x, y, weight)
    for reference in REFERENCES:
        true_value, true_gradient = value_and_gradient(reference, x, y, weight)
        assert e_value < 0.01 and e_gradient.max() < 0.04 * true_gradient.abs().max()
        assert (value - true_value).abs() <= e_value
        assert ((gradient - true_gradient).abs() <= e_gradient).all()


def test_a_slightly_wrong_window_exceeds_the_bound(monkeypatch):
    """A window that is 1 % too narrow exceeds the bound, which is therefore tight enough to find errors."""
    x, y = (t.double() for t in images((19, 23), "floats"))
    e_value, e_gradient = bounds(x, y, 0.2)
    exp = torch.exp
    truth = value_and_gradient(by_definition, x, y, 0.2)
    monkeypatch.setattr(torch, "exp", lambda t: exp(1.01 * t))
    other = value_and_gradient(by_definition, x, y, 0.2)
    assert (truth[0] - other[0]).abs() > e_value
    assert ((truth[1] - other[1]).abs() > e_gradient).double().mean() > 0.9


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_results_are_reproducible_and_independent_of_memory_contents(device, weight):
    image, target = (t.to(device) for t in images((19, 23), "bytes"))
    plain = value_and_gradient(l1_ssim_triton, image, target, weight)
    again = value_and_gradient(l1_ssim_triton, image, target, weight)
    torch.use_deterministic_algorithms(True)  # makes torch fill new memory with NaN
    try:
        assert image.new_empty(1).isnan()
        filled = value_and_gradient(l1_ssim_triton, image, target, weight)
    finally:
        torch.use_deterministic_algorithms(False)
    assert all(torch.equal(a, b) and torch.equal(a, c) for a, b, c in zip(plain, again, filled, strict=True))


def test_without_ssim_weight_nothing_is_blurred(device, monkeypatch):
    for name in ("moments_kernel", "similarity_kernel", "maps_kernel"):
        monkeypatch.setattr(module, name, None)
    image, target = (t.to(device) for t in images((3, 5), "floats"))
    value, gradient = value_and_gradient(l1_ssim_triton, image, target, 0.0)
    torch.testing.assert_close(value.float(), (image - target).abs().mean().cpu(), rtol=10 * U, atol=0)
    torch.testing.assert_close(gradient, torch.sign(image - target).cpu().double() / 45, rtol=2 * U, atol=0)


def test_equal_image_and_target_give_zero_loss_and_gradient(device):
    """S is 1 up to rounding, and |x - y| has slope 0 at its corner, so the gradient is rounding within the bound."""
    image, _ = images((19, 23), "floats")
    value, gradient = value_and_gradient(l1_ssim_triton, image.to(device), image.to(device), 0.2)
    e_value, e_gradient = bounds(image.double(), image.double(), 0.2)
    assert value.abs() <= e_value
    assert (gradient.abs() <= e_gradient).all()


def test_the_gradient_scales_and_ignores_strides(device):
    image, target = (t.to(device) for t in images((19, 23), "bytes"))
    _, gradient = value_and_gradient(l1_ssim_triton, image, target, 0.2)
    strided = image.transpose(0, 1).contiguous().transpose(0, 1).requires_grad_()
    (4 * l1_ssim_triton(strided, target.transpose(0, 1).contiguous().transpose(0, 1), 0.2)).backward()
    assert not strided.is_contiguous()
    assert torch.equal(strided.grad.cpu().double(), 4 * gradient)


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_the_loss_of_an_empty_image_is_nan(device, weight):
    image = torch.zeros(0, 5, 3, device=device, requires_grad=True)
    loss = l1_ssim_triton(image, torch.zeros(0, 5, 3, device=device), weight)
    loss.backward()
    assert math.isnan(loss.detach()) and image.grad.shape == (0, 5, 3)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU to wait for")
def test_the_loss_does_not_synchronise(device):
    image, target = (t.to(device) for t in images((33, 48), "bytes"))
    image.requires_grad_()
    l1_ssim_triton(image, target, 0.2).backward()  # the first call compiles
    torch.cuda.set_sync_debug_mode("error")
    try:
        l1_ssim_triton(image, target, 0.2).backward()
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.usefixtures("as_shipped")
def test_other_input_is_refused(device):
    image = torch.zeros(4, 5, 3, device=device)
    for arguments, names in (
        ((torch.zeros(4, 5), image), "image"),
        ((image, torch.zeros(4, 4, 3)), "target"),
        ((image.double(), image), "image"),
        ((image, image.double()), "target"),
        ((image, image.to("meta")), "target"),
        ((image, image, 1.5), "ssim_weight"),
    ):
        with pytest.raises(ArgumentError, match=f"^{names}: "):
            l1_ssim_triton(*arguments)
