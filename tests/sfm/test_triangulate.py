"""Points triangulated from given poses lie on the scene, and a run starts and resumes with them."""

import importlib.util
import json
import math
import queue
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.runs.start_points import with_start_points
from gsplat_edu.scene.views import View
from gsplat_edu.sfm import colmap
from gsplat_edu.sfm.colmap import forward_messages
from gsplat_edu.sfm.triangulate import LEAST_POINTS, STAGES, triangulate
from gsplat_edu.train.config import recipe
from lab.captures.textured_box import BOX_FACES, box_orbit, photograph_box
from waiting import PATIENCE

pytestmark = pytest.mark.slow

pytest.importorskip("pycolmap")


GIVEN = [
    "--strategy",
    "fast",
    "--max-gaussians",
    "3000",
    "--sh-degree",
    "0",
    "--eval-every",
    "0",
    "--save-every",
    "4",
]
GIVEN += [f"--{name}=none" for name in ("appearance", "sky", "transients", "refine")]


@pytest.fixture(scope="module")
def views():
    return [
        View(camera, photograph_box(camera), name=f"{i:02d}.png")
        for i, camera in enumerate(box_orbit(16, turn=math.pi))
    ]


def distances(points):
    """Return each point's distance to the nearest face of the box or of the floor."""
    found = []
    for corner, a, b in BOX_FACES:
        normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
        local = points - corner
        inside = [np.clip(local @ edge / (edge @ edge), 0, 1) for edge in (a, b)]
        nearest = corner + inside[0][:, None] * a + inside[1][:, None] * b
        found.append(np.linalg.norm(points - nearest, axis=1))
        assert abs(normal @ a) < 1e-9
    return np.min(found, axis=0)


def test_the_points_lie_on_the_scene(views, tmp_path):
    told = []
    cloud = triangulate(views, tmp_path / "work", lambda *told_now: told.append(told_now))
    assert len(cloud.points) >= LEAST_POINTS and {stage for stage, *_ in told} == set(STAGES)
    off = distances(cloud.points)
    # A pixel is 1/280 of the distance of 3, about 0.011. Two rays with errors of half a pixel meet within a few
    # pixels.
    assert np.median(off) < 0.01 and np.quantile(off, 0.9) < 0.05
    assert cloud.colors.min() >= 0 and cloud.colors.max() <= 1 and cloud.colors.std() > 0.05
    assert not (tmp_path / "work").exists(), "the work folder is removed"


def test_the_points_are_the_same_bits_for_any_number_of_threads(views, tmp_path):
    one, two = (triangulate(views, tmp_path / "work", threads=threads) for threads in (1, 2))
    assert np.array_equal(one.points, two.points) and np.array_equal(one.colors, two.colors)


def test_only_the_job_itself_opens_the_database_while_it_runs(views, tmp_path, monkeypatch):
    """A second process that opens or closes the file locks it for a moment, and COLMAP does not wait: the job fails."""

    def refuse(*words, **options):
        raise AssertionError("opened by another process")

    monkeypatch.setattr(sqlite3, "connect", refuse)
    told = []
    assert triangulate(views, tmp_path / "work", lambda *told_now: told.append(told_now)) is not None
    for stage in STAGES[:2]:
        done = [count for name, count, _ in told if name == stage]
        total = {total for name, _, total in told if name == stage}
        assert done == sorted(done) and {done[-1]} == total, (stage, done, total)


def test_a_job_whose_last_line_is_cut_off_has_ended():
    """A process that is killed while it writes leaves half a line; the program must not wait for more."""
    writes = 'import os; os.write(1, b\'{"done": 3}\\n{"result": {"poi\')'
    answers = queue.SimpleQueue()
    with subprocess.Popen([sys.executable, "-c", writes], stdout=subprocess.PIPE) as process:
        forward_messages(process, answers)
    assert [answers.get(), answers.get()] == [{"done": 3}, {"ended": True}] and answers.empty()


