"""`convert --size`: the size of the file, what is said, and what is refused."""

import re

import numpy as np
import pytest
import torch

from gsplat_edu.base.constants import SIZED
from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.io.sized import Ranked, Setting
from gsplat_edu.render.api import render
from gsplat_edu.runs.importance import importance_of
from gsplat_edu.runs.source import open_source
from gsplat_edu.viewer.export import read_back
from scene_files import make_run, random_scene

SPLATS = 3000


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    """A scene of which most splats are faint."""
    path = tmp_path_factory.mktemp("scene") / "in.ply"
    gaussians = random_scene(SPLATS).gaussians
    gaussians.logit_opacities[::3] += 3.0
    gaussians.logit_opacities[1::3] -= 3.0
    write_scene(path, Scene(gaussians, False, (0.0, -1.0, 0.0)))
    return path


@pytest.mark.parametrize(
    ("ending", "size", "most"),
    [
        (".spz", "30kB", 30_000),
        (".spz", "70000", 70_000),
        (".sog", "60KiB", 61_440),
        (".compressed.ply", "0.05MB", 50_000),
        (".html", "300kB", 300_000),
    ],
)
def test_a_file_takes_99_to_100_per_cent_of_its_budget(convert, scene_file, tmp_path, ending, size, most):
    out = tmp_path / f"new/out{ending}"
    said = convert(scene_file, out, "--size", size, "--verify")
    assert 0.99 * most <= out.stat().st_size <= most
    written = read_back(out)
    kept, degree = len(written.gaussians), written.gaussians.sh_degree
    assert kept < SPLATS or degree < 3 or "the others" in said
    counted = rf"{kept:,} (of {SPLATS:,} splats|splats, some merged, for {SPLATS:,})"
    assert re.search(rf"wrote {re.escape(str(out))}: {counted}, SH degree {degree}", said)
    assert f"{out.stat().st_size:,} of {most:,} bytes" in said
    assert float(re.search(r"PSNR ([\d.]+) dB over 8 views", said)[1]) > 15


@pytest.mark.parametrize("ending", SIZED)
def test_a_scene_that_fits_is_written_whole_as_without_a_budget(convert, scene_file, tmp_path, ending):
    said = convert(scene_file, tmp_path / f"a/x{ending}", "--size", "5MB")
    convert(scene_file, tmp_path / f"b/x{ending}")
    assert (tmp_path / f"a/x{ending}").read_bytes() == (tmp_path / f"b/x{ending}").read_bytes()
    assert f"the whole scene in the format's full precision: {SPLATS:,} splats, SH degree 3" in said


def test_the_photos_of_a_run_tune_its_small_file(convert, tmp_path):
    """Fewer splats take over what the others showed, with the same bits on any number of threads."""
    write_colmap(tmp_path / "capture", *procedural_capture(48, 8, splats=700))
    run = tmp_path / "run"
    words = ["train", tmp_path / "capture", "--out", run, "--iterations", "80", "--trust-poses"]
    assert main([str(word) for word in words]) == 0
    before, files = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            out = tmp_path / f"{threads}.spz"
            said = convert(run, out, "--size", "9kB")
            files.append(out.read_bytes())
    finally:
        torch.set_num_threads(before)
    assert files[0] == files[1] and 0.99 * 9_000 <= len(files[0]) <= 9_000
    untuned, tuned = map(float, re.search(r"tuned from ([\d.]+) to ([\d.]+) dB on its photos", said).groups())
    assert tuned > untuned + 0.5
    (tmp_path / "capture").rename(tmp_path / "moved")
    assert "not tuned on the photos: " in convert(run, out, "--size", "9kB")
    assert "after --crop" in convert(run, out, "--size", "9kB", "--crop=-99,-99,-99,99,99,99")
    convert(run, out, "--size", "9kB", "--dataset", tmp_path / "moved")
    assert out.read_bytes() == files[0]


@pytest.mark.parametrize("ending", [".spz", ".sog"])
def test_the_bytes_do_not_depend_on_the_number_of_threads(convert, tmp_path, ending):
    folder, *_ = make_run(tmp_path / "run")
    write_scene(folder.scene(7), random_scene(1500))
    before, files = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            out = tmp_path / str(threads) / f"x{ending}"
            convert(folder.path, out, "--size", "25kB")
            files.append(out.read_bytes())
    finally:
        torch.set_num_threads(before)
    assert files[0] == files[1]


def test_the_run_s_cameras_rank_splats_better_than_chance(tmp_path):
    folder, *_, cameras = make_run(tmp_path / "run")
    write_scene(folder.scene(7), random_scene(1500))
    source = open_source(folder.path)
    gaussians = source.scene.gaussians
    found = importance_of(source).splats

    def quality(importance):
        part = Ranked(gaussians, importance).part(Setting(3), 500).gaussians
        with torch.no_grad():
            pairs = [
                [render(g, camera, settings=source.settings).image.clamp(0, 1) for g in (part, gaussians)]
                for camera in cameras
            ]
        return float(np.mean([psnr(*pair) for pair in pairs]))

    by_chance = [quality(np.random.default_rng(seed).random(1500)) for seed in range(3)]
    assert quality(found) > max(by_chance) + 3.0


def test_what_no_camera_sees_goes_first(tmp_path):
    folder, *_ = make_run(tmp_path / "run")
    gaussians = random_scene(1500).gaussians
    gaussians.means[:700] += 500.0
    write_scene(folder.scene(7), gaussians)
    found = importance_of(open_source(folder.path)).splats
    assert (found[:700] == 0.0).all() and (found[700:] > 0.0).mean() > 0.5


def test_the_splats_of_a_moved_scene_are_weighed_by_the_moved_cameras(convert, tmp_path):
    folder, *_ = make_run(tmp_path / "run")
    write_scene(folder.scene(7), random_scene(1500))
    out = tmp_path / "moved.compressed.ply"
    convert(folder.path, out, "--size", "25kB", "--transform", "move=3,0,0")
    plain = tmp_path / "plain.compressed.ply"
    convert(folder.path, plain, "--size", "25kB")
    moved, still = read_back(out).gaussians, read_back(plain).gaussians
    assert len(moved) == len(still)
    middle = still.means.mean(dim=0) + torch.tensor([3.0, 0.0, 0.0])
    torch.testing.assert_close(moved.means.mean(dim=0), middle, rtol=0, atol=0.005)


def test_mistakes_are_one_line(convert, scene_file, tmp_path):
    out = tmp_path / "out.spz"
    assert "is not a size" in convert(scene_file, out, "--size", "big", code=2)
    assert "--size: is 0 bytes" in convert(scene_file, out, "--size", "0", code=2)
    assert "cannot be fitted; write .spz, .sog" in convert(
        scene_file, tmp_path / "out.ply", "--size", "1MB", code=2
    )
    assert "cannot be fitted" in convert(scene_file, tmp_path / "meta.json", "--size", "1MB", code=2)
    out.write_bytes(b"as before")
    said = convert(scene_file, out, "--size", "2kB", code=2)
    smallest = int(re.search(r"of 256 splats, has ([\d,]+) bytes", said)[1].replace(",", ""))
    assert "--size: 2,000 bytes are too few" in said and out.read_bytes() == b"as before"
    convert(scene_file, out, "--size", smallest)
    assert 0.99 * smallest <= out.stat().st_size <= smallest
