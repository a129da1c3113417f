import dataclasses
import shutil
from contextlib import contextmanager

import numpy as np
import pytest

import gsplat_edu.cli.main as command_line
from gsplat_edu.base.locks import LOCK, locked
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.io.ply import save_ply
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.identity import photo_digests
from splats import splats_on


@pytest.fixture
def cli():
    return command_line.main


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A capture on disk, and a run of it that stopped after 30 iterations."""
    root = tmp_path_factory.mktemp("made")
    views, points, colors = procedural_capture(size=32, count=6)
    write_colmap(root / "capture", views, points, colors)
    gaussians = splats_on(points, colors)
    folder = RunFolder(root / "run")
    data = {**dataclasses.asdict(DataSettings(test_every=3)), "path": str(root / "capture"), "points": None}
    folder.write_config(
        {
            "version": "0",
            "data": data,
            "train": {"iterations": 70},
            "render": dataclasses.asdict(RenderSettings()),
            "origin": [0.0, 0.0, 0.0],
            "backend": "cpu",
        }
    )
    save_ply(folder.scene(30), gaussians)
    dataset = load_dataset(root / "capture", DataSettings(test_every=3))
    folder.write_cameras(dataset.train, dataset.test)
    return folder, root / "capture"


def test_a_run_is_scored_and_the_files_are_written(made, cli, capsys):
    folder, _ = made
    assert cli(["eval", str(folder.path)]) == 0
    printed = capsys.readouterr().out.splitlines()
    metrics = folder.read_metrics()
    assert (metrics["test"]["num_images"], metrics["train"]["num_images"], metrics["iterations"]) == (
        2,
        4,
        30,
    )
    (test,) = [line for line in printed if line.startswith("test")]
    assert test.split()[1:3] == ["2", f"{metrics['test']['psnr']:.2f}"]
    worst = min(metrics["test_views"], key=lambda entry: entry["psnr"])
    assert f"{worst['name']} ({worst['psnr']:.2f} dB)" in test
    assert printed[-2] == f"wrote {folder.metrics}, {folder.renders / 'test'}/, {folder.report}"
    assert all(
        path.exists() for path in (folder.metrics, folder.report, folder.renders / "test" / "view_000.png")
    )


def test_a_dataset_that_moved_is_named(made, cli, capsys, tmp_path):
    folder, capture = made
    config = folder.read_config()
    moved = RunFolder(tmp_path / "moved")
    moved.write_config({**config, "data": {**config["data"], "path": "/gone"}})
    save = moved.scene(5)
    save.parent.mkdir(parents=True)
    save.write_bytes(folder.scene(30).read_bytes())
    assert cli(["eval", str(moved.path)]) == 2
    error = capsys.readouterr().err
    assert (
        error.count("\n") == 1
        and "/gone: the run's dataset no longer exists" in error
        and "--dataset" in error
    )
    assert cli(["eval", str(moved.path), "--dataset", str(capture), "--backend", "torch"]) == 0
    np.testing.assert_allclose(
        moved.read_metrics()["test"]["ssim"], folder.read_metrics()["test"]["ssim"], atol=1e-4
    )


def contents(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """A capture whose views have the same names and photos, but other cameras."""
    views, points, colors = procedural_capture(size=32, count=6)
    folder = tmp_path_factory.mktemp("other") / "capture"
    write_colmap(folder, [moved_away(view) for view in views], points, colors)
    return folder


def moved_away(view):
    camera = view.camera
    values = {field.name: getattr(camera, field.name) for field in dataclasses.fields(camera) if field.init}
    return type(view)(type(camera)(**(values | {"eye": camera.eye * 1.1})), view.image, name=view.name)


@pytest.fixture
def run(made, tmp_path):
    shutil.copytree(made[0].path, tmp_path / "run")
    return RunFolder(tmp_path / "run")


def test_another_dataset_is_scored_only_into_a_separate_folder(run, other, cli, capsys, tmp_path):
    assert cli(["eval", str(run.path)]) == 0
    before = contents(run.path)
    capsys.readouterr()
    assert cli(["eval", str(run.path), "--dataset", str(other)]) == 2
    error = capsys.readouterr().err
    assert (
        "is not the capture of" in error and "different cameras: view_00" in error and "--out FOLDER" in error
    )
    assert error.count("\n") == 1 and contents(run.path) == before
    words = ["eval", str(run.path), "--dataset", str(other), "--out", str(tmp_path / "apart")]
    (tmp_path / "apart").mkdir()
    (tmp_path / "apart" / LOCK).touch()  # left by a killed evaluation
    for _ in range(2):  # an evaluation may be repeated
        assert cli(words) == 0
        assert "the scores are written to" in capsys.readouterr().out.replace("\n", " ")
    assert contents(run.path) == before
    apart = RunFolder(tmp_path / "apart")
    assert apart.read_metrics()["evaluated"] == {"run": str(run.path), "dataset": str(other)}
    assert apart.read_metrics()["test"]["psnr"] < run.read_metrics()["test"]["psnr"]
    assert apart.report.is_file() and len(list((apart.renders / "test").iterdir())) == 2


def test_an_evaluation_overwrites_neither_runs_nor_other_files(run, cli, capsys, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    for place, says in ((run.path, "holds a run"), (tmp_path / "mine", "holds other files")):
        before = contents(place)
        assert cli(["eval", str(run.path), "--out", str(place)]) == 2
        error = capsys.readouterr().err
        assert says in error and error.count("\n") == 1 and contents(place) == before


def test_an_evaluation_does_not_overwrite_a_run_that_ended_while_it_took_the_lock(
    run, cli, capsys, tmp_path, monkeypatch
):
    """The other run ends between the start of the evaluation and its lock."""
    out, written = tmp_path / "out", []

    @contextmanager
    def late(name, folder, *words):
        shutil.copytree(run.path, folder)
        written.append(contents(folder))
        with locked(name, folder, *words):
            yield

    monkeypatch.setattr("gsplat_edu.cli.eval.locked", late)
    assert cli(["eval", str(run.path), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert f"--out: {out} holds a run" in error and error.count("\n") == 1
    assert [contents(out)] == written


def test_a_copy_of_the_capture_is_accepted_and_a_changed_photo_is_named(made, run, cli, capsys, tmp_path):
    dataset = load_dataset(made[1], DataSettings(test_every=3))
    run.write_photos(photo_digests(dataset))
    copy = tmp_path / "copy"
    shutil.copytree(made[1], copy, copy_function=shutil.copyfile)
    assert cli(["eval", str(run.path), "--dataset", str(copy)]) == 0
    (copy / "images" / "view_002.png").write_bytes((copy / "images" / "view_003.png").read_bytes())
    capsys.readouterr()
    assert cli(["eval", str(run.path), "--dataset", str(copy)]) == 2
    assert "1 of 6 changed since the run started, first view_002.png" in capsys.readouterr().err


@pytest.mark.parametrize("place", ["//server/share", "\\\\server\\share\\x", "a\0b", ""])
def test_a_run_that_names_another_computer_opens_no_connection(run, cli, capsys, place):
    """On Windows, opening a network share sends the user's name to its server, and a run may come from anybody."""
    config = run.read_config()
    run.write_config(config | {"data": config["data"] | {"path": place}})
    assert cli(["eval", str(run.path)]) == 2
    assert "data: path: is not a path of this computer; give the dataset's folder" in capsys.readouterr().err


