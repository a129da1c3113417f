import math

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d

from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.evaluate.metrics import (
    best,
    mean_absolute_error,
    psnr,
    psnr_8bit,
    psnr_fitted,
    score_views,
    ssim,
    summarize,
    to_bytes,
    worst,
)
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View


def noise(*shape, seed=0):
    return np.random.default_rng(seed).uniform(size=shape)


def ssim_by_definition(x, y):
    """Compute SSIM by its formula, with scipy's filter of 11 taps, sigma 1.5 and zeros outside."""
    taps = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    taps /= taps.sum()

    def mean(image):
        return correlate1d(correlate1d(image, taps, axis=0, mode="constant"), taps, axis=1, mode="constant")

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    top = (2 * mx * my + 0.01**2) * (2 * cov + 0.03**2)
    return float((top / ((mx**2 + my**2 + 0.01**2) * (vx + vy + 0.03**2))).mean())


def test_psnr_by_hand():
    truth = np.zeros((2, 2, 3))
    image = np.zeros((2, 2, 3))
    image[0, 0] = 0.1  # MSE = 3 * 0.01 / 12 = 0.0025
    assert psnr(image, truth) == pytest.approx(10 * math.log10(1 / 0.0025), abs=1e-12)
    assert mean_absolute_error(image, truth) == pytest.approx(0.3 / 12, abs=1e-15)


def test_equal_images_have_100_db_and_ssim_1():
    image = noise(20, 17, 3)
    assert psnr(image, image) == pytest.approx(100.0, abs=1e-12)
    assert ssim(image, image) == pytest.approx(1.0, abs=1e-12)


def test_renders_are_clamped_and_photos_are_bytes():
    truth = np.full((4, 4, 3), 255, dtype=np.uint8)
    assert psnr(np.full((4, 4, 3), 7.0), truth) == pytest.approx(100.0)
    assert psnr(np.full((4, 4, 3), -7.0), truth) == pytest.approx(0.0, abs=1e-12)


def test_8_bits_round_to_the_nearest_byte():
    truth = np.full((4, 4, 3), 100, dtype=np.uint8)
    image = np.full((4, 4, 3), 100.4 / 255)  # rounds to 100, as the other
    assert psnr_8bit(image, truth) == pytest.approx(100.0)
    assert psnr(image, truth) == pytest.approx(20 * math.log10(255 / 0.4), abs=1e-9)
    np.testing.assert_array_equal(to_bytes(np.full((1, 1, 3), 100.5 / 255)), 101)


def test_tensors_are_accepted_as_images():
    image, truth = noise(6, 7, 3), noise(6, 7, 3, seed=1)
    given = torch.tensor(image, requires_grad=True), torch.tensor(truth)
    assert psnr(*given) == psnr(image, truth)
    assert ssim(*given) == ssim(image, truth)


@pytest.mark.parametrize("shape", [(40, 31, 3), (5, 64, 3), (1, 1, 3)])
def test_ssim_against_its_definition(shape):
    """Both compute in float64. The sums over a window (121 products, by rows and columns) round values up to 1 about
    30 times, an error of 3e-15. The ratio divides by at least C2 = 9e-4 (and C1 = 1e-4 if both are dark), so its
    error is at most 1e-11, and so is that of the mean.
    """
    x = noise(*shape)
    y = np.clip(x + 0.2 * (noise(*shape, seed=1) - 0.5), 0, 1)
    assert ssim(x, y) == pytest.approx(ssim_by_definition(x, y), abs=1e-10)


def test_only_pixels_inside_the_mask_count():
    truth = (255 * noise(16, 18, 3)).astype(np.uint8)
    image = np.clip(truth / 255 + 0.05, 0, 1)
    mask = np.zeros((16, 18), dtype=bool)
    mask[3:12, 4:9] = True
    spoiled = image.copy()
    spoiled[~mask] = noise(*spoiled[~mask].shape)
    for metric in (psnr, psnr_8bit, ssim, mean_absolute_error):
        assert metric(spoiled, truth, mask) == metric(image, truth, mask), metric.__name__
        assert metric(spoiled, truth) != metric(spoiled, truth, mask), metric.__name__
    error = np.mean((image - truth / 255)[mask] ** 2)
    assert psnr(image, truth, mask) == pytest.approx(-10 * math.log10(error), abs=1e-12)
    outside = ~mask[..., None]
    zeroed = [np.where(outside, 0.0, plane) for plane in (image, truth / 255)]
    assert ssim(image, truth, mask) == pytest.approx(ssim_by_definition(*zeroed), abs=1e-10)


