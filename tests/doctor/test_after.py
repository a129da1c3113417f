"""Faults of a trained scene, each at three severities: the slightest may pass, the two others are reported."""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.doctor.after import examine_run, view_lines
from gsplat_edu.doctor.diagnosis import diagnosis_lines, event_of
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.parts.exposure.findings import Beforehand, beforehand, check_jumps
from gsplat_edu.parts.transients.findings import check_moved
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.parts import judgements
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.survey.capture import prepare
from gsplat_edu.survey.finding import Examined, Finding, Severity
from gsplat_edu.survey.residuals import residuals
from gsplat_edu.survey.trained import Trained
from splats import splats_on

BACKGROUND = (0.2, 0.3, 0.4)
RENDER = functools.partial(render, settings=RenderSettings(background=BACKGROUND), backend="cpu")

NOISE = 0.02
"""Standard deviation of the noise in every photo, which gives 34 dB."""


@pytest.fixture(scope="module")
def scene():
    """A scene and noisy photos of it: eight for training, four for testing."""
    views, points, colors = procedural_capture(size=48, count=12)
    gaussians = splats_on(points, colors)
    photos = [RENDER(gaussians, view.camera).image.double().numpy() for view in views]
    views = [
        View(view.camera, noisy(photo, NOISE, i), name=view.name)
        for i, (view, photo) in enumerate(zip(views, photos, strict=True))
    ]
    return gaussians, views


def noisy(image, sigma, seed):
    return np.clip(image + sigma * np.random.default_rng(seed).normal(size=image.shape), 0.0, 1.0)


def trained(gaussians, views, **changes):
    train, test = (residuals(gaussians, part, RENDER, BACKGROUND) for part in (views[4:], views[:4]))
    run = Trained(Path("runs/a"), gaussians, 3.5, train, test, 30_000, 30_000)
    return replace(run, **changes)


def examined(run, checks=None):
    """Examine a run with what the parts of its training find; `checks` replaces some of that."""
    found = judgements({}, run)
    if checks is not None:
        found = [one for one in found if not checks.keys() & one.checks.keys()] + [Examined(checks)]
    return examine_run(run, found)


def fitted(run, before):
    """Examine a run of whose photos this was found before the training."""
    return examined(run, {"exposure": check_jumps(run, Beforehand([before]))})


def warnings(run):
    return {f.name: f for f in examined(run).findings if f.severity > Severity.NOTE}


def with_photo(views, i, change):
    changed = list(views)
    changed[i] = View(views[i].camera, change(views[i].read().image.astype(np.float64)), name=views[i].name)
    return changed


def test_a_good_run_gets_no_warning(scene):
    gaussians, views = scene
    run = trained(gaussians, views)
    diagnosis = examined(run)
    assert diagnosis.findings == () and not diagnosis.hopeless
    assert diagnosis.fine == (
        "length",
        "training views",
        "outliers",
        "things that moved",
        "test views",
        "exposure",
        "floaters",
        "splats",
    )
    assert len(diagnosis.advice) == 3


def test_residuals_equal_rendering_and_comparing(scene):
    gaussians, views = scene
    calls = []
    found = residuals(gaussians, views[:3], RENDER, BACKGROUND, lambda: calls.append(1))
    assert len(calls) == 3
    for residual, view in zip(found, views, strict=False):
        assert residual.name == view.name
        assert residual.psnr == psnr(RENDER(gaussians, view.camera).image, view.image)
        assert residual.stops == pytest.approx(0.0, abs=0.05) and residual.veiled == 0.0
    lines = view_lines(trained(gaussians, views))
    values = [float(line.split()[0]) for line in lines]
    assert len(lines) == 12 and values == sorted(values)
    assert sum(" test " in line for line in lines) == 4


def test_a_fully_masked_view_is_left_out(scene):
    gaussians, views = scene
    none = View(views[0].camera, views[0].image, mask=np.zeros((36, 48), dtype=bool), name="masked")
    assert residuals(gaussians, [none], RENDER, BACKGROUND) == []


# Noise of s adds to the existing noise: 10 log10(1 + s² / 0.02²) = 1, 7 and 14 dB.
@pytest.mark.parametrize(("sigma", "is_named"), [(0.01, False), (0.04, True), (0.1, True)])
def test_a_photo_the_scene_cannot_explain(scene, sigma, is_named):
    gaussians, views = scene
    spoiled = with_photo(views, 6, lambda image: noisy(image, sigma, 99))
    found = warnings(trained(gaussians, spoiled))
    names = list(found["unexplained"].images) if "unexplained" in found else []
    assert names == ([views[6].name] if is_named else [])