@pytest.mark.own_process
def test_a_job_whose_parent_was_killed_while_it_started_ends(views, tmp_path):
    """Otherwise it would work on, and lock the next run's COLMAP out of the database."""
    engine = Path(colmap.__file__).parent / "engine" / "__main__.py"
    for view in views:
        Image.fromarray(np.round(255 * view.read().image).astype(np.uint8)).save(tmp_path / view.name)
    camera = views[0].camera
    group = {
        "names": [view.name for view in views],
        "width": camera.W,
        "height": camera.H,
        "focal": camera.fx,
    }
    order = {"job": "features", "database": str(tmp_path / "db"), "photos": str(tmp_path), "masks": ""}
    order |= {"groups": [group], "sift": {"max_num_features": 500}, "threads": 1, "seed": 0}
    with subprocess.Popen(
        [sys.executable, "-P", engine], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        said, _ = process.communicate(json.dumps(order).encode() + b"\n", timeout=PATIENCE)
    assert process.returncode == 1 and b"result" not in said


def test_photos_that_do_not_match_give_no_points(tmp_path):
    plain = procedural_capture(size=32, count=4)[0]
    assert triangulate(plain, tmp_path / "work") is None


def test_a_run_starts_from_triangulated_points_and_resumes_with_them(views, tmp_path, capsys):
    write_transforms(tmp_path / "capture", views)
    run = ["train", str(tmp_path / "capture"), "--out", str(tmp_path / "run"), *GIVEN, "--iterations"]
    assert main([*run, "6"]) == 0
    said = capsys.readouterr().out
    assert "start points from the given poses; --points random starts without" in said.replace("\n", " ")
    stored = tmp_path / "run" / "points.ply"
    assert RunFolder(tmp_path / "run").read_config()["data"]["points"] == str(stored.resolve())
    dataset = load_dataset(tmp_path / "capture", points=stored)
    assert dataset.measured and np.median(distances(dataset.points)) < 0.01
    before = stored.read_bytes()
    assert main([*run, "9", "--resume"]) == 0
    assert main([*run, "12"]) == 2 and "add --resume" in capsys.readouterr().err
    assert stored.read_bytes() == before and RunFolder(tmp_path / "run").read_metrics()["iterations"] == 9


def test_the_coarse_model_of_blocks_starts_from_triangulated_points(views, tmp_path, capsys):
    write_transforms(tmp_path / "capture", views)
    words = ["train", str(tmp_path / "capture"), "--out", str(tmp_path / "run"), "--blocks", "1", *GIVEN]
    words += ["--iterations", "8", "--min-views", "1", "--until", "split"]
    assert main(words) == 0
    assert "start points from the given poses" in capsys.readouterr().out
    assert (tmp_path / "run" / "coarse" / "points.ply").is_file()
    assert main([*words, "--resume"]) == 0, "the points are taken from the folder"


def test_random_points_on_request_and_without_the_extra(views, tmp_path, capsys, monkeypatch):
    write_transforms(tmp_path / "capture", views)
    run = ["train", str(tmp_path / "capture"), *GIVEN, "--iterations", "2", "--out"]
    assert main([*run, str(tmp_path / "a"), "--points", "random"]) == 0
    assert "triangulate" not in capsys.readouterr().out and not (tmp_path / "a" / "points.ply").exists()
    found = importlib.util.find_spec
    monkeypatch.setattr(
        "gsplat_edu.runs.start_points.importlib.util.find_spec",
        lambda name, *rest: None if name == "pycolmap" else found(name, *rest),
    )
    assert main([*run, str(tmp_path / "b")]) == 0
    said = capsys.readouterr().out.replace("\n", " ")
    assert "the capture has no points; " in said and "lets train triangulate" in said
    assert RunFolder(tmp_path / "b").read_config()["data"]["points"] is None


def test_a_short_time_limit_leaves_no_time_to_triangulate(views, tmp_path):
    write_transforms(tmp_path / "capture", views)
    options = RunOptions(tmp_path / "capture", tmp_path / "run", recipe(10, strategy="fast"), DataSettings())
    said = []
    reader = CaptureReader(options.data)
    assert with_start_points(options, reader, said.append, time_limit=20.0).points is None
    assert said == [
        "the time limit is too short to triangulate start points; the run starts from random ones"
    ]
    assert with_start_points(options, reader, said.append, time_limit=3_600.0).points is not None
