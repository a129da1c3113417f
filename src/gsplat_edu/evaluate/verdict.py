"""The verdict on a run: how good its scene is, why, and what to do first, from the files of the run's folder.

`train`, `eval`, `doctor RUN`, report.html and the studio show the same words. `doctor` also takes its causes from here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from gsplat_edu.base.constants import FAR_BELOW

FITTED = "psnr_fitted"
"""The score of renders that have the exposure of their photo (`gsplat_edu.evaluate.metrics`)."""

JUDGED_BY = "judged_by"
"""Key of metrics.json: the score that judges the run, if it is not the PSNR."""

MEASURES = ("psnr", "psnr_8bit", "ssim", "l1", FITTED)
"""The scores of an image and of a split, by their names in metrics.json and in `ImageScore`."""

SKIPPED = "not_scored"
"""Key of metrics.json: by "test" and "train", the number of views that an evaluation left out."""

FULL_LENGTH = "full_length"
"""Key of metrics.json: the iterations that the training would have without a time limit."""

USUAL = "usual"
"""Key of metrics.json: the "iterations" and "gaussians" that the recipe takes for such photos by itself."""

BLURRED = "blurred"
"""Key of metrics.json: names of the scored photos that show less detail than their renders."""

PHOTOS = "photos"
"""Key of config.json: what was known of the capture's photos when the run began (`gsplat_edu.doctor.certain`)."""

ALIKE, GOOD, FAIR = 30.0, 25.0, 18.0
"""Lower limits of the mean PSNR of held-out views, dB. From `ALIKE` on a scene is Good, from `GOOD` on unless it is
overfitted, from `FAIR` on it is Fair, and below it is Poor.

Above 30 dB renders are hard to tell from their photos. At half size, `truck11` shows every plank softly at 18.8 to 19.0
dB; longer runs score 17.8 and 17.1 and tear the planks. 8 photos of `snowmiku97` score 25.0, far below all of them."""

OVERFITTED = 5.0
"""From this gap between the PSNR of training and held-out views, dB, the scene has learned its photos only. The gap of
`snowmiku97` is 2.1 with 84 training photos, 2.8 with 48, 6.1 with 24, 10.8 with 14 and 12.5 with 8; a capture of 50
photos with random start points has 12."""

FEW_PHOTOS = 30
"""Fewer photos are the cause of a gap: of the training photos of `snowmiku97`, 48 score as much as 84 do (29.9 dB), 24
lose 1.9 dB and 14 lose 4.3 dB."""

UNPOSED = 0.1
"""Blame photos without a pose from this share of all on. A few always fail, but a tenth is a part of the scene."""

UNFIT = 24.0
"""If the training views' mean PSNR is below this, dB, the scene does not fit its training photos. `fox` has 32.4
after 1,500 iterations, and 22.8 with its cameras shifted by a hundredth of their distance (standard deviation); other
captures have 27 to 32. A short or small training may have less too."""

SHORT = 1 / 3
"""Below this fraction of the usual length, a training is too short. A draft has it, and scores 0.6 dB less than the
standard length on `snowmiku97`; a tenth of the standard length scores 3.1 dB less than half of it."""

BLURRED_SHARE = 0.1
"""Blame blurred photos from this share of all photos on."""

NOTABLE = 0.01
"""A photo shows things that moved if they cover at least this fraction of it."""

UNEVEN = 3.0
"""Blame the photos' exposure if fitting it raises the PSNR of training and of held-out views by this, dB: half the
squared error. Both, because the fit is scored on half of each photo, where a thing that only some photos show may be
missing. For training views it is 0.1 to 0.2 dB of `snowmiku97` and 1.3 of `fox`, whose exposure drifts, but 8.7 after a
quarter of the photos of `snowmiku97` was multiplied by 0.66 or 1.32."""

SMALL = 0.5
"""Below this fraction of the splats that the recipe plans, the scene is too small. `snowmiku97` loses 0.4 dB
with half of them at a quarter of its width and 1.4 dB at a third, and 1.7 dB with a quarter of them."""

MOVING = 0.3
"""If at least this share of the training photos shows things that moved, a subject moves through the scene."""

RANKED = (
    *("no pose", "unfinished", "moving subject", "poor fit", "blurred", "exposure", "few photos", "hole"),
    *("few splats", "overfitted", "short training"),
)
"""Causes of a bad run, by the names of the doctor's findings: causes before what they cause, and the length last."""