@pytest.mark.parametrize(("sigma", "is_named"), [(0.01, False), (0.05, True), (0.15, True)])
def test_test_views_that_score_far_below_training_views(scene, sigma, is_named):
    gaussians, views = scene
    spoiled = views
    for i in range(4):
        spoiled = with_photo(spoiled, i, lambda image: noisy(image, sigma, 99))
    assert ("overfitted" in warnings(trained(gaussians, spoiled))) == is_named


@pytest.mark.parametrize(("sigma", "is_named"), [(0.05, False), (0.2, True), (0.4, True)])
def test_a_scene_that_fits_no_photo(scene, sigma, is_named):
    gaussians, views = scene
    spoiled = views
    for i in range(12):
        spoiled = with_photo(spoiled, i, lambda image: noisy(image, sigma, 99))
    assert ("poor fit" in warnings(trained(gaussians, spoiled))) == is_named


@pytest.mark.parametrize(
    ("gain", "reached", "is_early"), [(1.0, 500, True), (-1.0, 500, False), (1.0, 30_000, False)]
)
def test_a_poor_fit_that_still_improves_is_not_blamed_on_the_poses_first(scene, gain, reached, is_early):
    gaussians, views = scene
    spoiled = [View(v.camera, noisy(v.read().image, 0.4, i), name=v.name) for i, v in enumerate(views)]
    run = trained(gaussians, spoiled, reached=reached, planned=reached)
    reachable = float(np.mean([view.psnr for view in run.test]))
    log = [
        {**line, "psnr": line["psnr"] and line["psnr"] - 34.0 + reachable}
        for line in evaluations(reached, gain)
    ]
    advice = warnings(replace(run, log=log))["poor fit"].advice
    assert "check poses and intrinsics" in advice and "--refine auto" in advice
    assert advice.startswith("train for longer first") is is_early


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("stops", "is_named"), [(0.2, False), (0.8, True), (1.6, True)])
def test_a_photo_of_another_exposure(scene, stops, sign, is_named):
    gaussians, views = scene
    spoiled = with_photo(views, 7, lambda image: np.clip(image * 2.0 ** (sign * stops / 2.2), 0.0, 1.0))
    run = trained(gaussians, spoiled)
    assert run.train[3].stops == pytest.approx(sign * stops, abs=0.2)  # bright pixels are clipped
    found = warnings(run)
    assert found["exposure"].images[0].startswith(views[7].name) if is_named else "exposure" not in found


def test_a_scene_that_is_too_dark_as_a_whole_is_not_many_exposure_jumps(scene):
    gaussians, views = scene
    for i in range(len(views)):
        views = with_photo(views, i, lambda image: np.clip(image * 2.0 ** (0.9 / 2.2), 0.0, 1.0))
    run = trained(gaussians, views)
    assert np.median([view.stops for view in run.train]) > 0.4
    assert len(warnings(run)["exposure"].images if "exposure" in warnings(run) else ()) < len(views) / 4


def in_front(gaussians, camera, share):
    """Add a splat a twentieth of the way to the scene that covers about this share of a camera's image."""
    z = 0.05 * 3.2
    # A pixel is covered if alpha is at least 0.2, and 0.9 exp(-r²/2) = 0.2 at r = 1.73 standard deviations.
    pixels = np.sqrt(share * camera.W * camera.H / np.pi) / 1.73
    added = Gaussians(
        means=torch.tensor(camera.eye + z * camera.R[2], dtype=torch.float32)[None],
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=torch.full((1, 3), float(np.log(pixels * z / camera.fx))),
        sh0=torch.zeros(1, 1, 3),
        sh_rest=torch.zeros(1, gaussians.sh_rest.shape[1], 3),
        logit_opacities=torch.logit(torch.tensor([0.9])),
    )
    return Gaussians.concatenated([gaussians, added])


@pytest.mark.parametrize(("share", "is_named"), [(0.005, False), (0.1, True), (0.4, True)])
def test_a_floater_in_front_of_a_camera(scene, share, is_named):
    gaussians, views = scene
    run = trained(in_front(gaussians, views[5].camera, share), views)
    # The image has only 1728 pixels, and a sphere's projection is a little wider than the disc.
    assert run.train[1].veiled == pytest.approx(share, rel=0.25, abs=0.002)
    found = warnings(run)
    assert ("floaters" in found) is is_named
    if is_named:
        assert found["floaters"].images[0].startswith(views[5].name)
        assert "gsplat-edu clean" in found["floaters"].advice


