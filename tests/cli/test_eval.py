import dataclasses

import numpy as np
import pytest

import gsplat_edu.cli.main as command_line
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.io.ply import save_ply
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.folder import RunFolder
from splats import splats_on


@pytest.fixture
def cli():
    return command_line.main


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A capture on disk, and a run of it that was stopped after 30 iterations."""
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
    assert printed[-1] == f"wrote {folder.metrics}, {folder.renders / 'test'}/, {folder.report}"
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
        and "/gone: the run's dataset is no longer there" in error
        and "--dataset" in error
    )
    assert cli(["eval", str(moved.path), "--dataset", str(capture), "--backend", "torch"]) == 0
    np.testing.assert_allclose(
        moved.read_metrics()["test"]["ssim"], folder.read_metrics()["test"]["ssim"], atol=1e-4
    )


def test_what_is_no_run_is_one_line(cli, capsys, tmp_path):
    for arguments in ([str(tmp_path)], [str(tmp_path), "--backend", "abacus"]):
        assert cli(["eval", *arguments]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_help_shows_an_example(cli, capsys):
    with pytest.raises(SystemExit):
        cli(["eval", "--help"])
    assert "example: gsplat-edu eval " in capsys.readouterr().out
