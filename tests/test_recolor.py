"""Colours times a matrix: the native kernel equals torch; gradients in float64, saturated photos, backgrounds."""

import numpy as np
import pytest
import torch

from gsplat_edu import ArgumentError
from gsplat_edu.base.errors import ShapeError
from gsplat_edu.ops import kernels
from gsplat_edu.ops.recolor import Backdrop, recolored, recolored_in_torch, recolored_natively

BACKGROUND = (0.3, 0.9, 0.6)


def scene(dtype, size=(9, 15), seed=0):
    """Return an image of values about 0 to 1, a matrix near the identity, and a photo of which a tenth is saturated."""
    generator = torch.Generator().manual_seed(seed)
    image = 1.4 * torch.rand(*size, 3, generator=generator, dtype=torch.float64) - 0.1
    matrix = torch.eye(3, 4, dtype=torch.float64) + 0.2 * torch.randn(
        3, 4, generator=generator, dtype=torch.float64
    )
    photo = torch.randint(0, 256, (*size, 3), generator=generator, dtype=torch.uint8)
    photo[torch.rand(*size, generator=generator) < 0.1] = 255
    return image.to(dtype), matrix.to(dtype), photo


def backdrop(dtype, size=(9, 15)):
    """Return transmittances from 0 to 1, and a background."""
    generator = torch.Generator().manual_seed(9)
    return Backdrop(torch.rand(*size, generator=generator, dtype=torch.float64).to(dtype), BACKGROUND)


def corners(dtype, size=(9, 15)):
    """Return a falloff from 0.5 to 1.3."""
    generator = torch.Generator().manual_seed(11)
    return (0.5 + 0.8 * torch.rand(*size, generator=generator, dtype=torch.float64)).to(dtype)


@pytest.mark.parametrize("size", [(1, 1), (3, 21), (8, 8), (70, 130)])
@pytest.mark.parametrize("with_photo", [False, True])
@pytest.mark.parametrize("with_background", [False, True])
@pytest.mark.parametrize("with_falloff", [False, True])
def test_the_kernel_equals_torchs_formula_in_value_and_gradients(
    size, with_photo, with_background, with_falloff
):
    """In float64, a sum of 27,300 products of up to 2 rounds by less than 1e-11."""
    image, matrix, photo = scene(torch.float64, size)
    weights, results = torch.linspace(-1, 1, image.numel(), dtype=torch.float64).reshape(image.shape), []
    for native in (True, False):
        x, m = image.clone().requires_grad_(), matrix.clone().requires_grad_()
        given = backdrop(torch.float64, size) if with_background else None
        t = given.transmittance.requires_grad_() if given else torch.ones((), requires_grad=True)
        plane = corners(torch.float64, size) if with_falloff else None
        arguments = (x, m, photo if with_photo else None, given, plane)
        out = (recolored_natively if native else recolored_in_torch)(*arguments)
        (out * weights).sum().backward()
        results.append((out.detach(), x.grad, m.grad, t.grad))
    assert (results[0][3] is None) == (not with_background)
    for ours, expected in zip(*(found[: 3 + with_background] for found in results), strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-12, atol=1e-11)


def test_gradients_are_proven_by_finite_differences():
    """The function is linear except where a saturated photo clips it at 1, and no such value is within 1e-3 of 1."""
    image, matrix, photo = scene(torch.float64, (8, 11))
    cut = recolored(image, matrix)[photo == 255]
    assert (cut > 1).any() and (cut < 1).any() and ((cut - 1).abs() > 1e-3).all()
    x, m = image.requires_grad_(), matrix.requires_grad_()
    assert torch.autograd.gradcheck(lambda a, b: recolored(a, b, photo), (x, m))
    assert torch.autograd.gradcheck(lambda a: recolored(a, m.detach(), photo), (x,)), (
        "without the gradient of the matrix"
    )


@pytest.mark.parametrize("with_falloff", [False, True])
def test_gradients_before_a_background_are_proven_by_finite_differences(with_falloff):
    """The function is linear in image and transmittance, and bilinear with the matrix."""
    image, matrix, photo = scene(torch.float64, (8, 11))
    given, plane = backdrop(torch.float64, (8, 11)), corners(torch.float64, (8, 11)) if with_falloff else None
    cut = recolored(image, matrix, None, given, plane)[photo == 255]
    assert (cut > 1).any() and (cut < 1).any() and ((cut - 1).abs() > 1e-3).all()
    tensors = [tensor.requires_grad_() for tensor in (image, matrix, given.transmittance)]
    assert torch.autograd.gradcheck(
        lambda a, b, t: recolored(a, b, photo, Backdrop(t, BACKGROUND), plane), tensors
    )
    if with_falloff:
        assert torch.autograd.gradcheck(lambda a, b: recolored(a, b, photo, None, plane), tensors[:2])


