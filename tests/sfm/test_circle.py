"""The circle of a fisheye's photos is found to a fraction of a pixel; dark photos, frames and vignettes are none."""

import cv2
import numpy as np
import pytest

from gsplat_edu.sfm.circle import Circle, find_circle

W, H = 420, 320


def texture(seed, low=40, high=220):
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(low, high, (8, 10)).astype(np.float32)
    fine = rng.normal(0, 12, (H, W)).astype(np.float32)
    return np.clip(cv2.resize(coarse, (W, H), interpolation=cv2.INTER_CUBIC) + fine, low, 255)


def round_photo(seed, circle, noise=3.0, low=40):
    """Return a photo with a round image; pixels at the rim are partly covered by it."""
    columns, rows = np.arange(W) - circle.x, np.arange(H)[:, None] - circle.y
    share = np.clip(circle.radius + 0.5 - np.hypot(columns, rows), 0, 1)
    rng = np.random.default_rng(seed + 100)
    image = share * texture(seed, low) + np.abs(rng.normal(0, noise, (H, W)))
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    "circle", [Circle(209.5, 159.5, 150.0), Circle(215.3, 152.8, 140.6), Circle(205.0, 162.0, 190.0)]
)
def test_the_circle_is_found(circle):
    """Also if the photo cuts it off at the top and bottom, as the third."""
    found = find_circle([round_photo(seed, circle) for seed in range(6)])
    assert found is not None
    assert (found.x, found.y, found.radius) == pytest.approx(tuple(circle), abs=0.5)


def test_a_single_photo_with_a_flare_outside_does_not_move_it():
    circle = Circle(210.0, 160.0, 145.0)
    photos = [round_photo(seed, circle) for seed in range(12)]
    photos[4][:40, :60] = 200
    found = find_circle(photos)
    assert found is not None and tuple(found) == pytest.approx(tuple(circle), abs=0.5)


def test_scaled_keeps_the_edge_of_the_image():
    """A circle that touches all edges of a square photo still does after scaling."""
    full = Circle(49.5, 49.5, 50.0).scaled(3.0)
    assert tuple(full) == (149.5, 149.5, 150.0)


def framed():
    image = texture(1)
    image[:40], image[-40:], image[:, :60], image[:, -60:] = 0, 0, 0, 0
    return image.astype(np.uint8)


def night(seed):
    """Return lamps and a lit house front before black, in other places of every photo."""
    rng = np.random.default_rng(seed)
    image = np.abs(rng.normal(0, 4, (H, W)))
    for _ in range(6):
        x, y, r = rng.integers(110, W - 110), rng.integers(80, H - 80), rng.integers(6, 40)
        cv2.circle(image, (int(x), int(y)), int(r), 230.0, -1)
    cv2.rectangle(image, (150, 120), (260, 240), 90.0, -1)
    return np.clip(image, 0, 255).astype(np.uint8)


def vignette():
    columns, rows = np.arange(W) - W / 2, np.arange(H)[:, None] - H / 2
    fall = np.clip(1.15 - np.hypot(columns, rows) / 230, 0, 1)
    return (fall * texture(3)).astype(np.uint8)


def rounded_square():
    image = np.zeros((H, W), np.float32)
    cv2.rectangle(image, (80, 30), (340, 290), 1.0, -1)
    return (cv2.GaussianBlur(image, (0, 0), 6) * texture(5)).astype(np.uint8)


def ellipse():
    image = np.zeros((H, W), np.float32)
    cv2.ellipse(image, (W // 2, H // 2), (200, 140), 0, 0, 360, 1.0, -1)
    return (image * texture(6)).astype(np.uint8)


@pytest.mark.parametrize(
    "photos",
    [
        [texture(0).astype(np.uint8)],
        [np.zeros((H, W), np.uint8)],
        [np.full((H, W), 140, np.uint8)],
        [framed()],
        [framed()] * 5,
        [night(seed) for seed in range(8)],
        [night(3)],
        [vignette()],
        [rounded_square()],
        [ellipse()],
        [np.zeros((8, 8), np.uint8)],
        [],
    ],
    ids=[
        "bright",
        "black",
        "grey",
        "frame",
        "frames",
        "nights",
        "night",
        "vignette",
        "square",
        "ellipse",
        "tiny",
        "none",
    ],
)
def test_other_photos_have_no_circle(photos):
    assert find_circle(photos) is None
