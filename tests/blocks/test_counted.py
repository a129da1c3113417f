"""The pixels that count in a block, and the Gaussians from which it starts."""

import dataclasses

import numpy as np
import pytest
import torch

from blocks.test_views import AREA, HALVES, carpet, downwards
from gsplat_edu.blocks.counted import AROUND, MASK_SIDE, Counted, counted_views
from gsplat_edu.blocks.plan import MARGIN
from gsplat_edu.render.api import render
from gsplat_edu.scene.camera import look_at
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View

BORDER = MARGIN * 10.0
"""Width of the margin of each half of the ground, world units."""


def counted(gaussians, cell=HALVES[0]):
    def with_features(scene, camera, features):
        return render(scene, camera, features=features, backend="cpu")

    return Counted(AREA, cell, gaussians, with_features)


def places(camera, high):
    """Return where the centres of a row's pixels meet the ground, world units."""
    return camera.eye[0] - (np.arange(camera.W) - camera.cx) / camera.fx * high


@pytest.mark.parametrize("x", [0.0, 1.0, -1.5])
def test_pixels_of_the_cell_and_its_margin_count(x):
    """The border of the ground is blurred over a few pixels, and `AROUND` px more count."""
    camera = downwards(x)
    mask, ground = counted(carpet()).mask(camera), places(camera, 5.0)
    assert mask[:, ground < BORDER].all()
    px = 5.0 / camera.fx
    assert not mask[:, ground > BORDER + (AROUND + 4) * px].any() and not mask.all()


def test_a_view_beside_the_cell_and_unknown_pixels_count_whole():
    """A view without a pixel of the cell counts whole, because a photo in which nothing counts teaches nothing."""
    assert counted(carpet()).mask(downwards(5.0, high=2.0)).all()
    bare = carpet(high=-2.0)  # the model ends at -2
    camera = downwards(-1.0)
    assert counted(bare).mask(camera).all(), "what the model does not know may belong to the cell"


def test_what_another_cell_hides_does_not_count():
    """A roof over the right half, above the camera's line of sight to the left one."""
    roof = carpet(y=-2.0, low=0.5, high=8.0)
    camera = downwards(0.0)
    mask, ground = counted(Gaussians.concatenated([carpet(), roof])).mask(camera), places(camera, 5.0)
    hidden = (ground > 0.5 * 5 / 3 + 10 * 5.0 / camera.fx) & (ground < 4)
    assert mask[:, ground < 0].all() and not mask[:, hidden].any()


def test_the_start_has_the_cell_and_what_its_pixels_show():
    veil = dataclasses.replace(carpet(y=-2.0, low=2.0, high=3.0), logit_opacities=torch.full((256,), -1.0))
    scene = Gaussians.concatenated([carpet(), veil])
    # From the right, the cell is seen through the veil over the other half.
    eye = np.array([6.0, -4.2, 0.0])
    aside = downwards(0.0)
    aside = aside.posed(look_at(eye, np.array([-3.0, 0.0, 0.0])), eye, aside.intrinsics)
    start = counted(scene).start([aside])
    ground, over = start[: len(carpet())], start[len(carpet()) :]
    x = carpet().means[:, 0].numpy()
    assert ground[x < BORDER - 0.2].all()
    assert over.mean() > 0.2, "what stands before the cell is needed"
    assert ground[x > 4.0].mean() < 0.05, "what only pixels of the other cell show is not"


def test_masks_are_added_to_those_of_the_photos_and_enlarged():
    """A photo larger than its mask keeps its own mask and its size."""
    small = downwards(0.0)
    W, H = 5 * small.W, 5 * small.H
    camera, own = small.scaled(W, H), np.zeros((H, W), dtype=bool)
    assert MASK_SIDE < W
    own[: H // 2] = True
    plain, halved = View(camera, np.zeros((H, W, 3))), View(camera, np.zeros((H, W, 3)), mask=own)
    first, second = (view.read() for view in counted_views([plain, halved], counted(carpet())))
    ground = places(camera, 5.0)
    assert first.mask[:, ground < BORDER].all() and not first.mask[:, ground > 1.5].any()
    assert (second.mask == (first.mask & own)).all()
    assert not first.excluded.any() and (second.excluded == ~own).all(), (
        "outside is what the photos' own masks say"
    )
