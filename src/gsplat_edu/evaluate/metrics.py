"""Image quality of renders against photos.

All metrics are computed in float64 with NumPy's sums or the native SSIM, so they are identical to the bit for any
number of threads. Renders are clamped to 0..1 first, as a screen would do. Definitions:

    psnr        10 log10(1 / MSE) of the floating-point render against the photo's bytes / 255
    psnr_8bit   the same with the render rounded to bytes, as in a PNG
    psnr_fitted the PSNR of the right half alone, after the render's exposure and white balance were fitted to the
                photo's left half: a held-out photo may be brighter or darker than the scene. Of a photo that is not
                opaque, only the object is fitted, not the background
    ssim        mean SSIM over pixels and channels: Gaussian window of 11 taps, sigma 1.5, zero outside the image

A mean over images averages the images' values. It is not the PSNR of the mean error.

A photo with alpha is scored over black and over white: over one colour, splats of that colour outside of what it cuts
out would cost nothing. The mean squared error is the mean of both, and so are SSIM and L1. The render over another
background than its own is  image + T (other - own),  with its transmittance T.

Chapter: 14_photos_to_scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, UInt8

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.pictures import as_array, levels, to_bytes as to_bytes
from gsplat_edu.base.validation import ArrayLike, check_shape, float64_array
from gsplat_edu.evaluate.verdict import MEASURES as MEASURES
from gsplat_edu.ops.exposure import color_matrix, falloff, measured_gains, measured_vignetting
from gsplat_edu.ops.losses import l1_ssim
from gsplat_edu.ops.recolor import Backdrop, recolored
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.photo import Photo, eroded
from gsplat_edu.scene.views import View

MSE_FLOOR = 1e-10
"""Smallest mean squared error: identical images have 100 dB, a finite number to average, plot and store."""

BEHIND_ALPHA = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
"""The backgrounds over which a photo with alpha is scored."""

SPILLED = 0.02
"""A scene has splats outside of what its photos cut out if `outside_cut_out` has a larger mean. Of 22 runs (fast, adc;
150 to 500 iterations), the 15 without a phantom have at most 0.0023, the 7 with one 0.06 to 0.39."""

Renderer = Callable[[Gaussians, Camera], RenderOutput]
"""Renders Gaussians from a camera."""


class Transparency(NamedTuple):
    """Inputs of a fit of colours for photos with a visible background; see `transparency_of`.

    Args:
        backdrop: Transmittance of the render, and the background of render and photo.
        opaque: (H, W) `Photo.opaque`, which is where colours are fitted.
    """

    backdrop: Backdrop
    opaque: Bool[np.ndarray, "H W"]


@dataclass(frozen=True)
class ImageScore:
    """Image quality of one render.

    Args:
        name: The view's name in the capture.
        psnr: dB, of the floating-point render.
        psnr_8bit: dB, of the render rounded to bytes.
        ssim: -1 to 1; 1 for equal images.
        l1: Mean absolute difference, 0 to 1.
        psnr_fitted: dB, of the right half after an exposure fit on the left half; None if no pixel counts in the right
            half.
        added_detail: Natural logarithm of the render's gradient energy over the photo's, at half their size and equal
            brightness, in the worse direction (`BLURRED_FROM`); None if the photo has a mask or alpha.
    """

    name: str
    psnr: float
    psnr_8bit: float
    ssim: float
    l1: float
    psnr_fitted: float | None
    added_detail: float | None = None


BLURRED_FROM = 0.25
"""From this `ImageScore.added_detail` on, a photo is blurred: the others gave the scene more detail than it shows. Of
61 photos of `snowmiku97`, 15 of them blurred by a hundredth of their width, it finds 14 (held out: 1.44, 1.16; missed:
0.21) and none of the others; of 27 photos without blur, trained on 14, none."""

OnImage = Callable[[View, ImageScore, UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W 3"]], None]
"""Called after each scored view with the view, its score, the render and the photo, both rounded to bytes."""

OnScore = Callable[[View, ImageScore], None]
"""Called after each scored view with the view and its score."""


def psnr(image: ArrayLike, truth: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Return the PSNR of the floating-point render: 10 log10(1 / max(MSE, 1e-10)).

    Args:
        image: (H, W, 3) render, array or tensor; clamped to 0..1.
        truth: (H, W, 3) photo: uint8, divided by 255; or float, 0 to 1.
        mask: (H, W) true for the pixels that count; None counts all.

    Returns:
        dB; 100 for equal images.

    Raises:
        ShapeError: the sizes of the arguments differ.
        ArgumentError: a value is NaN or infinite, or the mask excludes all pixels.
    """
    return _Pair(image, truth, mask).psnr()


