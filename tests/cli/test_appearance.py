"""`--appearance`: `auto` decides by the photos, a resumed run keeps the decision, and unknown names are refused."""

import json
import re

import numpy as np
import pytest

from doctor.rooms import room, with_photo
from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_blender, write_colmap
from gsplat_edu.runs.dataset import run_dataset
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.scene.views import View

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def uneven(tmp_path_factory):
    """A capture whose exposures jump from photo to photo."""
    folder, (views, points) = tmp_path_factory.mktemp("uneven"), room("orbit", 96)
    stops = np.random.default_rng(2).uniform(-0.7, 0.7, len(views))
    views = [with_photo(view, view.image * 2.0 ** (s / 2.2)) for view, s in zip(views, stops, strict=True)]
    write_colmap(folder, views, points, np.full((len(points), 3), 0.5))
    return folder


def stored(run):
    return json.loads((run / "config.json").read_text())["train"]["appearance"]


def test_auto_reports_its_choice_and_a_resumed_run_keeps_it(uneven, tmp_path, capsys):
    run = tmp_path / "run"
    words = ["train", str(uneven), "--out", str(run), "--iterations", "6", "--resolution", "2"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "--appearance exposure: " in said and "photos differ in brightness or tint" in said
    assert stored(run) == "exposure"
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["judged_by"] == "psnr_fitted" and metrics["test"]["psnr_fitted"] > 0
    assert "once their exposure is fitted" in (run / "report.html").read_text()
    assert main([*words[:-4], "--iterations", "8", "--resolution", "2", "--resume"]) == 0
    assert "--appearance" not in capsys.readouterr().out and stored(run) == "exposure"
    refused = [*words, "--resume", "--appearance", "none"]
    refused[refused.index("6")] = "9"
    assert main(refused) == 2
    assert "was started with appearance = exposure, not none" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--appearance", "none"], ["--strategy", "adc"]])
def test_adc_and_none_correct_nothing(uneven, tmp_path, capsys, words):
    run = tmp_path / "run"
    assert (
        main(["train", str(uneven), "--out", str(run), "--iterations", "3", "--resolution", "2", *words]) == 0
    )
    assert "--appearance" not in capsys.readouterr().out and stored(run) == "none"


def test_transparent_photos_are_corrected_and_unknown_names_are_refused(tmp_path, capsys):
    views, *_ = procedural_capture(24, 4, splats=60)
    alpha = np.full(views[0].image.shape[:2], 255, np.uint8)
    alpha[:3] = 0
    clear = [View(v.camera, v.image, alpha=alpha, name=v.name.rsplit(".")[0]) for v in views]
    write_blender(tmp_path / "capture", clear, clear[:1])
    words = [
        "train",
        str(tmp_path / "capture"),
        "--out",
        str(tmp_path / "run"),
        "--iterations",
        "2",
        "--appearance",
    ]
    assert main([*words, "brighter"]) == 2
    assert "--appearance" in capsys.readouterr().err and not (tmp_path / "run").exists()
    assert main([*words, "auto"]) == 0
    assert stored(tmp_path / "run") == "none"
    run = tmp_path / "corrected"
    words[3] = str(run)
    assert main([*words, "exposure"]) == 0
    photo = run_dataset(RunFolder(run).read_config()).train[0].read()
    assert photo.alpha is not None and photo.alpha.min() == 0, "the correction comes before the background"
    assert main(["eval", str(run)]) == 0 and main(["doctor", str(run)]) == 0
    assert main([*words, "exposure", "--resume"]) == 0


@pytest.mark.parametrize("appearance", ["auto", "vignetting"])
def test_doctor_compares_a_corrected_run_at_the_exposure_of_each_photo(uneven, tmp_path, capsys, appearance):
    run = tmp_path / "run"
    words = ["train", str(uneven), "--out", str(run), "--iterations", "40", "--resolution", "2"]
    assert main([*words, "--appearance", appearance]) == 0
    assert stored(run) == ("exposure" if appearance == "auto" else appearance)
    capsys.readouterr()
    assert main(["doctor", str(run)]) == 0
    said = capsys.readouterr().out
    assert "each render was given its photo's exposure first" in said
    assert "brighter or darker" not in said and "not all equally bright" not in said
    kept = "exposure" if appearance == "auto" else appearance
    assert set(re.findall(r"--appearance (\w+)", said)) == {kept}, "the advice keeps the setting"
