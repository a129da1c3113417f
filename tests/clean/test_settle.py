"""The opacities of doubtful splats are fitted together."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_edu.clean.settle import Doubtful, Judged, logit_gradient, settle
from gsplat_edu.render.api import render
from gsplat_edu.scene.gaussians import Gaussians

from .conftest import CPU, SETTINGS, photographed

UNIT = 1e-6


def error(gaussians, doubtful, logits, view):
    """Return the squared error of one view with these factors on the opacities."""
    opacity = gaussians.opacities.numpy().copy()
    opacity[doubtful] /= 1.0 + np.exp(-logits)
    shown = replace(gaussians, logit_opacities=torch.from_numpy(np.log(opacity / (1.0 - opacity))))
    with torch.no_grad():
        image = render(shown, view.camera, settings=SETTINGS, backend="cpu").image.numpy()
    return float(np.square(image - view.image / 255.0).sum())


def test_the_gradient_is_that_of_the_error(planted, rings):
    """The error is smooth: no alpha reaches the clamp, and a step of 1e-6 moves hardly any alpha across 1/255."""
    some = planted.map(lambda tensor: tensor.double())
    faint = replace(some, logit_opacities=some.logit_opacities.clamp(max=1.0))
    view = photographed(planted, rings[0][:1])[0]
    doubtful = np.r_[np.arange(40), np.arange(1300, 1360)]
    logits = np.random.default_rng(0).normal(size=len(doubtful))
    # The gradient of the price has a closed form, which is subtracted here.
    price = 0.3
    factor = 1.0 / (1.0 + np.exp(-logits))
    found = logit_gradient(
        faint, Doubtful(doubtful, logits, price), logits, Judged(view.camera, view.read(), SETTINGS), CPU, 1.0
    ) - price * factor * (1.0 - factor)
    direction = np.random.default_rng(1).normal(size=len(doubtful))
    step = 1e-6
    up, down = (error(faint, doubtful, logits + s * step * direction, view) for s in (1, -1))
    # The error is about 100, so its differences have a rounding error of 100 * 2^-52 / 2e-6 = 1e-8.
    assert float(found @ direction) == pytest.approx((up - down) / (2 * step), rel=1e-5, abs=1e-6)
    assert np.abs(found).max() > 1e-2


def test_of_two_splats_that_fill_one_hole_the_one_in_the_photos_stays(room, rings):
    """While both are removed, the photos miss either of them."""
    views = photographed(room, rings[0])
    hole = 25
    red = torch.zeros(1, 1, 3)
    red[..., 0] = 1.7
    other = replace(
        room.map(lambda tensor: tensor[hole : hole + 1]), sh0=-room.sh0[hole : hole + 1] + 0.2 * red
    )
    both = Gaussians.concatenated([room, other])
    doubtful = Doubtful(np.array([hole, len(room)]), np.array([-1.0, -1.0]), 0.01)
    logits = settle(both, doubtful, views, SETTINGS, CPU, UNIT, 80)
    assert logits[0] > 1.0
    assert logits[1] < -1.5


def test_a_splat_in_no_photo_is_moved_by_its_price_only(room, rings):
    """A price of 0.01 units moves the logit by less than 0.1 in 40 steps."""
    one = room.map(lambda tensor: tensor[:1])
    far = replace(one, means=one.means + torch.tensor([0.0, 1e3, 0.0]))
    both = Gaussians.concatenated([room, far])
    start = np.array([1.0])
    found = settle(
        both,
        Doubtful(np.array([len(room)]), start, 0.01),
        photographed(room, rings[0]),
        SETTINGS,
        CPU,
        UNIT,
        40,
    )
    assert 0.9 < found[0] < 1.0


def test_masked_pixels_do_not_count(room, planted, rings):
    mask = np.zeros((rings[0][0].H, rings[0][0].W), dtype=bool)
    views = photographed(room, rings[0], mask)
    start = np.full(60, -1.0)
    found = settle(planted, Doubtful(np.arange(1300, 1360), start, 0.0), views, SETTINGS, CPU, UNIT, 40)
    assert np.array_equal(found, start)