LOOKS = {
    "Good": "new views look like the photos",
    "Fair": "new views are soft",
    "Poor": "new views are wrong in places",
}
"""What a scene of each grade looks like from a view that it was not trained on."""


class Cause(NamedTuple):
    """A measured reason why a scene is not better."""

    name: str
    """Of `RANKED`."""
    reason: str
    """A clause that follows "because"."""
    advice: str
    """What to do about it: a sentence."""


@dataclass(frozen=True)
class Measured:
    """What is known of a run; None for what is not.

    Args:
        test, train: Mean PSNR of held-out and of training views, dB.
        fitted: Whether it is that after a fit of the exposure.
        exposure: By how much such a fit raises the PSNR of training and of held-out views, the smaller of both, dB.
        ssim: Mean SSIM of the held-out views.
        photos: Number of photos: training and held-out ones.
        skipped: Numbers of held-out and training views that were not scored on request.
        iterations: Iterations of the training.
        full: Iterations that it would have without a time limit.
        usual: Iterations and splats that the recipe takes by itself.
        splats: Largest number of splats that was allowed.
        unposed: Number of photos of the capture without a pose.
        gap: Photos beside the widest gap around the subject.
        hole: Whether that gap is so wide that nothing in it is known.
        blurred: Photos that show less detail than their renders.
        moving: Share of the training photos that show things which others do not.
        worst: Name and PSNR of the worst of several held-out views.
    """

    test: float | None = None
    train: float | None = None
    fitted: bool = False
    exposure: float | None = None
    ssim: float | None = None
    photos: int | None = None
    skipped: tuple[int, int] | None = None
    iterations: int | None = None
    full: int | None = None
    usual: Mapping[str, int] = field(default_factory=dict)
    splats: int | None = None
    unposed: int = 0
    gap: tuple[str, str] | None = None
    hole: bool = False
    blurred: tuple[str, ...] = ()
    moving: float = 0.0
    worst: tuple[str, float] | None = None

    @property
    def grade(self) -> str:
        """Good, Fair or Poor; Unknown if no held-out view was scored and the training views do not tell either."""
        if self.test is None:
            return "Poor" if self.train is not None and self.train < FAIR else "Unknown"
        if self.is_far_too_short or self.test < FAIR:
            return "Poor"
        overfitted = self.overfit is not None and self.overfit >= OVERFITTED
        return "Good" if self.test >= (ALIKE if overfitted else GOOD) else "Fair"

    @property
    def overfit(self) -> float | None:
        """Gap between training and held-out views, dB."""
        return None if self.train is None or self.test is None else self.train - self.test

    @property
    def is_far_too_short(self) -> bool:
        """Whether a time limit ended the training long before the scene is usable."""
        return (
            self.iterations is not None and self.full is not None and self.iterations < FAR_BELOW * self.full
        )


@dataclass(frozen=True)
class Verdict:
    """How good a run is; `str` gives the sentences for people.

    Args:
        grade: Good, Fair, Poor or Unknown.
        reason: Why it is not better, as a clause; empty if nothing measured says so.
        advice: The one thing to do, a sentence.
        details: PSNR, SSIM, the gap to the training photos and the worst view, for those who ask.
        cause: Name of the reason in `RANKED`; empty without one.
    """

    grade: str
    reason: str
    advice: str
    details: str
    cause: str = ""

    @property
    def sentence(self) -> str:
        """Grade, looks, reason and advice, without a number of decibels."""
        looks = LOOKS.get(self.grade)
        if looks is None:
            return f"{self.grade}: {self.reason}. {self.advice}"
        link = {"Good": ", but "}.get(self.grade, ", because ")
        return f"{self.grade}: {looks}{link + self.reason if self.reason else ''}. {self.advice}"

    def __str__(self) -> str:
        """Return `sentence`."""
        return self.sentence


def verdict(metrics: Mapping[str, Any], config: Mapping[str, Any]) -> Verdict:
    """Judge a run.

    Args:
        metrics: The contents of metrics.json; empty if the run was not evaluated.
        config: The contents of config.json.
    """
    return judged(measured_of(metrics, config))


def judged(run: Measured) -> Verdict:
    """Return the verdict on what is known of a run."""
    details, grade = _details(run), run.grade
    if grade == "Unknown":
        if run.skipped is not None:
            return Verdict(grade, "its photos were not compared with renders", "Score the run.", details)
        if run.train is None:
            return Verdict(grade, "no photo was compared with a render", "Score the run.", details)
        kept = "Hold out every eighth photo in the next training."
        return Verdict(grade, "no photo was held out, which new views could be compared with", kept, details)
    first = next(iter(causes_of(run)), None)
    if grade == "Good" and (first is None or first.name not in ("no pose", "hole")):
        return Verdict(grade, "", "Look at it from all sides, and share it.", details)
    if first is None:
        look = "the worst photo" if run.worst is None else run.worst[0]
        return Verdict(grade, "", f"Compare {look} with its render.", details)
    return Verdict(grade, first.reason, first.advice, details, first.name)


