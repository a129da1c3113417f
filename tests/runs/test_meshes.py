"""What `gsplat-edu mesh` leaves in a run: the record, the pictures, and the section of the report."""

import functools
import json
import re
import shutil

import numpy as np
import pytest
from PIL import Image

from gsplat_edu import Camera, write_scene
from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.base.locks import locked
from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.evaluate.mesh_report import BEGIN, END, MeshEntry, mesh_section
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.evaluation import ScoredViews, evaluate_run
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.scene.views import View
from painted_ball import photo_of_ball
from splat_ball import RADIUS, ball
from systems import needs_posix

COUNT, SIZE = 16, 96
RENDER = functools.partial(render, settings=RenderSettings(jacobian_limit=1.3, depth=False), backend="cpu")


def photographs():
    """Return renders of the ball from all sides, of which no two are within 30 degrees."""
    index = np.arange(COUNT) + 0.5
    y, turn = 0.9 * (1 - 2 * index / COUNT), np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - y * y)
    eyes = 3.0 * np.stack([ring * np.cos(turn), y, ring * np.sin(turn)], axis=1)
    for number, eye in enumerate(eyes):
        camera = Camera.looking_at(eye, (0, 0, 0), 1.4 * SIZE, 1.4 * SIZE, SIZE, SIZE)
        image = RENDER(ball(), camera).image.clamp(0, 1).numpy()
        yield View(camera, np.rint(255 * image).astype(np.uint8), name=f"{number:02d}.png")


def run_of_ball(home, views):
    """Write a capture and a run with the ball as its scene; return the run's folder and the dataset."""
    write_transforms(home / "capture", list(views), ball().means.numpy(), np.full((3_000, 3), 0.5))
    dataset = load_dataset(home / "capture", DataSettings(test_every=8))
    folder = RunFolder(home / "run")
    folder.write_config(
        {
            "data": {"path": str(home / "capture"), "test_every": 8},
            "render": {"jacobian_limit": 1.3},
            "origin": dataset.origin.tolist(),
        }
    )
    write_scene(folder.scene(7), ball())
    folder.write_cameras(dataset.train, dataset.test, dataset.origin)
    return folder, dataset


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """Return a run of the ball that was evaluated."""
    folder, dataset = run_of_ball(tmp_path_factory.mktemp("meshes"), photographs())
    evaluate_run(folder, ScoredViews(dataset.test, dataset.train), ball(), RENDER)
    return folder


@pytest.fixture
def run(evaluated, tmp_path):
    shutil.copytree(evaluated.path, tmp_path / "run")
    return RunFolder(tmp_path / "run")


def mesh(run, *words):
    out = run.path.parent / "ball.ply"
    assert main(["mesh", str(run.path), str(out), "--voxel", "0.06", "--backend", "cpu", *words]) == 0
    return out


def test_the_record_says_what_is_printed(run, capsys):
    out = mesh(run)
    assert (
        main(["mesh", str(run.path), str(out.with_suffix(".obj")), "--voxel", "0.06", "--truth", str(out)])
        == 0
    )
    said = capsys.readouterr().out
    record = json.loads(run.meshes.read_text())["mesh"]
    assert record["file"].endswith("ball.obj") and record["iterations"] == 7 and record["unit"] is None
    assert f"{record['vertices']:,} vertices, {record['triangles']:,} triangles" in said
    assert f"{100 * record['certain']:.3g} % of the area" in said
    assert f"{100 * record['held_out']['within']:.3g} % of the splats' depths from 2 held-out views" in said
    assert record["held_out"]["views"] == 2 and record["parts"] == 1 and record["boundary_edges"] == 0
    assert f"F1 {record['truth']['f1']:.3f}" in said and record["truth"]["f1"] > 0.99
    np.testing.assert_allclose(record["size"], 1.65, atol=0.1)
    assert 0 < record["spread"] < 0.06 and record["intersections"]["found"] == 0
    assert record["left_out"]["pixels"] == 14 * SIZE * SIZE
    page = run.report.read_text("utf-8")
    for row in (
        "area seen by 3 views or more",
        "none: it is closed",
        "after 7 iterations",
        "<th>F1</th>",
    ):
        assert page.count(row) == 1, row


