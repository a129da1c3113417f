"""`--transients`: the choice of auto, masks in the run's folder and in the report, and refused values."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from passers_by import pasted

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def struck(tmp_path_factory):
    """A capture with objects pasted into some photos, and the names of these photos."""
    folder = tmp_path_factory.mktemp("struck")
    views, points, colors = procedural_capture(48, 18, splats=200)
    changed, truth = pasted(views, share=0.2, seed=2)
    write_colmap(folder, changed, points, colors)
    return folder, {view.name for view, true in zip(views, truth, strict=True) if true.any()}


@pytest.fixture(scope="module")
def run(struck, tmp_path_factory):
    """A finished run with masks, and its output."""
    return finished(struck[0], tmp_path_factory.mktemp("runs") / "run", "--transients", "mask")


def finished(capture, folder, *words, iterations=200):
    length = ["--iterations", str(iterations), "--appearance", "none"]
    assert main(["train", str(capture), "--out", str(folder), *length, *words]) == 0
    return folder


def stored(run):
    return json.loads((run / "config.json").read_text())["train"]["transients"]


def test_masks_are_saved_scored_and_shown(struck, run):
    capture, names = struck
    entries = json.loads((run / "metrics.json").read_text())["transients"]
    found = [entry["name"] for entry in entries["photos"]]
    dataset = load_dataset(capture)
    training = names & {view.name for view in dataset.train}
    assert training and len(training & set(found)) >= 0.7 * len(training)
    assert entries["left_alone"] == []
    shares = [entry["share"] for entry in entries["photos"]]
    assert shares == sorted(shares, reverse=True) and 0.005 < shares[0] < 0.4
    assert {path.name for path in (run / "transients").iterdir()} == {f"{name}.png" for name in found}
    page = (run / "report.html").read_text()
    assert "Masked things that moved" in page and f"{found[0]}: {100 * shares[0]:.1f} % masked" in page
    assert page.count('alt="photo with its mask"') == min(len(found), 6)
    tests = json.loads((run / "metrics.json").read_text())["test_views"]
    assert len(tests) == len(dataset.test), "held-out photos are scored on all pixels"


def test_saved_masks_are_masks_of_the_capture(struck, run, tmp_path):
    capture, found = tmp_path / "capture", {path.name: path for path in (run / "transients").iterdir()}
    shutil.copytree(struck[0], capture)
    shutil.copytree(run / "transients", capture / "masks")
    for view in load_dataset(capture).train:
        mask = view.read().mask
        if f"{view.name}.png" in found:
            assert (
                np.array_equal(mask, np.asarray(Image.open(found[f"{view.name}.png"])) != 0)
                and not mask.all()
            )
        else:
            assert mask is None


def test_eval_keeps_the_masks_in_the_report(run, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    assert main(["eval", str(copy)]) == 0
    assert 'alt="photo with its mask"' in (copy / "report.html").read_text()
    assert json.loads((copy / "metrics.json").read_text())["transients"]["photos"]


def test_auto_gives_its_reason_and_a_resumed_run_keeps_its_choice(struck, tmp_path, capsys):
    folder = finished(struck[0], tmp_path / "run", "--transients", "auto", iterations=40)
    said = " ".join(capsys.readouterr().out.split())
    assert "--transients mask: 15 training photos are enough to tell what moved" in said
    assert stored(folder) == "mask"
    before = sorted(path.name for path in (folder / "transients").glob("*"))
    finished(struck[0], folder, "--resume", iterations=50)
    assert "--transients" not in capsys.readouterr().out and stored(folder) == "mask"
    assert sorted(path.name for path in (folder / "transients").glob("*")) == before, (
        "the masks are not computed again"
    )
    words = ["train", str(struck[0]), "--out", str(folder), "--iterations", "60", "--appearance", "none"]
    assert main([*words, "--resume", "--transients", "none"]) == 2
    assert "was started with transients = mask, not none" in capsys.readouterr().err


def test_the_default_masks_nothing(struck, tmp_path, capsys):
    folder = finished(struck[0], tmp_path / "run", iterations=3)
    assert stored(folder) == "none" and not (folder / "transients").exists()
    assert "moved" not in capsys.readouterr().out


def test_few_photos_and_unknown_names_are_refused(tmp_path, capsys):
    capture = tmp_path / "few"
    write_colmap(capture, *procedural_capture(24, 5, splats=60))
    words = ["train", str(capture), "--out", str(tmp_path / "run"), "--iterations", "2", "--transients"]
    assert main([*words, "mask"]) == 2
    error = capsys.readouterr().err
    assert "--transients: 4 training photos are too few" in error and len(error.splitlines()) == 1
    assert not (tmp_path / "run").exists()
    assert main([*words, "people"]) == 2
    error = capsys.readouterr().err
    assert "--transients" in error and len(error.splitlines()) == 1
    assert main([*words, "auto"]) == 0
    assert "--transients none: 4 training photos are too few" in " ".join(capsys.readouterr().out.split())
    assert stored(tmp_path / "run") == "none"


def test_doctor_names_the_photos_and_the_option(struck, run, tmp_path, capsys):
    folder = finished(struck[0], tmp_path / "plain")
    ended = " ".join(capsys.readouterr().out.split())
    assert "things or shadows that the other photos do not show in" in ended
    assert f"gsplat-edu doctor {folder}; --transients mask leaves them out" in ended
    assert main(["doctor", str(folder)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "warning moved:" in said and "train with --transients mask" in said
    named = json.loads((run / "metrics.json").read_text())["transients"]["photos"][0]["name"]
    assert named in said.partition("moved:")[2].partition("warning")[0]
    assert main(["doctor", str(run)]) == 0
    assert "warning moved:" not in " ".join(capsys.readouterr().out.split())