def causes_of(run: Measured) -> tuple[Cause, ...]:
    """Return what is measured to be wrong with a run, in the order of `RANKED`."""
    return tuple(sorted(_causes(run), key=lambda cause: RANKED.index(cause.name)))


def _causes(run: Measured) -> Iterator[Cause]:
    """Find causes, in no order."""
    if run.photos is not None and run.unposed >= UNPOSED * (run.photos + run.unposed) > 0:
        total = run.photos + run.unposed
        yield Cause(
            "no pose",
            f"{run.unposed} of {total} photos could not be placed",
            "Take two more photos beside each of those that were not placed.",
        )
    if run.moving >= MOVING:
        still = "Take the photos again while nothing moves."
        yield Cause(
            "moving subject", f"things moved in {100 * run.moving:.0f} % of the training photos", still
        )
    done = list(_too_little_done(run))
    yield from done
    if run.train is not None and run.train + max(run.exposure or 0.0, 0.0) < UNFIT and not done:
        misfit = "the scene does not even fit the photos that it was trained on, whose poses may be wrong"
        yield Cause("poor fit", misfit, "Train again with refined poses.")
    if run.blurred and (run.photos is None or len(run.blurred) >= BLURRED_SHARE * run.photos):
        number = len(run.blurred)
        what = "1 photo is blurred" if number == 1 else f"{number} photos are blurred"
        yield Cause("blurred", what, f"Leave out or retake the blurred photos, first {run.blurred[0]}.")
    if run.exposure is not None and run.exposure >= UNEVEN:
        uneven = "the photos differ in brightness or white balance"
        yield Cause("exposure", uneven, "Train again with exposure correction.")
    yield from _too_little_seen(run)


def _too_little_seen(run: Measured) -> Iterator[Cause]:
    """Find causes that more photos remove."""
    more = "Take more photos between the existing ones."
    if run.gap is not None:
        more = f"Take more photos between the places of {run.gap[0]} and {run.gap[1]}."
        if run.hole:
            yield Cause("hole", f"no photo was taken between {run.gap[0]} and {run.gap[1]}", more)
    if run.overfit is None or run.overfit < OVERFITTED:
        return
    if run.photos is not None and run.photos < FEW_PHOTOS:
        few = "there is only 1 photo" if run.photos == 1 else f"there are only {run.photos} photos"
        yield Cause("few photos", few, more)
    yield Cause("overfitted", "the scene has learned its photos, not what lies between them", more)


def _too_little_done(run: Measured) -> Iterator[Cause]:
    """Find causes that a longer or larger training removes."""
    wanted = run.usual.get("gaussians")
    if wanted is not None and run.splats is not None and run.splats < SMALL * wanted:
        few = f"it may have only {run.splats:,} of the usual {wanted:,} splats"
        yield Cause("few splats", few, "Train again without a limit on the scene's size.")
    steps = run.iterations
    lengths = [length for length in (run.full, run.usual.get("iterations")) if length is not None]
    if steps is not None and (longer := [length for length in lengths if steps < SHORT * length]):
        short = f"it was trained for only {steps:,} of {longer[0]:,} iterations"
        yield Cause("short training", short, "Give the training more time.")


def measured_of(metrics: Mapping[str, Any], config: Mapping[str, Any]) -> Measured:
    """Collect what the files of a run's folder tell.

    Args:
        metrics: The contents of metrics.json; empty if the run was not evaluated.
        config: The contents of config.json.
    """
    fitted = metrics.get(JUDGED_BY) == FITTED
    key = FITTED if fitted else "psnr"
    held_out, trained = (_gain_of_exposure(metrics, split) for split in ("test", "train"))
    counts = [_whole(_section(metrics, split), "num_images") for split in ("test", "train")]
    usual, began = _section(metrics, USUAL), _section(config, PHOTOS)
    gap = began.get("gap")
    return Measured(
        test=mean_of(metrics, "test", key),
        train=mean_of(metrics, "train", key),
        fitted=fitted,
        exposure=None if fitted or held_out is None or trained is None else min(held_out, trained),
        ssim=mean_of(metrics, "test", "ssim"),
        photos=None if None in counts else sum(filter(None, counts)),
        skipped=_skipped(metrics),
        iterations=_whole(metrics, "iterations"),
        full=_whole(metrics, FULL_LENGTH),
        usual={name: number for name in usual if (number := _whole(usual, name)) is not None},
        splats=_whole(_section(config, "train"), "max_gaussians"),
        unposed=_whole(began, "unposed") or 0,
        gap=(str(gap[0]), str(gap[1])) if isinstance(gap, list) and len(gap) == 2 else None,
        hole=began.get("hole") is True,
        blurred=tuple(map(str, metrics.get(BLURRED) or ())),
        moving=_moving(metrics, counts[1]),
        worst=_worst(metrics),
    )


