"""`--refine`: the capture with refined cameras, the aligned score, and training on that capture."""

import json

import pytest
import torch

from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.parts import bench
from gsplat_edu.parts.poses.refinement import DISTORTIONS, MOTIONS
from gsplat_edu.parts.poses.trials import RefineTrials
from gsplat_edu.runs.training import CaptureRun, RunOptions
from gsplat_edu.train.config import recipe

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    write_colmap(folder, *procedural_capture(24, 9, splats=60))
    return folder


def test_a_run_writes_the_refined_capture_and_an_aligned_score(capture, tmp_path, capsys):
    run = tmp_path / "run"
    words = ["train", str(capture), "--out", str(run), "--iterations", "12", "--refine", "both"]
    assert main(words) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "the capture with its refined cameras" in said
    assert "poses aligned on every other square" in said
    assert json.loads((run / "metrics.json").read_text())["psnr_aligned"] > 0
    assert "pose (and colours, if corrected) fitted on the other" in (run / "report.html").read_text()
    before, after = load_dataset(capture), load_dataset(run / "refined")
    assert [view.name for view in after.train] == [view.name for view in before.train]
    assert any(
        abs(a.camera.eye - b.camera.eye).max() > 1e-6 for a, b in zip(after.train, before.train, strict=True)
    )
    assert all((a.image == b.image).all() for a, b in zip(after.train, before.train, strict=True))
    assert main(["train", str(run / "refined"), "--out", str(tmp_path / "again"), "--iterations", "2"]) == 0


def test_clean_judges_by_the_refined_cameras(capture, tmp_path, monkeypatch):
    """With `--refine`, the scene fits the refined cameras, not the original ones."""
    from gsplat_edu.parts.floaters import part

    judged, original = [], part.clean

    def noted(gaussians, train, *others, **more):
        judged.extend(train)
        return original(gaussians, train, *others, **more)

    monkeypatch.setattr(part, "clean", noted)
    run = tmp_path / "run"
    words = ["train", str(capture), "--out", str(run), "--iterations", "12", "--refine", "poses", "--clean"]
    assert main(words) == 0
    refined = {view.name: view.camera for view in load_dataset(run / "refined").train}
    assert judged and all(abs(view.camera.eye - refined[view.name].eye).max() < 1e-9 for view in judged)


def test_auto_reports_its_choice_and_a_resumed_run_keeps_it(capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bench, "PILOT_STEPS", 20)
    run = tmp_path / "run"
    words = ["train", str(capture), "--out", str(run), "--refine", "auto"]
    assert main([*words, "--iterations", "6"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    chosen = json.loads((run / "config.json").read_text())["train"]["refine"]
    assert f"--refine {chosen}: short trainings score the held-out photos" in said
    trials = json.loads((run / "config.json").read_text())["refine_trials"]
    assert f"{trials['posed']['none']:.2f} dB with none" in said and trials["asked"] == ""
    assert main([*words, "--iterations", "9", "--resume"]) == 0
    assert "short trainings" not in capsys.readouterr().out
    config = json.loads((run / "config.json").read_text())
    assert (config["train"]["refine"], config["refine_trials"]) == (chosen, trials)


def test_the_report_says_whether_a_given_shutter_helped(capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bench, "PILOT_STEPS", 20)
    run = tmp_path / "run"
    words = ["train", str(capture), "--out", str(run), "--refine", "shutter"]
    assert main([*words, "--iterations", "6"]) == 0
    trials = RefineTrials.of(json.loads((run / "config.json").read_text()))
    assert trials is not None and set(trials.moving) == {"none (control)", "shutter"}
    verdict = "improves" if trials.gain > 0 else "does not improve"
    note = f"refine shutter: {trials}"
    assert f": shutter {verdict} them ({trials.gain:+.2f} dB)" in note
    assert note in (run / "report.html").read_text()
    assert main([*words, "--iterations", "9", "--resume"]) == 0
    assert "short trainings" not in capsys.readouterr().out.rpartition("extended from")[2]
    assert RefineTrials.of(json.loads((run / "config.json").read_text())) == trials
    assert note in (run / "report.html").read_text()


@pytest.mark.parametrize("refine", ["poses+lens", "all"])
def test_a_resumed_run_with_lens_or_shutter_has_the_same_bytes(capture, tmp_path, refine):
    def opened(name, *, resume=False):
        config = recipe(30, strategy="fast", max_gaussians=300, refine=refine)
        return CaptureRun(
            RunOptions(capture, tmp_path / name, config, DataSettings(lens="native"), resume=resume)
        )

    whole, first = opened("whole"), opened("parts")
    whole.train()
    assert first.train(lambda: first.trainer.iteration >= 17)
    second = opened("parts", resume=True)
    assert second.trainer.iteration == 17
    second.train()
    (tensors, _), (resumed, _) = whole.trainer.state(), second.trainer.state()
    learned = {"poses+lens": (DISTORTIONS,), "all": (DISTORTIONS, MOTIONS)}[refine]
    assert all(tensors[f"view_model.{name}"].abs().max() > 0 for name in learned)
    assert tensors.keys() == resumed.keys()
    assert all(torch.equal(tensor, resumed[name]) for name, tensor in tensors.items())


def test_unknown_names_are_refused(capture, tmp_path, capsys):
    assert main(["train", str(capture), "--out", str(tmp_path / "run"), "--refine", "everything"]) == 2
    assert "refine" in capsys.readouterr().err