@pytest.mark.parametrize(("share", "severity"), [(0.2, None), (0.5, Severity.NOTE), (0.9, Severity.NOTE)])
def test_faint_splats(scene, share, severity):
    gaussians, views = scene
    faint = torch.arange(len(gaussians)) < share * len(gaussians)
    logits = torch.where(faint, torch.tensor(-6.0), gaussians.logit_opacities)
    diagnosis = examined(trained(replace(gaussians, logit_opacities=logits), views))
    found = [f.severity for f in diagnosis.findings if f.name == "faint splats"]
    assert found == ([severity] if severity else [])


@pytest.mark.parametrize(("share", "is_named"), [(0.005, False), (0.03, True), (0.2, True)])
def test_splats_larger_than_the_scene(scene, share, is_named):
    gaussians, views = scene
    scales = gaussians.log_scales.clone()
    scales[: round(share * len(gaussians)), 1] = 2.0
    run = trained(replace(gaussians, log_scales=scales), views)
    assert ("huge splats" in warnings(run)) == is_named


def test_a_far_sky_causes_no_warning(scene):
    gaussians, views = scene
    sky = gaussians.map(lambda tensor: tensor[: len(gaussians) // 2])
    directions = sky.means / sky.means.norm(dim=1, keepdim=True)
    far = replace(sky, means=400 * directions, log_scales=torch.full_like(sky.log_scales, 3.0))
    far = replace(far, logit_opacities=torch.full_like(far.logit_opacities, 3.0))
    found = warnings(trained(Gaussians.concatenated([gaussians, far]), views))
    assert "huge splats" not in found and "floaters" not in found


@pytest.mark.parametrize(
    ("reached", "planned", "is_named"), [(30_000, 30_000, False), (30_000, None, False), (70, 7000, True)]
)
def test_an_unfinished_training(scene, reached, planned, is_named):
    gaussians, views = scene
    run = trained(gaussians, views, reached=reached, planned=planned)
    assert ("unfinished" in warnings(run)) == is_named


def test_an_empty_scene_is_reported(scene):
    gaussians, views = scene
    empty = gaussians.map(lambda tensor: tensor[:0])
    assert "splats" in warnings(trained(empty, views))


def evaluations(reached, gain, count=8):
    """A log whose test PSNR rises to the scene's 34 dB and gains `gain` decibels in its last quarter."""
    iterations = [reached * i // count for i in range(1, count)]
    return [{"iteration": i, "loss": 0.1, "psnr": None} for i in iterations] + [
        {"iteration": i, "psnr": 34.0 - gain - 3.0 * (0.75 - i / reached) * (i < 0.75 * reached)}
        for i in iterations
    ]


@pytest.mark.parametrize(
    ("reached", "gain", "severity", "says"),
    [
        (
            1500,
            1.0,
            Severity.WARNING,
            "1,500 iterations; the recipe has 30,000, and the test views' PSNR was still rising",
        ),
        (1500, None, Severity.WARNING, "1,500 iterations; the recipe has 30,000"),
        (1500, -1.0, Severity.NOTE, "but the test views' PSNR no longer rises"),
        (30_000, 1.0, None, ""),
    ],
)
def test_a_short_training_is_reported(scene, reached, gain, severity, says):
    """1,500 of 30,000 iterations used to give "length: fine" and "a better scene needs better photos"."""
    gaussians, views = scene
    log = [] if gain is None else evaluations(reached, gain)
    run = trained(gaussians, views, reached=reached, planned=reached, log=log, capture=Path("a b/$c"))
    measured = np.mean([view.psnr for view in run.test])
    assert abs(measured - 34.0) < 0.5, "`evaluations` assumes 34 dB"
    diagnosis = examined(run)
    found = [finding for finding in diagnosis.findings if finding.name == "short training"]
    assert [finding.severity for finding in found] == ([] if severity is None else [severity])
    assert ("length" in diagnosis.fine) is (severity is None)
    if found:
        assert found[0].sentence.endswith(says)
    advice = " ".join([*diagnosis.advice, *(one.text for one in diagnosis.otherwise)])
    longer = "gsplat-edu train 'a b/$c' --iterations 30000 --out out/a_30000"
    assert (longer in advice) is (severity is Severity.WARNING)
    assert ("better photos" in advice) is (severity is not Severity.WARNING)


@pytest.mark.parametrize("strategy", ["fast", "adc"])
@pytest.mark.parametrize("photos", [12, 60])
def test_a_gap_to_the_training_views_comes_before_a_longer_training(scene, strategy, photos):
    """14.3 dB between training and held-out views, after a short training whose PSNR still rose."""
    gaussians, views = scene
    run = trained(gaussians, views, reached=900, planned=900, capture=Path("a"), strategy=strategy)
    run = replace(
        run,
        train=[replace(view, psnr=32.3) for view in run.train for _ in range(photos // 12)],
        test=[replace(view, psnr=18.0) for view in run.test],
        log=evaluations(900, 1.0),
    )
    diagnosis = examine_run(run)
    assert diagnosis.ranked[0].name == run.verdict.cause == ("few photos" if photos < 30 else "overfitted")
    told = [diagnosis.advice, [event_of(one).advice for one in diagnosis.ranked if one.advice]]
    for advice in told:
        assert advice[0].startswith("take more photos") and not any("train for" in one for one in advice), (
            advice
        )
    assert run.verdict.advice == "Take more photos between the existing ones."


@pytest.mark.parametrize("gain", [1.0, -1.0])
@pytest.mark.parametrize(
    ("reached", "is_short", "has_longer"),
    [
        (1_000, True, True),
        (2_999, True, True),
        (3_000, False, True),
        (10_000, False, False),
        (12_000, False, False),
    ],
)
def test_a_run_of_the_fast_recipe_is_judged_by_its_lengths(scene, reached, is_short, has_longer, gain):
    """Its standard length is 3,000 iterations, its longest 10,000. PSNR rises until the end of a run of any length."""
    gaussians, views = scene
    run = trained(gaussians, views, reached=reached, planned=reached, capture=Path("a b/$c"), strategy="fast")
    diagnosis = examined(replace(run, log=evaluations(reached, gain)))
    found = [finding for finding in diagnosis.findings if finding.name == "short training"]
    assert ("length" in diagnosis.fine) is (not found) is (not is_short)
    if found:
        assert found[0].severity is Severity.WARNING
        assert found[0].sentence == f"{reached:,} iterations; the recipe has 3,000"
    said = " ".join([*diagnosis.advice, *(one.text for one in diagnosis.otherwise)])
    length = 3000 if is_short else 10000  # first the length that the finding names, then the longest
    longer = f"train for longer: gsplat-edu train 'a b/$c' --iterations {length} --out out/a_{length}"
    assert (longer in said) is has_longer and ("better photos" in said) is not has_longer
    assert "rising" not in said and "30000" not in said


def test_the_longer_run_of_the_fast_recipe_keeps_the_mean_pace(scene):
    """A longer run also trains on small photos for longer, so the mean time of an iteration stays the same."""
    gaussians, views = scene
    log = [{"iteration": i, "ms": 100.0 if i <= 1_500 else 300.0} for i in range(10, 3_001, 10)]
    run = trained(gaussians, views, reached=3_000, planned=3_000, log=log, capture=Path("a"), strategy="fast")
    said = " ".join(one.text for one in examined(run).otherwise)
    assert "train for longer (about 33 min 20 s at this run's pace): gsplat-edu train a " in said


def test_advice_to_train_for_longer_gives_the_time_at_this_runs_pace(scene):
    """After 400 iterations of 0.8 s, the command for 30,000 iterations used to give no hint that it takes hours."""
    gaussians, views = scene
    log = [{"iteration": i, "ms": 50.0 if i <= 300 else 800.0} for i in range(10, 401, 10)]
    run = trained(gaussians, views, reached=400, planned=400, log=log, capture=Path("a"))
    (found,) = [finding for finding in examined(run).findings if finding.name == "short training"]
    assert found.advice.startswith(
        "train for longer (6 h 40 min or more at this run's pace): gsplat-edu train a "
    )


@pytest.mark.parametrize(("factor", "rising"), [(0.8, True), (1.0, False)])
def test_without_test_views_the_loss_shows_whether_training_still_improves(scene, factor, rising):
    gaussians, views = scene
    log = [{"iteration": i, "loss": 0.1 * (factor if i > 900 else 1.0)} for i in range(10, 1001, 10)]
    run = trained(gaussians, views, test=[], reached=1000, planned=1000, log=log)
    assert run.rising is rising
    assert replace(run, log=[]).rising is None


def test_a_warning_about_the_photos_remains_after_training(scene):
    """A trained scene fits photos of differing exposure, so comparing renders with photos does not reveal the fault."""
    gaussians, views = scene
    before = Finding("exposure", Severity.WARNING, "1 of 12 photos", "fix it", ("a.jpg",), ("+0.6",))
    diagnosis = fitted(trained(gaussians, views), before)
    (found,) = (finding for finding in diagnosis.findings if finding.name == "exposure")
    assert found.images == before.images and found.severity is Severity.WARNING
    assert (
        found.sentence.startswith("1 of 12 photos; the scene fits them") and "exposure" not in diagnosis.fine
    )


def test_an_unexplained_photo_is_not_also_reported_as_fitted(scene):
    """A report used to say that the scene did not explain two photos, and that it fitted the same two."""
    gaussians, views = scene
    run = trained(gaussians, views)
    poor = replace(run.train[0], psnr=run.train[0].psnr - 20.0)
    before = Finding("exposure", Severity.WARNING, "1 of 12 photos", "fix it", (poor.name,), ("+0.4",))
    run = replace(run, train=[poor, *run.train[1:]])
    found = {finding.name: finding for finding in fitted(run, before).findings}
    assert poor.name in found["unexplained"].images
    assert found["exposure"].sentence == "1 of 12 photos"


def test_the_report_says_if_exposure_was_not_compared(scene, tmp_path):
    gaussians, views = scene
    gone = functools.partial(prepare, CaptureReader(tmp_path / "gone"))
    findings, why, correction = beforehand(gone)
    assert findings == () and "gone" in why and correction == "none"
    said = diagnosis_lines(examined(trained(gaussians, views, survey=gone)))
    (line,) = [line for line in said if line.startswith("exposure ")]
    assert line.endswith(f"not between photos: {why}")
    assert not any("not between" in line for line in diagnosis_lines(examined(trained(gaussians, views))))


def test_photos_with_objects_that_others_lack_are_named_with_the_option(scene):
    assert "moved" not in warnings(trained(*scene))
    run = trained(*scene)
    (found,) = check_moved((("b.png", 0.123), ("a.png", 0.02)), len(run.train))
    assert found in examined(run, {"things that moved": [found]}).findings
    assert found.labels == ("b.png (12.3 %)", "a.png (2.0 %)") and "2 photos" in found.sentence
    assert "--transients mask" in found.advice


def test_a_photo_below_the_others_is_suspicious_only_if_the_scene_fits_the_others(scene):
    """In `fern`, the scene was too small to fit any photo well, and the worst photo had no fault."""
    gaussians, views = scene
    run = trained(gaussians, views)

    def advice(usual, split="train"):
        level = {"train": [], "test": []}
        for name, found in (("train", run.train), ("test", run.test)):
            level[name] = [replace(view, psnr=usual + 0.1 * i) for i, view in enumerate(found)]
        level[split][0] = replace(level[split][0], psnr=usual - 8.0)
        changed = replace(run, train=level["train"], test=level["test"])
        (found,) = [finding for finding in examined(changed).findings if finding.name == "unexplained"]
        return found.advice

    assert advice(31.0).endswith("has a wrong pose, train without it")
    badly = advice(25.0)
    assert "train without it" not in badly and "--max-gaussians" in badly and "median 25" in badly
    assert len(run.test) < 4 or "it was held out" in advice(31.0, "test")


@pytest.mark.parametrize(("share", "is_named"), [(0.0023, False), (0.0597, True), (0.2049, True)])
def test_a_phantom_of_a_short_run_is_named(scene, share, is_named):
    """Means over the views of trainings: the worst without a phantom, and the two slightest with one."""
    run = trained(*scene)
    run = replace(run, train=[replace(view, outside=share) for view in run.train], test=[])
    found = {finding.name: finding.sentence for finding in examined(run).findings}
    assert ("outside cut-outs" in found) == is_named
    assert not is_named or found["outside cut-outs"].startswith(f"{100 * share:.0f} %")


def test_a_phantom_of_three_hundredths_is_named(scene):
    run = trained(*scene)
    run = replace(run, train=[replace(view, outside=0.03) for view in run.train], test=[])
    assert "outside cut-outs" in {finding.name for finding in examined(run).findings}
