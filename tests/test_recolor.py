"""Colours through a matrix: the native kernel against torch, gradients in float64, saturated photos."""

import pytest
import torch

from gsplat_edu import ArgumentError, kernels
from gsplat_edu.errors import ShapeError
from gsplat_edu.recolor import recolored


def scene(dtype, size=(9, 15), seed=0):
    """An image around 0 to 1, a matrix near the identity, and a photo of which a tenth is saturated."""
    generator = torch.Generator().manual_seed(seed)
    image = 1.4 * torch.rand(*size, 3, generator=generator, dtype=torch.float64) - 0.1
    matrix = torch.eye(3, 4, dtype=torch.float64) + 0.2 * torch.randn(
        3, 4, generator=generator, dtype=torch.float64
    )
    photo = torch.randint(0, 256, (*size, 3), generator=generator, dtype=torch.uint8)
    photo[torch.rand(*size, generator=generator) < 0.1] = 255
    return image.to(dtype), matrix.to(dtype), photo


def in_torch(monkeypatch, *arguments):
    monkeypatch.setattr(kernels, "REASON", "hidden by a test")
    return recolored(*arguments)


@pytest.mark.parametrize("size", [(1, 1), (3, 21), (8, 8), (70, 130)])
@pytest.mark.parametrize("with_photo", [False, True])
def test_the_kernel_is_torchs_formula_in_value_and_gradients(monkeypatch, size, with_photo):
    """float64; a sum of 27,300 products of up to 2 rounds by less than 1e-11."""
    image, matrix, photo = scene(torch.float64, size)
    weights, results = torch.linspace(-1, 1, image.numel(), dtype=torch.float64).reshape(image.shape), []
    for native in (True, False):
        x, m = image.clone().requires_grad_(), matrix.clone().requires_grad_()
        arguments = (x, m, photo if with_photo else None)
        out = recolored(*arguments) if native else in_torch(monkeypatch, *arguments)
        (out * weights).sum().backward()
        results.append((out.detach(), x.grad, m.grad))
    for ours, expected in zip(*results, strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-12, atol=1e-11)


def test_gradients_are_proven_by_finite_differences():
    """The function is linear except where a saturated photo cuts it at 1; no such value is within 1e-3 of 1."""
    image, matrix, photo = scene(torch.float64, (8, 11))
    cut = recolored(image, matrix)[photo == 255]
    assert (cut > 1).any() and (cut < 1).any() and ((cut - 1).abs() > 1e-3).all()
    x, m = image.requires_grad_(), matrix.requires_grad_()
    assert torch.autograd.gradcheck(lambda a, b: recolored(a, b, photo), (x, m))
    assert torch.autograd.gradcheck(lambda a: recolored(a, m.detach(), photo), (x,)), "without the matrix's"


def test_a_saturated_photo_asks_for_no_less_light():
    image = torch.tensor([[[0.9, 0.9, 0.9]], [[0.2, 0.9, 0.9]]], requires_grad=True)
    matrix = torch.eye(3, 4) * 1.25
    photo = torch.tensor([[[255, 254, 255]], [[255, 255, 0]]], dtype=torch.uint8)
    out = recolored(image, matrix, photo)
    expected = torch.tensor([[[1.0, 1.125, 1.0]], [[0.25, 1.0, 1.125]]])
    torch.testing.assert_close(out, expected)
    out.sum().backward()
    passes = (expected != 1.0).float()
    torch.testing.assert_close(image.grad, 1.25 * passes)


def test_the_bits_do_not_depend_on_the_threads():
    image, matrix, photo = scene(torch.float32, (211, 157))
    found, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            x, m = image.clone().requires_grad_(), matrix.clone().requires_grad_()
            out = recolored(x, m, photo)
            out.backward(torch.linspace(0, 1, out.numel()).reshape(out.shape))
            found.append((out.detach(), x.grad, m.grad))
    finally:
        torch.set_num_threads(before)
    for others in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], others, strict=True))


@pytest.mark.usefixtures("as_shipped")  # otherwise annotations are checked before the arguments
def test_wrong_arguments_are_named():
    image, matrix, photo = scene(torch.float32)
    with pytest.raises(ShapeError, match="^matrix"):
        recolored(image, matrix[:2])
    with pytest.raises(ShapeError, match="^photo"):
        recolored(image, matrix, photo[1:])
    with pytest.raises(ArgumentError, match="^matrix: is torch.float64"):
        recolored(image, matrix.double())


def test_the_native_border_refuses_what_does_not_fit():
    image, matrix, photo = scene(torch.float32)
    fine = {"image": image, "matrix": matrix, "photo": photo, "out": torch.empty_like(image), "threads": 1}
    call = kernels.kernel("recolor_f", torch.float32)
    call(**fine)
    for name, wrong in {
        "matrix": matrix.T.contiguous(),
        "photo": photo[:, 1:].contiguous(),
        "image": image.double(),
        "out": torch.empty(3, 3, 3),
        "threads": 0,
    }.items():
        with pytest.raises(ValueError, match=f"^recolor: {name}"):
            call(**{**fine, name: wrong})
    back = {key: value for key, value in fine.items() if key != "out"} | {"grad": image, "grad_matrix": None}
    with pytest.raises(ValueError, match="^recolor_backward: grad_image"):
        kernels.kernel("recolor_backward_f", torch.float32)(**back, grad_image=torch.empty(2, 2, 3))
