import pytest
import torch

from gsplat_edu import ArgumentError
from gsplat_edu.ops.losses import l1, l1_ssim


def test_l1_is_the_mean_over_pixels_and_channels():
    image = torch.zeros(2, 3, 3, dtype=torch.float64, requires_grad=True)
    target = torch.full((2, 3, 3), 0.5, dtype=torch.float64)
    target[0, 0, 0] = -1.0
    loss = l1(image, target)
    assert abs(loss.item() - (17 * 0.5 + 1.0) / 18) < 1e-15
    loss.backward()
    torch.testing.assert_close(image.grad, torch.sign(-target) / 18)


def by_convolution(x, y, weight):
    """Compute the loss from the definition of SSIM, with torch's convolution."""
    taps = torch.exp(-((torch.arange(11, dtype=x.dtype) - 5) ** 2) / (2 * 1.5**2))
    window = torch.outer(taps, taps) / taps.sum() ** 2
    kernel = window[None, None].repeat(3, 1, 1, 1)

    def blur(image):
        return torch.nn.functional.conv2d(image.permute(2, 0, 1)[None], kernel, padding=5, groups=3)

    mx, my = blur(x), blur(y)
    vx, vy, c = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    top = (2 * mx * my + 0.01**2) * (2 * c + 0.03**2)
    ssim = (top / ((mx * mx + my * my + 0.01**2) * (vx + vy + 0.03**2))).mean()
    return (1 - weight) * (x - y).abs().mean() + weight * (1 - ssim)


@pytest.mark.parametrize(
    "size", [(1, 1), (3, 2), (3, 50), (33, 17), (11, 500), (12, 129), (170, 141), (325, 9), (25, 266)]
)
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_l1_ssim_matches_the_definition_in_value_and_gradient(size, weight):
    """In float64, with sizes below the window and above a strip of rows and columns."""
    generator = torch.Generator().manual_seed(0)
    x, y = (torch.rand(*size, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    ours, theirs = x.clone().requires_grad_(), x.clone().requires_grad_()
    loss, truth = l1_ssim(ours, y, weight), by_convolution(theirs, y, weight)
    (3 * loss).backward()
    (3 * truth).backward()
    torch.testing.assert_close(loss.detach(), truth.detach(), rtol=0, atol=1e-13)
    torch.testing.assert_close(ours.grad, theirs.grad, rtol=0, atol=1e-13)


def test_l1_ssim_gradcheck():
    """The loss is smooth, because no pixel is so near its target that a step crosses the corner of |x - y|."""
    generator = torch.Generator().manual_seed(1)
    x, y = (torch.rand(7, 9, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    assert (x - y).abs().min() > 1e-4
    assert torch.autograd.gradcheck(lambda x: l1_ssim(x, y), x.requires_grad_(), eps=1e-6, atol=1e-8)


def test_bytes_are_scaled_to_1_and_float32_is_near_float64():
    """Variances in float32 are differences of numbers up to 1 with 11 + 11 roundings each, an error of 22 eps over C2
    = 9e-4."""
    generator = torch.Generator().manual_seed(2)
    x = torch.rand(40, 30, 3, generator=generator)
    photo = torch.randint(0, 256, (40, 30, 3), generator=generator, dtype=torch.uint8)
    values = [l1_ssim(x, photo), l1_ssim(x, photo.float() / 255), l1_ssim(x.double(), photo.double() / 255)]
    assert abs(float(values[0]) - float(values[1])) < 1e-6
    assert abs(float(values[0]) - float(values[2])) < 22 * 1.2e-7 / 9e-4


@pytest.mark.parametrize("threads", [2, 5])
def test_the_loss_does_not_depend_on_threads(threads):
    before = torch.get_num_threads()
    x = torch.rand(200, 150, 3, generator=torch.Generator().manual_seed(3)).requires_grad_()
    y = torch.rand(200, 150, 3, generator=torch.Generator().manual_seed(4))
    results = []
    try:
        for count in (1, threads):
            torch.set_num_threads(count)
            loss = l1_ssim(x, y)
            results.append((loss.detach(), *torch.autograd.grad(loss, x)))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.usefixtures("as_shipped")
def test_l1_ssim_refuses_other_input():
    image = torch.zeros(4, 5, 3)
    for arguments, names in (
        ((torch.zeros(4, 5), image), "image"),
        ((image, torch.zeros(4, 4, 3)), "target"),
        ((image.half(), image), "image"),
        ((image, image.double()), "target"),
        ((image, image, 1.5), "ssim_weight"),
    ):
        with pytest.raises(ArgumentError, match=f"^{names}: "):
            l1_ssim(*arguments)