def test_held_out_photos_are_compared_with_the_mesh(tmp_path, capsys):
    """Photos 18 degrees apart of a painted ball, by its formula, three of them held out; the scene is a ball of splats.

    Photos that are shifted by 16 px show the ball where it is not.
    """
    views = []
    for number, turn in enumerate(np.linspace(0, 2 * np.pi, 20, endpoint=False)):
        eye = 3.0 * np.array([np.cos(turn), 0.0, np.sin(turn)])
        camera = Camera.looking_at(eye, (0, 0, 0), 2.8 * SIZE, 2.8 * SIZE, 2 * SIZE, 2 * SIZE)
        views.append(View(camera, photo_of_ball(camera, radius=RADIUS), name=f"{number:02d}.png"))
    run, dataset = run_of_ball(tmp_path, views)
    evaluate_run(run, ScoredViews(dataset.test, dataset.train), ball(), RENDER)
    mesh(run)
    said = capsys.readouterr().out
    photos = run.read_meshes()["mesh"]["photos"]
    assert photos["views"] == 3 and photos["textured"] > 200 and photos["share"] > 0.8
    assert photos["agreeing"] / photos["textured"] == photos["share"]
    assert f"photos agree with the mesh at {100 * photos['share']:.3g} % of the textured points" in said
    assert (
        f"({photos['textured']:,} of the {photos['points']:,} that 3 held-out photos and a neighbour" in said
    )
    assert run.report.read_text("utf-8").count("<th>points where held-out photos agree</th>") == 1

    for number, path in enumerate(sorted((tmp_path / "capture" / "images").iterdir())):
        Image.fromarray(np.roll(np.array(Image.open(path)), 8 * (-1) ** number, axis=0)).save(path)
    mesh(run)
    moved = run.read_meshes()["mesh"]["photos"]
    assert moved["share"] < photos["share"] - 0.2


def test_a_mesh_that_no_photo_judges_says_why(run, capsys):
    mesh(run)
    assert (
        "no photo is compared (no held-out photo has another one within 30 degrees" in capsys.readouterr().out
    )
    assert run.read_meshes()["mesh"]["photos"] is None
    config = run.read_config()
    config["data"]["path"] = str(run.path / "gone")
    run.write_config(config)
    mesh(run)
    assert re.search(
        r"no photo is compared \(.*gone: the run's dataset no longer exists", capsys.readouterr().out
    )
    cameras = json.loads(run.cameras.read_text())
    run.cameras.write_text(json.dumps([{**camera, "split": "train"} for camera in cameras]))
    mesh(run)
    assert "no photo is compared (the run held out no photo)" in capsys.readouterr().out


@needs_posix
def test_nothing_is_recorded_through_a_link(run, tmp_path, capsys):
    shutil.rmtree(run.renders)
    (tmp_path / "mine").mkdir()
    run.renders.symlink_to(tmp_path / "mine")
    mesh(run)
    said = capsys.readouterr().out
    assert f"not added to the run's report: RUN: {run.renders} is a link that leads out of {run.path}" in said
    assert list((tmp_path / "mine").iterdir()) == [] and not run.meshes.exists()


