"""Targets of the loss are made once if they never change, and read again only if necessary. The room on a GPU is a
number of bytes. The tests use torch's device "meta" as a GPU, because the code is the same.
"""

import collections

import numpy as np
import pytest
import torch

from gsplat_edu.scene.photo import AT_ONCE, Photo
from gsplat_edu.scene.rig import orbit_camera
from gsplat_edu.scene.views import View
from gsplat_edu.train.feed import ViewFeed

SIZE = 16
BYTES = 3 * SIZE * SIZE
WHITE = (1.0, 1.0, 1.0)
META = torch.device("meta")


def photos(count, alpha=False, mask=False):
    rng = np.random.default_rng(0)
    for _ in range(count):
        yield Photo(
            rng.integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8),
            rng.integers(0, 256, (SIZE, SIZE), dtype=np.uint8) if alpha else None,
            rng.random((SIZE, SIZE)) < 0.5 if mask else None,
        )


def stored(count, reads, **kinds):
    """Make views whose photos are read on demand; `reads` counts the reads."""
    camera = orbit_camera(0.0, 0.0, SIZE, 20.0, 3.0)

    def reading(i, photo):
        def read():
            reads[i] += 1
            return photo

        return read

    return [View.stored(camera, reading(i, photo)) for i, photo in enumerate(photos(count, **kinds))]


def in_memory(count, **kinds):
    camera = orbit_camera(0.0, 0.0, SIZE, 20.0, 3.0)
    return [View(camera, p.image, alpha=p.alpha, mask=p.mask) for p in photos(count, **kinds)]


def draw(feed, background):
    draw = feed.next()
    assert draw.view is feed.views[draw.index]
    return draw.view, feed.target(draw, background)


def drawn(feed, count, background=WHITE):
    targets = [draw(feed, background) for _ in range(count)]
    feed.close()  # prefetched photos count as well
    return targets


@pytest.mark.parametrize(
    ("room", "kept"), [(0, 0), (BYTES - 1, 0), (BYTES, 1), (5 * BYTES, 5), (99 * BYTES, 6)]
)
def test_a_gpu_keeps_photos_that_fit_and_the_rest_is_read_again(room, kept):
    reads = collections.Counter()
    feed = ViewFeed(stored(6, reads), "shuffled", 0, WHITE, META, room)
    targets = drawn(feed, 60)
    assert sum(len({id(t) for v, t in targets if v is view}) == 1 for view in feed.views) == kept
    assert sorted(reads.values())[:kept] == [1] * kept, "a kept photo is read once"
    assert all(count >= 10 for count in sorted(reads.values())[kept:])


def test_masks_take_room_as_well():
    reads = collections.Counter()
    drawn(ViewFeed(stored(4, reads, mask=True), "shuffled", 0, WHITE, META, 2 * BYTES), 12)
    assert sum(count == 1 for count in reads.values()) == 1, "a kept photo is read once"


def test_kept_targets_equal_the_photos():
    """On the CPU, the same code returns the photo's bytes."""
    views = stored(3, collections.Counter(), mask=True)
    for view, target in drawn(ViewFeed(views, "shuffled", 0, WHITE), 6):
        assert np.array_equal(target.image.numpy(), view.read().image)
        assert np.array_equal(target.mask.numpy(), view.read().mask)


@pytest.mark.parametrize("device", [META, torch.device("cpu")])
def test_photos_over_random_backgrounds_are_not_kept(device):
    reads = collections.Counter()
    feed = ViewFeed(stored(2, reads, alpha=True), "shuffled", 0, None, device, 99 * BYTES)
    drawn(feed, 8)
    assert sum(reads.values()) >= 8


def test_photos_in_memory_are_composited_over_the_background_once():
    views = in_memory(3, alpha=True)
    targets = drawn(ViewFeed(views, "shuffled", 0, WHITE), 12)
    assert len({target.image.data_ptr() for _, target in targets}) == 3
    for view, target in targets:
        assert np.array_equal(target.image.numpy(), view.read().over(WHITE))


def test_opaque_photos_in_memory_are_not_copied():
    views = in_memory(3)
    feed = ViewFeed(views, "shuffled", 0, WHITE)
    for view, target in drawn(feed, 6):
        assert target.image.data_ptr() == view.image.ctypes.data


def test_every_draw_has_its_own_background():
    view = in_memory(1, alpha=True)[0]
    feed = ViewFeed([view], "shuffled", 0, None)
    for color in (WHITE, (0.0, 0.5, 1.0)):
        assert np.array_equal(draw(feed, color)[1].image.numpy(), view.read().over(color))


@pytest.mark.parametrize(("H", "W"), [(1, 3), (37, 500), (5, AT_ONCE + 1), (0, 4)])
@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_compositing_in_rows_equals_the_formula_to_the_bit(H, W, kind):
    """`Photo.over` processes a few rows at a time, with the same result as for the whole image."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (H, W, 3), dtype=np.uint8)
    if kind is np.float32:
        image = (image / np.float32(255)).astype(np.float32)
    alpha, color = rng.integers(0, 256, (H, W), dtype=np.uint8), (0.2, 0.7, 1.0)
    share = alpha[..., None].astype(np.float32) / 255.0
    values = image.astype(np.float32) / (255.0 if kind is np.uint8 else 1.0)
    mixed = np.clip(values * share + np.asarray(color, np.float32) * (1.0 - share), 0.0, 1.0)
    assert np.array_equal(Photo(image, alpha).over(color), np.round(255.0 * mixed).astype(np.uint8))


@pytest.mark.parametrize("background", [WHITE, None])
def test_a_target_knows_where_its_photo_was_opaque(background):
    """The pixels are known for photos in memory, which are composited once, and for photos that are read again; None
    without alpha."""
    views = in_memory(2, alpha=True)
    for given in (views, [View.stored(view.camera, view.read) for view in views]):
        for view, target in drawn(ViewFeed(given, "shuffled", 0, background), 6):
            assert np.array_equal(target.opaque.numpy(), view.read().alpha >= 0.95 * 255)
            assert target.nbytes == target.image.nbytes + target.opaque.nbytes
    assert all(
        target.opaque is None for _, target in drawn(ViewFeed(in_memory(2), "shuffled", 0, background), 2)
    )