@pytest.mark.usefixtures("as_shipped")
def test_images_that_cannot_be_compared_are_refused():
    image = noise(4, 5, 3)
    with pytest.raises(ShapeError, match=r"truth: expected shape \(H=4, W=5, 3\), got \(5, 4, 3\)"):
        psnr(image, noise(5, 4, 3))
    with pytest.raises(ShapeError, match="mask"):
        psnr(image, image, np.ones((5, 4), dtype=bool))
    with pytest.raises(ArgumentError, match="no pixel counts"):
        psnr(image, image, np.zeros((4, 5), dtype=bool))
    image[1, 2, 0] = np.nan
    with pytest.raises(ArgumentError, match=r"image\[1, 2, 0\]: is nan"):
        ssim(image, image)


def test_numbers_are_the_same_on_any_number_of_threads():
    image, truth = noise(61, 83, 3), noise(61, 83, 3, seed=1)
    before = torch.get_num_threads()
    found = set()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.add((psnr(image, truth), ssim(image, truth), mean_absolute_error(image, truth)))
    finally:
        torch.set_num_threads(before)
    assert len(found) == 1


def no_gaussians():
    return Gaussians(*(torch.zeros(0, *s) for s in ((3,), (4,), (3,), (1, 3), (0, 3), ())))


def grey_renderer(gaussians, camera):
    assert not torch.is_grad_enabled()
    image = torch.full((camera.H, camera.W, 3), 0.5)
    return RenderOutput(
        image,
        torch.zeros(camera.H, camera.W),
        None,
        torch.zeros(0, dtype=torch.int64),
        torch.zeros(0, 2),
        None,
        list,
    )


def test_views_are_scored_over_the_background_in_their_order():
    camera = Camera(np.eye(3), (0, 0, 0), 10, 10, 2, 2, 4, 5)
    clear = np.zeros((4, 5), dtype=np.uint8)
    none = np.zeros((4, 5), dtype=bool)
    black = np.zeros((4, 5, 3), dtype=np.uint8)
    views = [
        View(camera, black, name="black"),
        View(camera, black, alpha=clear, name="clear"),
        View(camera, black, mask=none, name="nothing counts"),
        View(camera, np.full((4, 5, 3), 0.5), name="grey"),
    ]
    seen, told = [], []
    scores = score_views(
        no_gaussians(),
        views,
        grey_renderer,
        (1.0, 0.5, 0.5),
        lambda *scored: seen.append(scored[0].name),
        lambda view, score: told.append((view.name, score)),
    )
    assert [score.name for score in scores] == seen == ["black", "clear", "grey"]
    assert told == list(zip(seen, scores, strict=True))
    assert scores[0].psnr == pytest.approx(10 * math.log10(4), abs=1e-9)
    # An opaque grey render is off by one half over black and over white, whatever the background.
    assert scores[1].psnr == pytest.approx(10 * math.log10(4), abs=1e-9)
    assert best(scores).name == "grey" and worst(scores).name == "black"
    means = summarize(scores)
    assert means["num_images"] == 3
    assert means["psnr"] == pytest.approx(sum(s.psnr for s in scores) / 3, abs=1e-12)


def test_who_is_told_a_score_can_end_the_scoring():
    views, told = [View(Camera(np.eye(3), (0, 0, 0), 10, 10, 2, 2, 4, 5), np.zeros((4, 5, 3)))] * 4, []

    def stop(view, score):
        told.append(score)
        if len(told) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        score_views(no_gaussians(), views, grey_renderer, (0.0, 0.0, 0.0), on_score=stop)
    assert len(told) == 2


def test_no_images_means_no_averages():
    assert summarize([]) == {
        "psnr": None,
        "psnr_8bit": None,
        "ssim": None,
        "l1": None,
        "psnr_fitted": None,
        "num_images": 0,
    }
    with pytest.raises(ArgumentError, match="scores: is empty"):
        worst([])


def test_the_fitted_psnr_does_not_depend_on_the_exposure_of_the_photo():
    """The photo has a third less light, which the gains fitted on the left half compensate on the right half."""
    truth = np.random.default_rng(4).uniform(0.2, 0.8, (40, 60, 3))
    render = np.clip(truth + np.random.default_rng(5).normal(0.0, 0.01, truth.shape), 0.0, 1.0)
    darker = (truth + 0.055) * (2 / 3) ** (1 / 2.4) - 0.055
    # Noise of 0.01 is 40 dB, and the dark photo reduces it by a sixth.
    assert psnr_fitted(render, truth) == pytest.approx(40.0, abs=0.4)
    assert psnr_fitted(render, darker) == pytest.approx(41.4, abs=0.6)
    assert psnr(render, darker) < 21.0
    right = np.zeros(truth.shape[:2], dtype=bool)
    right[:, :30] = True
    assert psnr_fitted(render, darker, right) is None, "no pixel of the right half counts"
    assert psnr_fitted(render[:, :1], truth[:, :1]) == pytest.approx(psnr(render[:, :1], truth[:, :1]))