def psnr_8bit(image: ArrayLike, truth: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Return the PSNR of the render rounded to bytes, as if read from a PNG.

    Arguments, result and errors are those of `psnr`.
    """
    return _Pair(image, truth, mask).psnr_8bit()


def psnr_fitted(
    image: ArrayLike,
    truth: ArrayLike,
    mask: ArrayLike | None = None,
    transparency: Transparency | None = None,
) -> float | None:
    """Return the PSNR of the right half of an image after a fit of its colours on the left half.

    Each channel's gain is `gsplat_edu.ops.exposure.measured_gains` of the left halves, which is applied to the right
    half. A held-out photo can thus be compared with a scene of another exposure, on pixels that are not part of the
    fit. Unlike `psnr`, it covers only half of the image.

    Arguments and errors are those of `psnr`.

    Args:
        image: As for `psnr`.
        truth: As for `psnr`.
        mask: As for `psnr`.
        transparency: What `transparency_of` returns for the photo; None if it is opaque.

    Returns:
        dB; None if no pixel of the right half counts.
    """
    return _Pair(image, truth, mask, transparency).psnr_fitted()


def transparency_of(photo: Photo, output: RenderOutput, background: ArrayLike) -> Transparency | None:
    """Return the inputs of a colour fit that depend on the background; None if the photo is opaque.

    Args:
        photo: The photo.
        output: The render, over `background`.
        background: (3,) colour behind both.
    """
    if photo.opaque is None:
        return None
    red, green, blue = float64_array("background", background, (3,)).tolist()
    return Transparency(Backdrop(output.transmittance, (red, green, blue)), photo.opaque)


def at_exposure_of(
    photo: UInt8[np.ndarray, "H W 3"] | Float[np.ndarray, "H W 3"],
    image: Float[torch.Tensor, "H W 3"],
    mask: Bool[np.ndarray, "H W"] | None = None,
    transparency: Transparency | None = None,
    *,
    vignetting: bool = False,
) -> Float[torch.Tensor, "H W 3"]:
    """Return a render with the exposure and white balance of a photo: one gain per channel.

    Args:
        photo: (H, W, 3) uint8, or float from 0 to 1.
        image: (H, W, 3) render.
        mask: (H, W) true for pixels that the gains are measured on; None for all.
        transparency: What `transparency_of` returns for the photo; None if it is opaque.
        vignetting: Give it the photo's vignetting too.

    Returns:
        (H, W, 3), differentiable in the image; what is measured counts as constant.
    """
    truth = torch.from_numpy(np.ascontiguousarray(photo)).to(image.device)
    if transparency is not None:
        mask = transparency.opaque if mask is None else mask & transparency.opaque
    counts = None if mask is None else torch.from_numpy(mask).to(image.device)
    found = (measured_vignetting if vignetting else measured_gains)(image, truth, counts)
    plane = falloff(found[3], *image.shape[:2]) if vignetting else None
    backdrop = None if transparency is None else transparency.backdrop
    compared = truth if truth.dtype == torch.uint8 else None
    return recolored(image, color_matrix(found[:3]), compared, backdrop, plane)


def mean_absolute_error(image: ArrayLike, truth: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Return mean |image - truth| over channels and the pixels that count, 0 to 1.

    Arguments and errors are those of `psnr`.
    """
    return _Pair(image, truth, mask).l1()


def ssim(image: ArrayLike, truth: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Return the mean SSIM over pixels and channels: 11 taps, sigma 1.5, zero outside the image.

    With a mask, both images are set to zero where it is false; the mean still covers all pixels.

    Arguments and errors are those of `psnr`.

    Raises:
        BackendUnavailableError: the native module is missing.

    Source: Wang et al. 2004.
    """
    return _Pair(image, truth, mask).ssim()


def score_image(
    name: str,
    image: ArrayLike,
    truth: ArrayLike,
    mask: ArrayLike | None = None,
    transparency: Transparency | None = None,
) -> ImageScore:
    """Compute all metrics of one image.

    Args:
        name: The view's name in the capture.
        image: As for `psnr`.
        truth: As for `psnr`.
        mask: As for `psnr`.
        transparency: As for `psnr_fitted`.

    Raises:
        ShapeError, ArgumentError: as for `psnr`.
        BackendUnavailableError: as for `ssim`.
    """
    pair = _Pair(image, truth, mask, transparency)
    scores = (pair.psnr(), pair.psnr_8bit(), pair.ssim(), pair.l1(), pair.psnr_fitted())
    return ImageScore(name, *scores, pair.added_detail())


def score_photo(name: str, photo: Photo, output: RenderOutput, background: ArrayLike) -> ImageScore:
    """Score a render against a photo: over `background` if it is opaque, else over all of `BEHIND_ALPHA` together.

    Args:
        name: The view's name in the capture.
        photo: The photo.
        output: The render, over `background`.
        background: (3,) colour behind the render.

    Raises:
        ShapeError, ArgumentError: as for `psnr`.
        BackendUnavailableError: as for `ssim`.
    """
    scores = [
        score_image(name, shown.image, photo.over(behind), photo.mask, transparency_of(photo, shown, behind))
        for shown, behind in over_backgrounds(photo, output, background)
    ]
    if len(scores) == 1:
        return scores[0]
    fitted = [score.psnr_fitted for score in scores if score.psnr_fitted is not None]
    return ImageScore(
        name,
        pooled_psnr([score.psnr for score in scores]),
        pooled_psnr([score.psnr_8bit for score in scores]),
        float(np.mean([score.ssim for score in scores])),
        float(np.mean([score.l1 for score in scores])),
        pooled_psnr(fitted) if fitted else None,
    )


def outside_cut_out(photo: Photo, output: RenderOutput) -> float | None:
    """Return the share of a render's solid pixels (opacity over 0.5) where the photo's alpha is 0; None without alpha.

    Pixels beside the cut-out do not count: a splat's edge may reach over it. `SPILLED` bounds the mean over views.

    Args:
        photo: The photo.
        output: The render of its camera.
    """
    if photo.alpha is None:
        return None
    solid = (output.transmittance < 0.5).numpy(force=True)
    solid &= True if photo.mask is None else photo.mask
    clear = eroded(photo.alpha == 0)
    return int(np.count_nonzero(solid & clear)) / max(int(np.count_nonzero(solid)), 1)


def photo_psnr(
    photo: Photo, output: RenderOutput, background: ArrayLike, mask: Bool[np.ndarray, "H W"] | None = None
) -> float:
    """Return the PSNR of `score_photo`, dB.

    Args:
        photo: The photo.
        output: The render, over `background`.
        background: (3,) colour behind the render.
        mask: (H, W) true for the pixels that count; None for the photo's own mask.

    Raises:
        ShapeError, ArgumentError: as for `psnr`.
    """
    return pooled_psnr(
        [
            psnr(shown.image, photo.over(behind), photo.mask if mask is None else mask)
            for shown, behind in over_backgrounds(photo, output, background)
        ]
    )


def over_backgrounds(
    photo: Photo, output: RenderOutput, background: ArrayLike
) -> list[tuple[RenderOutput, tuple[float, float, float]]]:
    """Return a render over each background that its photo is compared over, with that background.

    Args:
        photo: The photo.
        output: The render, over `background`.
        background: (3,) colour behind the render.
    """
    red, green, blue = float64_array("background", background, (3,)).tolist()
    if photo.alpha is None:
        return [(output, (red, green, blue))]
    T = output.transmittance[..., None]
    own = output.image.new_tensor((red, green, blue))
    return [
        (replace(output, image=output.image + T * (output.image.new_tensor(behind) - own)), behind)
        for behind in BEHIND_ALPHA
    ]


def pooled_psnr(values: Sequence[float]) -> float:
    """Return the PSNR of the mean of the squared errors that these PSNRs stand for, dB."""
    if len(values) == 1:
        return values[0]
    return float(-10.0 * np.log10(np.mean([10.0 ** (-value / 10.0) for value in values])))


def score_views(
    gaussians: Gaussians,
    views: Sequence[View],
    render: Renderer,
    background: ArrayLike,
    on_image: OnImage | None = None,
    on_score: OnScore | None = None,
) -> list[ImageScore]:
    """Render views and compare them with their photos; the next one is rendered meanwhile.

    Args:
        gaussians: N Gaussians.
        views: Cameras and photos. Views whose mask excludes all pixels are skipped.
        render: Renders Gaussians from a camera, over `background`.
        background: (3,) colour behind the renders; photos with alpha are scored as `score_photo` says.
        on_image: Called after each scored view, in their order.
        on_score: The same, without pictures.

    Returns:
        The scores, in the order of the views.
    """
    scores = list[ImageScore]()

    def tell(view: View, photo: Photo, output: RenderOutput, scored: Future[ImageScore]) -> None:
        scores.append(scored.result())
        if on_score is not None:
            on_score(view, scores[-1])
        if on_image is not None:
            on_image(view, scores[-1], to_bytes(output.image), to_bytes(photo.over(background)))

    with ThreadPoolExecutor(max_workers=1) as worker:
        waiting = None
        for view in views:
            photo: Photo = view.read()
            if photo.mask is not None and not photo.mask.any():
                continue
            with torch.no_grad():
                output = render(gaussians, view.camera)
            scored = worker.submit(score_photo, view.name, photo, output, background)
            if waiting is not None:
                tell(*waiting)
            waiting = view, photo, output, scored
        if waiting is not None:
            tell(*waiting)
    return scores


def summarize(scores: Sequence[ImageScore]) -> dict[str, float | int | None]:
    """Average scores over images, by the names of `ImageScore`; and count them as num_images.

    A mean is None if there are no images, or if the score is None for all of them.
    """
    means: dict[str, float | int | None] = {}
    for key in MEASURES:
        values = [value for score in scores if (value := getattr(score, key)) is not None]
        means[key] = float(np.mean(values)) if values else None
    return {**means, "num_images": len(scores)}


def worst(scores: Sequence[ImageScore]) -> ImageScore:
    """Return the score with the lowest PSNR; the first of equal ones.

    Raises:
        ArgumentError: there are no scores.
    """
    if not scores:
        raise ArgumentError("scores: is empty; score at least one view")
    return min(scores, key=lambda score: score.psnr)


def best(scores: Sequence[ImageScore]) -> ImageScore:
    """Return the score with the highest PSNR; the first of equal ones.

    Raises:
        ArgumentError: there are no scores.
    """
    if not scores:
        raise ArgumentError("scores: is empty; score at least one view")
    return max(scores, key=lambda score: score.psnr)


def _gradient_energy(image: Float64[np.ndarray, "H W 3"]) -> Float64[np.ndarray, "2"]:
    """Return the mean squared horizontal and vertical differences at half size, over the squared mean brightness."""
    H, W = (2 * (side // 2) for side in image.shape[:2])
    grey = (image[:H, :W, 0] + image[:H, :W, 1] + image[:H, :W, 2]) / 3.0
    rows = grey[::2] + grey[1::2]
    small = (rows[:, ::2] + rows[:, 1::2]) / 4.0
    energy = np.array([np.square(np.diff(small, axis=axis)).mean() for axis in (1, 0)])
    return np.asarray(energy / max(float(small.mean()), 1e-3) ** 2)


class _Pair:
    """A render and its photo after validation: float64, 0 to 1, and the mask (None: all pixels count)."""

    def __init__(
        self,
        image: ArrayLike,
        truth: ArrayLike,
        mask: ArrayLike | None,
        transparency: Transparency | None = None,
    ) -> None:
        self.transparency = transparency
        sizes: dict[str, int] = {}
        self.render = np.clip(float64_array("image", as_array(image), ("H", "W", 3), sizes), 0.0, 1.0)
        given = as_array(truth)
        self.photo = float64_array("truth", given, ("H", "W", 3), sizes)
        if given.dtype == np.uint8:
            self.photo = self.photo / 255.0
        self.counts: Bool[np.ndarray, "H W"] | None = None
        if mask is not None:
            self.counts = as_array(mask).astype(bool)
            check_shape("mask", self.counts.shape, ("H", "W"), sizes)
            if not self.counts.any():
                raise ArgumentError("mask: no pixel counts; leave the image out")

    def psnr(self) -> float:
        error = self.render - self.photo
        return _decibels(self._mean(np.square(error, out=error)))

    def psnr_8bit(self) -> float:
        error = levels(self.render)
        error /= 255.0
        error -= self.photo
        return _decibels(self._mean(np.square(error, out=error)))

    def ssim(self) -> float:
        planes = (self.render, self.photo)
        if self.counts is not None:
            inside = self.counts[..., None]
            planes = (np.where(inside, self.render, 0.0), np.where(inside, self.photo, 0.0))
        x, y = (torch.from_numpy(np.array(plane)) for plane in planes)
        return 1.0 - float(l1_ssim(x, y, ssim_weight=1.0))

    def psnr_fitted(self) -> float | None:
        middle = self.render.shape[1] // 2
        counts = np.ones(self.render.shape[:2], dtype=bool) if self.counts is None else self.counts
        tested = counts[:, middle:]
        if not tested.any():
            return None
        shown, backdrop = counts[:, :middle], None
        if self.transparency is not None:
            shown = shown & self.transparency.opaque[:, :middle]
            transmittance = self.transparency.backdrop.transmittance.detach().cpu().double()
            backdrop = Backdrop(transmittance[:, middle:], self.transparency.backdrop.background)
        image, photo = torch.from_numpy(self.render), torch.from_numpy(self.photo)
        gains = measured_gains(image[:, :middle], photo[:, :middle], torch.from_numpy(shown))
        fitted = recolored(image[:, middle:], color_matrix(gains), None, backdrop)
        return _Pair(fitted.numpy(), self.photo[:, middle:], tested).psnr()

    def added_detail(self) -> float | None:
        if self.counts is not None or self.transparency is not None or min(self.photo.shape[:2]) < 4:
            return None
        render, photo = _gradient_energy(self.render), _gradient_energy(self.photo)
        if not (render.all() and photo.all()):
            return None
        return float(np.log(render / photo).max())

    def l1(self) -> float:
        error = self.render - self.photo
        return self._mean(np.abs(error, out=error))

    def _mean(self, errors: Float64[np.ndarray, "H W 3"]) -> float:
        return float((errors if self.counts is None else errors[self.counts]).mean())


def _decibels(error: float) -> float:
    """Return the PSNR of a mean squared error."""
    return float(-10.0 * np.log10(max(error, MSE_FLOOR)))