def test_pictures_show_the_photo_the_mesh_and_the_evidence(run):
    mesh(run)
    record = run.read_meshes()["mesh"]
    assert len(record["pictures"]) == 2 and record["rendered"] == []
    taken = {f"images/{view.name}": view for view in photographs()}
    axes = []
    for number, name in enumerate(record["pictures"]):
        panels = {
            key: np.array(Image.open(run.renders / "mesh" / f"mesh_{number}_{key}.jpg")).astype(float)
            for key in ("photo", "mesh", "views", "agreement")
        }
        photo = taken[name].image
        axes.append(taken[name].camera.R[2])
        on_ball = photo.max(axis=-1) > 100
        # The stripes blur at their edges by the size of a voxel.
        assert np.abs(panels["photo"] - photo)[on_ball].mean() < 8
        assert np.median(np.abs(panels["mesh"] - photo)[on_ball]) < 25
        assert (panels["mesh"][0, 0] > 225).all() and (panels["views"][0, 0] > 225).all()
        # Viridis from violet to yellow: what every view sees has more green than what none does.
        middle = (slice(40, 56), slice(40, 56))
        assert panels["views"][middle][..., 1].mean() > 75
    assert axes[0] @ axes[1] < -0.5  # from opposite sides


def test_a_new_evaluation_keeps_the_section_and_a_new_mesh_replaces_it(run, evaluated):
    before = run.report.read_text("utf-8")
    assert BEGIN + END in before
    mesh(run)
    page = run.report.read_text("utf-8")
    start, stop = page.index(BEGIN), page.index(END)
    assert page[:start] + page[stop:] == before.replace(BEGIN, "")  # nothing else has changed
    assert page[start:stop].count("<img") == 8
    dataset = load_dataset(evaluated.path.parent / "capture", DataSettings(test_every=8))
    evaluate_run(run, ScoredViews(dataset.test), ball(), RENDER)
    again = run.report.read_text("utf-8")
    assert page[start:stop] in again and again.count("<h2>Mesh</h2>") == 1
    mesh(run, "--collider")
    both = run.report.read_text("utf-8")
    assert page[start:stop] in both and both.count("<h2>Collider</h2>") == 1
    assert set(run.read_meshes()) == {"mesh", "collider"}


def test_without_a_report_eval_adds_the_mesh_to_one(run, capsys):
    run.report.unlink()
    mesh(run)
    assert "mesh.json; eval adds it to a report" in capsys.readouterr().out and not run.report.exists()


def test_without_the_photos_the_pictures_say_that_they_are_renders(run):
    config = run.read_config()
    config["data"]["path"] = str(run.path / "gone")
    run.write_config(config)
    mesh(run)
    assert run.read_meshes()["mesh"]["rendered"] == run.read_meshes()["mesh"]["pictures"]
    assert run.report.read_text("utf-8").count("render of the splats</span>") == 2


def test_a_run_in_use_keeps_its_files_and_the_mesh_is_written(run, capsys, monkeypatch):
    monkeypatch.setattr("gsplat_edu.cli.mesh.PATIENCE", 0.0)
    before = run.report.read_bytes()
    with locked("RUN", run.path, "a training", print):
        out = mesh(run)
    assert "the mesh is not added to the run's report" in capsys.readouterr().out and out.is_file()
    assert run.report.read_bytes() == before and not run.meshes.exists()


@pytest.mark.parametrize(
    ("record", "said"),
    [
        ([], "is not a JSON object"),
        ({"mesh": 3}, "mesh.json: mesh: is not an object"),
        ({"mesh": {"triangles": "many"}}, 'triangles: is "many", but has to be a whole number'),
        ({"mesh": {"truth": {"f1": "1"}}}, "each of its values has to be a number or null"),
        ({"mesh": {"pictures": [1]}}, r"pictures\[0\]: is 1, but has to be text"),
    ],
)
def test_a_damaged_record_is_one_line(run, record, said):
    run.meshes.write_text(json.dumps(record))
    with pytest.raises(CheckpointError, match=said):
        run.read_meshes()


def test_texts_of_a_record_are_escaped_and_never_formatted():
    record = {"file": "<b>{0.__class__}</b>", "unit": "{}<i>", "voxel": 0.5, "notes": ["<script>x</script>"]}
    page = mesh_section([MeshEntry("Mesh", record)])
    assert "&lt;b&gt;{0.__class__}&lt;/b&gt;" in page and "0.5 {}&lt;i&gt;" in page
    assert "<script>" not in page and "<i>" not in page
    assert mesh_section([MeshEntry("Mesh", {})]) == BEGIN + END
