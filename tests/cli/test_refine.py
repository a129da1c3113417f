"""`--refine`: the capture with refined cameras, the aligned score, and training on that capture."""

import json

import pytest

from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.runs import pilot


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    write_colmap(folder, *procedural_capture(24, 9, splats=60))
    return folder


@pytest.mark.sliced(1, group="reports on photos that differ")
def test_a_run_writes_the_refined_capture_and_an_aligned_score(capture, tmp_path, capsys):
    run = tmp_path / "run"
    words = ["train", str(capture), "--out", str(run), "--iterations", "12", "--refine", "both"]
    assert main(words) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "the capture with its refined cameras" in said
    assert "poses aligned on every other square" in said
    assert json.loads((run / "metrics.json").read_text())["psnr_aligned"] > 0
    assert "pose (and colours, with appearance) fitted on the other" in (run / "report.html").read_text()
    before, after = load_dataset(capture), load_dataset(run / "refined")
    assert [view.name for view in after.train] == [view.name for view in before.train]
    assert any(
        abs(a.camera.eye - b.camera.eye).max() > 1e-6 for a, b in zip(after.train, before.train, strict=True)
    )
    assert all((a.image == b.image).all() for a, b in zip(after.train, before.train, strict=True))
    assert main(["train", str(run / "refined"), "--out", str(tmp_path / "again"), "--iterations", "2"]) == 0


def test_clean_judges_by_the_refined_cameras(capture, tmp_path, monkeypatch):
    """With `--refine`, the scene fits the refined cameras, not the original ones."""
    from gsplat_edu.runs import cleaning

    judged, original = [], cleaning.clean

    def noted(gaussians, train, *others, **more):
        judged.extend(train)
        return original(gaussians, train, *others, **more)

    monkeypatch.setattr(cleaning, "clean", noted)
    run = tmp_path / "run"
    words = ["train", str(capture), "--out", str(run), "--iterations", "12", "--refine", "poses", "--clean"]
    assert main(words) == 0
    refined = {view.name: view.camera for view in load_dataset(run / "refined").train}
    assert judged and all(abs(view.camera.eye - refined[view.name].eye).max() < 1e-9 for view in judged)


@pytest.mark.sliced(2, group="resumed with more to learn")
def test_auto_reports_its_choice_and_a_resumed_run_keeps_it(capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(pilot, "PILOT_STEPS", 20)
    run = tmp_path / "run"
    words = ["train", str(capture), "--out", str(run), "--refine", "auto"]
    assert main([*words, "--iterations", "6"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    chosen = json.loads((run / "config.json").read_text())["train"]["refine"]
    assert f"--refine {chosen}: short trainings score the held-out photos" in said
    assert main([*words, "--iterations", "9", "--resume"]) == 0
    assert "short trainings" not in capsys.readouterr().out
    assert json.loads((run / "config.json").read_text())["train"]["refine"] == chosen


def test_unknown_names_are_refused(capture, tmp_path, capsys):
    assert main(["train", str(capture), "--out", str(tmp_path / "run"), "--refine", "everything"]) == 2
    assert "refine" in capsys.readouterr().err
