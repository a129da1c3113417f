import json
import os
import subprocess
import sys

import pytest
import torch

import gsplat_edu.cli.main as command_line
from data.pose_programs import write_metashape
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.engine import adapters
from gsplat_edu.io.ply import save_ply
from gsplat_edu.render.backends import BACKENDS, gpu_of, unavailable
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.scene.gaussians import Gaussians


@pytest.fixture
def info(capsys):

    def call(path, code=0):
        assert command_line.main(["info", str(path)]) == code
        printed = capsys.readouterr()
        return printed.err if code else printed.out

    return call


def scene(count=50):
    generator = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        means=torch.rand(count, 3, generator=generator),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), -2.0),
        sh0=torch.zeros(count, 1, 3),
        sh_rest=torch.zeros(count, 8, 3),
        logit_opacities=torch.zeros(count),
    )
    gaussians.means[0] = torch.tensor([-7.0, 0.5, 9.25])
    return gaussians


def test_a_pose_file_of_another_program_is_a_capture(info, tmp_path):
    write_metashape(tmp_path)
    for path in (tmp_path, tmp_path / "cameras.xml"):
        printed = info(path)
        assert "layout     Metashape\n" in printed and "poses of Metashape: 6 of 6 photos" in printed
    (tmp_path / "cameras.xml").write_text("<chunk/>")
    assert "cameras.xml: unknown scene format" in info(tmp_path / "cameras.xml", 2)


def test_without_a_path_the_computer_and_its_backends_are_described(capsys):
    assert command_line.main(["info"]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = [line.split(" ", 1)[0] for line in lines]
    assert names[: 1 + len(BACKENDS)] == ["computer", *BACKENDS]
    (reason,) = [unavailable("cuda")]
    assert f"cuda       not available: {reason}" in lines if reason else "cuda" in names
    assert "cpu        on the processor" in lines
    if unavailable("webgpu") is None:
        assert any(line.startswith(f"webgpu     {gpu_of('webgpu')}") for line in lines)
        assert names.count("adapter") == len(adapters.adapters())


def test_a_scene_is_described_with_warnings_for_odd_values(info, tmp_path):
    gaussians = scene()
    save_ply(tmp_path / "a.ply", gaussians)
    said = info(tmp_path / "a.ply")
    assert "50, SH degree 2" in said and "x -7 to " in said and "to 9.25" in said
    assert "opacity    0.5, 0.5, 0.5, 0.5, 0.5" in said and "0.1353, 0.1353" in said
    assert f"{(tmp_path / 'a.ply').stat().st_size:,} bytes" in said
    assert "warning" not in said

    gaussians.quats[3] = 0
    gaussians.log_scales[4:6, 1] = 5.0
    gaussians.logit_opacities[7:10] = -9.0
    save_ply(tmp_path / "b.ply", gaussians)
    warnings = [line for line in info(tmp_path / "b.ply").splitlines() if line.startswith("warning")]
    assert [line.split()[1] for line in warnings] == ["1", "2", "3"]


def test_an_empty_scene_is_described(info, tmp_path):
    save_ply(tmp_path / "a.ply", scene(1).map(lambda t: t[:0]))
    assert "0, SH degree 2" in info(tmp_path / "a.ply")


def test_a_run_reports_its_progress(info, tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.write_config(
        {"version": "9.9", "train": {"iterations": 7000}, "backend": "cpu", "data": {"path": "x"}}
    )
    said = info(folder.path)
    assert "not started of 7,000" in said and "contains no scene" in said and "not evaluated yet" in said

    folder.log_file.write_text(json.dumps({"iteration": 6999}) + "\n")
    folder.write_metrics({"test": {"psnr": 23.456, "ssim": 0.8, "num_images": 3}, "seconds": 61.0})
    save_ply(folder.scene(7000), scene())
    said = info(folder.path)
    for words in (
        "9.9",
        "iteration 6999 of 7,000",
        "PSNR 23.46 dB, SSIM 0.8000, 3 images",
        "61.0 s",
        "50, SH",
        "path x",
    ):
        assert words in said, words
    assert "train      PSNR" not in said

    scores = {"psnr": 31.5, "ssim": 0.9, "num_images": 21}
    folder.write_metrics({"test": {"psnr": 23.456, "ssim": 0.8, "num_images": 3}, "train": scores})
    assert "train      PSNR 31.50 dB, SSIM 0.9000, 21 images" in info(folder.path)


def test_a_dataset_is_described_and_no_photo_is_decoded(info, tmp_path, monkeypatch):
    views, points, colors = procedural_capture(size=32, count=9)
    write_colmap(tmp_path / "capture", views, points, colors)

    def decode(*_):
        raise AssertionError("a photo was decoded")

    monkeypatch.setattr("gsplat_edu.data.images.ImageStore.read", decode)
    said = info(tmp_path / "capture")
    for words in ("COLMAP", "9: 32x24", "7 for training, 2 held out", f"{len(points):,}", "extent", "fx "):
        assert words in said, words


def test_lens_and_shutter_of_a_capture_are_named(info, tmp_path):
    """Of a file with a distortion and a shutter; a capture of resting pinholes has no line of a shutter."""
    write_transforms(tmp_path, *procedural_capture(size=32, count=9))
    assert "pinhole" in (said := info(tmp_path)) and "rolling" not in said
    path = tmp_path / "transforms.json"
    motion = {"rolling_shutter_time": 0.02, "camera_angular_velocity": [0, 1, 0]}
    contents = json.loads(path.read_text()) | {"camera_model": "OPENCV", "k1": 0.02, "p2": -0.003} | motion
    path.write_text(json.dumps(contents))
    said = info(tmp_path)
    for words in (
        "perspective, k1 0.02, p2 -0.003",
        "rolling in 9 of 9 photos: turn 1.1 degrees, shift 0 world units (medians)",
        "9 of 9 photos have a rolling shutter or motion blur, which is ignored",
    ):
        assert words in said, words


def test_a_path_of_an_unknown_kind_is_a_one_line_error(info, tmp_path):
    assert "does not exist; give a dataset folder" in info(tmp_path / "gone", code=2)
    assert "is not a capture" in info(tmp_path, code=2)
    (tmp_path / "a.txt").write_text("hello")
    assert "a.txt: unknown scene format" in info(tmp_path / "a.txt", code=2)


def test_help_shows_an_example(info, capsys):
    with pytest.raises(SystemExit):
        command_line.main(["info", "--help"])
    assert "example: gsplat-edu info " in capsys.readouterr().out


def test_listing_adapters_prints_no_error_of_a_driver(tmp_path):
    """Mesa's complains if XDG_RUNTIME_DIR is unset, as on a server."""
    if adapters.why_unavailable() is not None:
        pytest.skip("no adapter")
    without = {name: value for name, value in os.environ.items() if name != "XDG_RUNTIME_DIR"}
    words = [sys.executable, "-W", "ignore", "-m", "gsplat_edu", "info"]
    found = subprocess.run(words, check=False, env=without, capture_output=True, text=True, timeout=300)
    assert found.returncode == 0 and "adapter" in found.stdout and found.stderr == ""