def test_only_stale_renders_of_other_views_are_removed(run, cli):
    """Older versions left renders of another dataset in the run's folder."""
    folder = run.renders / "test"
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("stray_1.png", "stray_2.png", "mine.png", "notes.txt"):
        (folder / name).write_text("x")
    run.write_metrics({"test_views": [{"name": "stray/1.jpg"}, {"name": "stray_2.png"}, {"name": 7}, None]})
    assert cli(["eval", str(run.path)]) == 0
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["mine.png", "notes.txt", "view_000.png", "view_003.png"]


def test_a_folder_that_is_not_a_run_is_a_one_line_error(cli, capsys, tmp_path):
    for arguments in ([str(tmp_path)], [str(tmp_path), "--backend", "abacus"]):
        assert cli(["eval", *arguments]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_help_shows_an_example(cli, capsys):
    with pytest.raises(SystemExit):
        cli(["eval", "--help"])
    assert "example: gsplat-edu eval " in capsys.readouterr().out


def test_a_training_without_scores_names_the_command_that_scores_it(made, cli, tmp_path, capsys):
    _, capture = made
    words = ["train", str(capture), "--iterations", "8", "--test-every", "3", "--eval-every"]
    unscored, scored = (RunFolder(tmp_path / name) for name in ("unscored", "scored"))
    assert cli([*words, "0", "--out", str(unscored.path)]) == 0
    said = capsys.readouterr().out.replace("\n", " ")
    assert "--eval-every 0 skipped the scores of 2 held-out and 4 training photos" in said
    assert f"gsplat-edu eval {unscored.path}" in said and "worst view" not in said
    assert not unscored.renders.exists()
    assert cli(["info", str(unscored.path)]) == 0
    assert "--eval-every 0 skipped the scores" in capsys.readouterr().out.replace("\n", " ")
    assert cli([*words, "0", "--out", str(unscored.path), "--resume"]) == 0
    assert "nothing to do" in capsys.readouterr().out
    assert cli(["eval", str(unscored.path)]) == 0
    assert cli([*words, "1000", "--out", str(scored.path)]) == 0
    assert unscored.scene(8).read_bytes() == scored.scene(8).read_bytes()
    assert unscored.read_metrics()["test"] == scored.read_metrics()["test"]
