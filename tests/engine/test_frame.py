"""Frames of the engine: room for pairs, buffers that are used again, workgroups in two dimensions."""

import numpy as np

from engine.frames import drawn, packed, view_of
from float32_backends import SMALLER
from gsplat_edu.engine import frame, host
from gsplat_edu.engine.passes import LIMITS
from native_scenes import random


def test_more_pairs_than_there_is_room_for_are_drawn_again(device):
    """Wide Gaussians in a large image: far more than two tiles each."""
    scene = random(3000, (400, 300), seed=1, log_scales=np.full((3000, 3), -1.5), logits=np.full(3000, -2.0))
    pool = frame.Pool(device)
    small = pool.room(3000, view_of(scene).tiles)
    found = drawn(pool, scene)
    assert found.num_pairs > small and found.memory.counts["pairs"] >= found.num_pairs
    again = drawn(pool, scene)
    np.testing.assert_array_equal(found.image, again.image)


def test_noise_in_the_buffers_changes_nothing(device, monkeypatch):
    scene = SMALLER["opaque, tiles stop"]
    clean, noisy = frame.Pool(device), frame.Pool(device)
    allocate = device.allocate
    monkeypatch.setattr(
        noisy, "device", type("Poisoned", (), {"allocate": lambda _, *args: allocate(*args, poison=True)})()
    )
    results = []
    for pool in (clean, noisy):
        found = drawn(pool, scene)
        grads = np.random.default_rng(0).normal(size=(*found.transmittance.shape, 5)).astype(np.float32)
        gradients = frame.differentiate_frame(found, packed(scene), grads, None)
        results.append((found.image, found.depth, found.visible, found.radii, gradients.core, gradients.rest))
    for ours, other in zip(*results, strict=True):
        np.testing.assert_array_equal(ours, other)


def test_workgroups_beyond_a_dimension_continue_in_the_next(device):
    scene = SMALLER["random"]
    folded = frame.Pool(host.Device(limits=LIMITS, most_groups=2))
    ours, other = (drawn(pool, scene) for pool in (frame.Pool(device), folded))
    np.testing.assert_array_equal(ours.image, other.image)


def test_a_frame_keeps_its_buffers_while_others_are_drawn(pool):
    """Gradients of a frame after two other frames of the same size, one of which is gone."""
    scene, other = random(50, seed=1), random(50, seed=2)
    first = drawn(pool, scene)
    grads = np.random.default_rng(0).normal(size=(*first.transmittance.shape, 5)).astype(np.float32)
    expected = frame.differentiate_frame(first, packed(scene), grads, None).core.copy()
    drawn(pool, other)
    kept = drawn(pool, other)
    found = frame.differentiate_frame(first, packed(scene), grads, None).core
    np.testing.assert_array_equal(found, expected)
    assert kept.memory is not first.memory
