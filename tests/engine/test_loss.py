"""The engine's loss and its gradient are those of the reference in float64."""

import numpy as np
import pytest
import torch

from engine.frames import plain_view
from gsplat_edu.base.constants import SSIM_C2
from gsplat_edu.engine.step import LIVE, PHOTO_WORDS, PackedPhoto, StepNumbers, loss_program, loss_value
from gsplat_edu.ops.losses import l1_ssim_in_torch, photo_loss

EPS = 2.0**-24

# Values are up to 1. A blur of 22 rounded steps is off by about sqrt(22) EPS, and so is the variance, a difference of
# blurs, which SSIM adds to C2. Where the images are flat, it is 0: S and its gradient are off by that error over C2.
TOLERANCE = 22**0.5 * EPS / SSIM_C2


def played(device, image, photo, weight, spare=0):
    """Return loss and gradient; the buffers have room for `spare` more tiles, as those of a run with larger views."""
    H, W, _ = image.shape
    view = plain_view(H, W)
    counts = {"pixels": H * W + 256 * spare, "edges": view.tiles + 2 + spare, "live": LIVE, "pairs": 1}
    memory = device.allocate(loss_program(), counts, poison=True)
    planes = np.zeros((H, W, 6), dtype=np.float32)
    planes[..., :3] = image
    memory.write("image", planes)
    memory.write("photo", photo.words)
    numbers = StepNumbers(ssim_weight=weight).packed(H * W, 1, photo.floats)
    found = memory.play("loss", view.packed(0) + numbers, read=("live", "grads"))
    gradient = found["grads"].view(np.float32)[: H * W * 5].reshape(H, W, 5)
    assert not gradient[..., 3:].any()
    return loss_value(found["live"], H * W, weight), gradient[..., :3]


def pictures(H, W, kind):
    """Return an image and a photo whose upper half is nearly flat."""
    generator = np.random.default_rng(H * W)
    image = generator.random((H, W, 3)).astype(np.float32)
    image[: H // 2] = 0.5 + 1e-3 * image[: H // 2]
    photo = (255 * generator.random((H, W, 3))).astype(np.uint8)
    photo[: H // 2] = 128
    return image, photo if kind == "bytes" else generator.random((H, W, 3)).astype(np.float32)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("kind", ["bytes", "floats"])
@pytest.mark.parametrize(("H", "W"), [(1, 1), (5, 7), (17, 33), (32, 16), (50, 51)])
def test_the_loss_is_the_reference_s(device, H, W, kind, weight):
    image, target = pictures(H, W, kind)
    mask = np.random.default_rng(0).random((H, W)) > 0.1
    photo = PackedPhoto.packed(target, mask)
    assert photo.floats == (kind == "floats")
    value, gradient = played(device, image, photo, weight, spare=3)
    x = torch.tensor(image, dtype=torch.float64, requires_grad=True)
    y = torch.tensor(target) if kind == "bytes" else torch.tensor(target, dtype=torch.float64)
    expected = photo_loss(x, y, torch.tensor(mask), weight, l1_ssim_in_torch)
    expected.backward()
    assert value == pytest.approx(float(expected.detach()), rel=TOLERANCE, abs=TOLERANCE)
    assert np.abs(gradient - x.grad.numpy()).max() <= TOLERANCE / (3 * H * W)
    assert not gradient[~mask].any()


def test_a_photo_of_bytes_in_floats_is_packed_into_bytes():
    """As far as its values are exactly k/255; else floats keep them."""
    image = np.arange(256, dtype=np.uint8).repeat(3).reshape(16, 16, 3)
    floats = image.astype(np.float32) / np.float32(255)
    packed = PackedPhoto.packed(floats, None)
    assert not packed.floats and np.array_equal(packed.words, PackedPhoto.packed(image, None).words)
    floats[0, 0, 0] = np.nextafter(np.float32(0), np.float32(1))
    assert PackedPhoto.packed(floats, None).words.shape == (256, PHOTO_WORDS)


def test_the_same_bits_again(device):
    image, target = pictures(50, 51, "bytes")
    photo = PackedPhoto.packed(target, None)
    first, second = (played(device, image, photo, 0.2) for _ in range(2))
    assert first[0] == second[0] and np.array_equal(first[1], second[1])
