"""One command turns photos or a video without poses into a scene as good as one trained with the true poses."""

import json
import re

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.scene.views import View
from lab.captures.textured_box import align_cameras, box_camera, box_orbit, photograph_box
from sfm.test_video import write_video
from sfm.textured_box import cameras_of, check

TRAINING = ["--no-rescale", "--strategy", "none", "--eval-every", "1000", "--save-every", "0"]


def trained(source, run, iterations=200):
    """Train from the command line; return the mean PSNR of the test views and of the training views."""
    assert main(["train", str(source), "--out", str(run), "--iterations", str(iterations), *TRAINING]) == 0
    metrics = json.loads((run / "metrics.json").read_text())
    return metrics["test"]["psnr"], metrics["train"]["psnr"]


def a_dozen_photos_train_as_well_as_with_their_true_poses(tmp_path, capsys):
    photos, truth = tmp_path / "photos", {f"{i:02d}.png": camera for i, camera in enumerate(box_orbit(14))}
    photos.mkdir()
    for name, camera in truth.items():
        Image.fromarray(photograph_box(camera)).save(photos / name)
    reached, fitted = trained(photos, tmp_path / "found")
    assert "has no poses; finding them first" in capsys.readouterr().out
    dataset = load_dataset(tmp_path / "found" / "capture", DataSettings(test_every=0))
    cameras = {view.name: view.camera for view in dataset.train}
    assert cameras.keys() == truth.keys()
    check(cameras, truth)

    # Both runs have the same points, moved to the true world for one, so they differ only in poses and lens.
    move = align_cameras(cameras, truth)
    points = move.s * dataset.points @ move.R.T + move.t
    views = [View(camera, photograph_box(camera), name=name) for name, camera in truth.items()]
    write_colmap(tmp_path / "given", views, points, dataset.colors)
    given, _ = trained(tmp_path / "given", tmp_path / "true")
    assert reached > given - 0.5
    # Photos 26 degrees apart predict each other badly even with true poses, so compare the training views.
    _, untrained = trained(tmp_path / "given", tmp_path / "untrained", 1)
    assert fitted > untrained + 4.0


def a_video_becomes_a_scene(tmp_path, _):
    angles = np.linspace(0.0, 2.4, 24)
    video, run = tmp_path / "orbit.mp4", tmp_path / "run"
    path = [box_camera(angle, 0.45 + 0.15 * np.sin(3 * angle)) for angle in angles]
    write_video(video, [photograph_box(camera) for camera in path])
    reached, _ = trained(video, run, 300)
    assert reached > 20.0
    found = cameras_of(run / "capture")
    numbers = {name: int(re.fullmatch(r"frame_(\d{6})\.jpg", name)[1]) for name in found}
    assert len(found) >= 21
    check(found, {name: path[number] for name, number in numbers.items()})
    assert list(run.glob("point_cloud/*/point_cloud.ply"))


@pytest.mark.slow
@pytest.mark.usefixtures("colmap")
@pytest.mark.parametrize(
    "claim", [a_dozen_photos_train_as_well_as_with_their_true_poses, a_video_becomes_a_scene]
)
def test_one_command(tmp_path, capsys, claim):
    """A commit checks one of two claims, which run the same steps; other tests check each step."""
    claim(tmp_path, capsys)