def skipped_views(metrics: Mapping[str, Any]) -> str:
    """Return how many views of a run were not scored because `--eval-every` was 0; empty if they were scored.

    Args:
        metrics: The contents of metrics.json.
    """
    counts = _skipped(metrics)
    return "" if counts is None else f"{counts[0]} held-out and {counts[1]} training photos"


def mean_of(metrics: Mapping[str, Any], split: str, key: str) -> float | None:
    """Return a mean of metrics.json, for example of the split "test" and the key "psnr"; None if there is none."""
    value = _section(metrics, split).get(key)
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


def _details(run: Measured) -> str:
    """Return the figures behind a verdict as one sentence."""
    after = "" if run.iterations is None else f"After {run.iterations:,} iterations, "
    if run.test is None:
        if run.skipped is not None:
            held, trained = run.skipped
            return f"{after or 'The scene: '}{held} held-out and {trained} training photos were not scored."
        if run.train is None:
            return ""
        known = f"{after}renders of the training photos reach {run.train:.1f} dB PSNR."
        return known[0].upper() + known[1:]
    ssim = "" if run.ssim is None else f", SSIM {run.ssim:.3f}"
    once = " once their exposure is fitted" if run.fitted else ""
    parts = [f"{after}renders of the held-out photos reach {run.test:.1f} dB PSNR{ssim}{once}"]
    if run.overfit is not None:
        side = "below" if run.overfit > 0 else "above"
        parts.append(f"{abs(run.overfit):.1f} dB {side} the training photos")
    if run.worst is not None and not run.fitted:
        parts.append(f"the worst view is {run.worst[0]} at {run.worst[1]:.1f} dB")
    sentence = "; ".join(parts) + "."
    return sentence[0].upper() + sentence[1:]


def _section(contents: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return an object of a file; empty if there is none."""
    found = contents.get(key)
    return found if isinstance(found, Mapping) else {}


def _whole(contents: Mapping[str, Any], key: str) -> int | None:
    """Return a whole number of a file; None if there is none."""
    found = contents.get(key)
    return found if isinstance(found, int) else None


def _gain_of_exposure(metrics: Mapping[str, Any], split: str) -> float | None:
    """Return by how much a fit of the exposure raises the mean PSNR of a split, dB; None if that is unknown."""
    before, after = (mean_of(metrics, split, key) for key in ("psnr", FITTED))
    return None if before is None or after is None else after - before


def _skipped(metrics: Mapping[str, Any]) -> tuple[int, int] | None:
    """Return the numbers of held-out and of training views that were not scored on request."""
    counts = metrics.get(SKIPPED)
    if not isinstance(counts, Mapping):
        return None
    return _whole(counts, "test") or 0, _whole(counts, "train") or 0


def _moving(metrics: Mapping[str, Any], train: int | None) -> float:
    """Return the share of the training photos in which things that moved are masked."""
    photos = _section(metrics, "transients").get("photos")
    shares = (
        [photo.get("share") for photo in photos if isinstance(photo, Mapping)]
        if isinstance(photos, list)
        else []
    )
    moved = sum(isinstance(share, int | float) and share >= NOTABLE for share in shares)
    return moved / train if train and moved > 1 else 0.0


def _worst(metrics: Mapping[str, Any]) -> tuple[str, float] | None:
    """Return name and PSNR of the held-out view with the lowest one; None if fewer than two have one."""
    views = metrics.get("test_views")
    scored = [
        (str(view.get("name", "")), float(view["psnr"]))
        for view in (views if isinstance(views, list) else [])
        if isinstance(view, Mapping) and isinstance(view.get("psnr"), int | float)
    ]
    return min(scored, key=lambda view: view[1]) if len(scored) > 1 else None
