import functools
import json

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.data.loading_notes import OnlyOnePhoto
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.evaluation import ScoredViews, evaluate_run
from gsplat_edu.runs.folder import RunFolder
from splats import splats_on


@pytest.fixture(scope="module")
def capture():
    return procedural_capture(size=32, count=5)


@pytest.fixture
def folder(tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.write_config({"version": "0", "backend": "cpu"})
    return folder


RENDER = functools.partial(render, settings=RenderSettings(depth=False))


def test_a_run_is_evaluated_and_everything_is_written(capture, folder):
    views, points, colors = capture
    gaussians = splats_on(points, colors)
    folder.write_metrics({"seconds": 12.5, "num_gaussians": 1, "mine": "kept"})
    progress = []
    judged = ScoredViews(views[:2], views[2:], notes=[OnlyOnePhoto()])
    result = evaluate_run(
        folder,
        judged,
        gaussians,
        RENDER,
        {"iterations": 70},
        lambda split, score: progress.append((split, score.name)),
    )
    assert progress == [("test", v.name) for v in views[:2]] + [("train", v.name) for v in views[2:]]
    metrics = folder.read_metrics()
    assert metrics == json.loads(json.dumps(result.metrics))
    assert (metrics["seconds"], metrics["mine"], metrics["iterations"]) == (12.5, "kept", 70)
    assert (metrics["num_gaussians"], metrics["train"]["num_images"]) == (len(points), 3)

    # the scores equal those of renders that the test makes
    images = [RENDER(gaussians, view.camera).image for view in views[:2]]
    by_hand = [psnr(image, view.image) for image, view in zip(images, views, strict=False)]
    assert [entry["psnr"] for entry in metrics["test_views"]] == by_hand
    assert metrics["test"]["psnr"] == pytest.approx(np.mean(by_hand), abs=1e-12)
    assert min(by_hand) > 10, "the start points resemble the scene a little"

    picture = np.array(Image.open(folder.renders / "test" / "view_000.png"))
    assert picture.shape == (13 + 24, 32 + 4 + 32, 3)
    np.testing.assert_array_equal(picture[13:, :32], views[0].image)
    np.testing.assert_array_equal(
        picture[13:, 36:], np.floor(255 * images[0].clamp(0, 1).double().numpy() + 0.5)
    )
    assert sorted(p.name for p in (folder.renders / "test").iterdir()) == ["view_000.png", "view_001.png"]
    page = folder.report.read_text()
    assert "view_001.png" in page and "the capture has only one photo" in page


def test_a_run_without_test_views_is_evaluated(capture, folder):
    views, points, colors = capture
    result = evaluate_run(folder, ScoredViews([], views[:1]), splats_on(points, colors), RENDER)
    assert result.metrics["test"] == {
        "psnr": None,
        "psnr_8bit": None,
        "ssim": None,
        "l1": None,
        "psnr_fitted": None,
        "num_images": 0,
    }
    assert result.metrics["train"]["num_images"] == 1
    assert folder.report.is_file() and not folder.renders.exists()


def test_metrics_json_is_checked_for_every_score():
    from gsplat_edu.evaluate import metrics
    from gsplat_edu.runs import fields

    assert fields.MEASURES == metrics.MEASURES


def test_an_evaluation_that_skips_its_views_says_so_and_removes_earlier_scores(capture, folder):
    views, points, colors = capture
    gaussians = splats_on(points, colors)
    evaluate_run(folder, ScoredViews(views[:2], views[2:]), gaussians, RENDER, {"psnr_aligned": 20.0})
    assert len(list((folder.renders / "test").iterdir())) == 2
    judged = ScoredViews(views[:2], views[2:], skipped=True)
    result = evaluate_run(folder, judged, gaussians, RENDER, {"iterations": 70})
    assert (result.test, result.train) == ([], [])
    assert folder.read_metrics() == {
        "num_gaussians": len(points),
        "iterations": 70,
        "not_scored": {"test": 2, "train": 3},
    }
    assert not list((folder.renders / "test").iterdir())
    page = folder.report.read_text()
    assert "Unknown: its photos were not compared with renders. Score the run." in page
    assert "2 held-out and 3 training photos were not scored." in page
    assert f"gsplat-edu eval {folder.path}" in page and "held out for testing" not in page
    evaluate_run(folder, ScoredViews(views[:2], views[2:]), gaussians, RENDER)
    metrics = folder.read_metrics()
    assert "not_scored" not in metrics and metrics["test"]["num_images"] == 2
    assert "--eval-every" not in folder.report.read_text()