def test_the_object_is_recoloured_and_the_background_stays():
    """The test corrects premultiplied colours and composites them in float64 NumPy, equal up to a few roundings."""
    rng = np.random.default_rng(4)
    colors, opacity = rng.uniform(size=(7, 9, 3)), rng.uniform(size=(7, 9))
    opacity[0], opacity[1] = 0.0, 1.0
    matrix, background = np.eye(3, 4) + 0.2 * rng.normal(size=(3, 4)), np.array(BACKGROUND)
    premultiplied = colors * opacity[..., None]
    image = premultiplied + background * (1 - opacity)[..., None]
    straight = colors @ matrix[:, :3].T + matrix[:, 3]
    falloff = rng.uniform(0.5, 1.2, size=(7, 9))
    darker = falloff[..., None] * (straight + 0.055) - 0.055
    given = Backdrop(torch.from_numpy(1 - opacity), BACKGROUND)
    for corrected, plane in ((straight, None), (darker, torch.from_numpy(falloff))):
        expected = corrected * opacity[..., None] + background * (1 - opacity)[..., None]
        found = recolored(torch.from_numpy(image), torch.from_numpy(matrix), None, given, plane)
        np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found[0].numpy(), np.broadcast_to(background, (9, 3)), rtol=0, atol=1e-12)


def test_a_saturated_photo_has_no_gradient_where_the_render_is_brighter():
    image = torch.tensor([[[0.9, 0.9, 0.9]], [[0.2, 0.9, 0.9]]], requires_grad=True)
    matrix = torch.eye(3, 4) * 1.25
    photo = torch.tensor([[[255, 254, 255]], [[255, 255, 0]]], dtype=torch.uint8)
    out = recolored(image, matrix, photo)
    expected = torch.tensor([[[1.0, 1.125, 1.0]], [[0.25, 1.0, 1.125]]])
    torch.testing.assert_close(out, expected)
    out.sum().backward()
    passes = (expected != 1.0).float()
    torch.testing.assert_close(image.grad, 1.25 * passes)


@pytest.mark.parametrize("with_background", [False, True])
def test_the_bits_do_not_depend_on_the_threads(with_background):
    image, matrix, photo = scene(torch.float32, (211, 157))
    found, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            x, m = image.clone().requires_grad_(), matrix.clone().requires_grad_()
            t = backdrop(torch.float32, (211, 157)).transmittance.requires_grad_()
            given = Backdrop(t, BACKGROUND) if with_background else None
            out = recolored(x, m, photo, given, corners(torch.float32, (211, 157)))
            out.backward(torch.linspace(0, 1, out.numel()).reshape(out.shape))
            found.append((out.detach(), x.grad, m.grad, *([t.grad] if with_background else [])))
    finally:
        torch.set_num_threads(before)
    for others in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], others, strict=True))


@pytest.mark.usefixtures("as_shipped")  # otherwise the hook checks annotations first
def test_wrong_arguments_are_named():
    image, matrix, photo = scene(torch.float32)
    with pytest.raises(ShapeError, match="^matrix"):
        recolored(image, matrix[:2])
    with pytest.raises(ShapeError, match="^photo"):
        recolored(image, matrix, photo[1:])
    with pytest.raises(ArgumentError, match="^matrix: is torch.float64"):
        recolored(image, matrix.double())
    with pytest.raises(ShapeError, match="^transmittance"):
        recolored(image, matrix, None, Backdrop(torch.zeros(3, 3), BACKGROUND))
    with pytest.raises(ArgumentError, match="^transmittance: is torch.float64"):
        recolored(image, matrix, None, backdrop(torch.float64))
    with pytest.raises(ShapeError, match="^falloff"):
        recolored(image, matrix, falloff=torch.ones(9, 14))
    with pytest.raises(ArgumentError, match="^falloff: is torch.float64"):
        recolored(image, matrix, falloff=corners(torch.float64))


def test_the_native_function_refuses_arguments_that_do_not_fit():
    image, matrix, photo = scene(torch.float32)
    given = {"image": image, "matrix": matrix, "photo": photo, "threads": 1}
    given |= {"transmittance": image[..., 0].contiguous(), "background": BACKGROUND, "falloff": None}
    fine = {**given, "out": torch.empty_like(image)}
    call = kernels.kernel("recolor_f", torch.float32)
    call(**fine)
    for name, wrong in {
        "matrix": matrix.T.contiguous(),
        "photo": photo[:, 1:].contiguous(),
        "image": image.double(),
        "out": torch.empty(3, 3, 3),
        "threads": 0,
        "transmittance": torch.zeros(9, 14),
        "background": (0.0, 0.0),
        "falloff": torch.zeros(9, 15, dtype=torch.float64),
    }.items():
        with pytest.raises(ValueError, match=f"^recolor: {name}"):
            call(**{**fine, name: wrong})
    back = kernels.kernel("recolor_backward_f", torch.float32)
    given |= {"grad": image, "grad_matrix": None}
    of_image, of_transmittance = torch.empty_like(image), torch.empty(9, 15)
    back(**given, grad_image=of_image, grad_transmittance=of_transmittance)
    with pytest.raises(ValueError, match="^recolor_backward: grad_image"):
        back(**given, grad_image=torch.empty(2, 2, 3), grad_transmittance=of_transmittance)
    with pytest.raises(ValueError, match="^recolor_backward: grad_transmittance"):
        back(**given, grad_image=of_image, grad_transmittance=None)
    with pytest.raises(ValueError, match="^recolor_backward: grad_transmittance"):
        back(**given | {"transmittance": None}, grad_image=of_image, grad_transmittance=of_transmittance)
