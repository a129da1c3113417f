"""`gsplat-edu clean` on a capture on disk, and `train --clean`."""

import dataclasses
import json

import numpy as np
import pytest
import torch

import gsplat_edu.cli.main as command_line
from gsplat_edu.base.constants import C0
from gsplat_edu.clean.judge import SENTENCES
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.edits.runs import mask_of
from gsplat_edu.io.formats import read_scene
from gsplat_edu.io.ply import save_ply
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.cleaning import default_target
from gsplat_edu.runs.floaters import propose
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.source import open_source
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer import page
from lab.captures.plant import floaters
from splats import splats_on

SETTINGS = RenderSettings(depth=False, jacobian_limit=1.3)


@pytest.fixture
def cli():
    return command_line.main


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A capture, and a run of it with floaters in its scene."""
    root = tmp_path_factory.mktemp("made")
    views, points, colors = procedural_capture(size=24, count=16)
    write_colmap(root / "capture", views, points, colors)
    dataset = load_dataset(root / "capture", DataSettings(test_every=4))
    own = splats_on(points - dataset.origin, colors)
    planted = floaters(own, [view.camera for view in dataset.train], SETTINGS, 8, seed=1)
    bright = dataclasses.replace(planted, sh0=torch.full((8, 1, 3), 0.5 / C0))
    folder = RunFolder(root / "run")
    data = {**dataclasses.asdict(DataSettings(test_every=4)), "path": str(root / "capture"), "points": None}
    folder.write_config(
        {
            "version": "0",
            "data": data,
            "train": {"iterations": 30},
            "render": dataclasses.asdict(SETTINGS),
            "origin": dataset.origin.tolist(),
            "backend": "cpu",
        }
    )
    save_ply(folder.scene(30), Gaussians.concatenated([own, bright]), dataset.origin)
    folder.write_cameras(dataset.train, dataset.test, dataset.origin)
    return folder, root / "capture", len(own)


def test_a_run_is_cleaned_into_a_new_file(made, cli, capsys):
    folder, _, own = made
    before = folder.scene(30).read_bytes()
    assert cli(["clean", str(folder.path)]) == 0
    written = folder.scene(30).with_name("point_cloud.clean.ply")
    printed = capsys.readouterr().out
    removed = own + 8 - len(read_scene(written).gaussians)
    # half of the 8 floaters: the scene is not trained, so the photos judge it with a large error
    assert removed >= 4
    assert f"removed {removed:,} of {own + 8:,} splats, judged by 12 views" in printed
    assert "PSNR of 4 held-out views: " in printed
    assert f"wrote {written}: {own + 8 - removed:,} splats" in printed
    assert folder.scene(30).read_bytes() == before
    counts = [int(line.split()[0]) for line in printed.splitlines() if line.startswith("   ")]
    assert sum(counts) == removed
    written.unlink()


def test_the_editor_proposes_what_is_cleaned(made, cli, tmp_path):
    folder, _, own = made
    assert cli(["clean", str(folder.path), "--out", str(tmp_path / "clean.ply")]) == 0
    steps = []
    found = propose(folder.path, lambda done, total: steps.append((done, total)))
    assert found["basis"] == "Judged by 12 photos, as by gsplat-edu clean."
    removed = np.any([mask_of(tuple(group["runs"]), own + 8) for group in found["groups"]], axis=0)
    kept = open_source(folder.path).scene.gaussians.means[torch.from_numpy(~removed)]
    assert torch.equal(kept, open_source(tmp_path / "clean.ply").scene.gaussians.means)
    assert {group["reason"] for group in found["groups"]} <= set(SENTENCES.values())
    assert 0 < removed.sum() < own and len(steps) > 12 and steps[-1][0] == steps[-1][1]


def test_a_scene_file_is_judged_by_a_capture(made, cli, tmp_path):
    """The same scene gives the same file, whether its photos come from the run or from --dataset."""
    folder, capture, _ = made
    scene = tmp_path / "scene.ply"
    scene.write_bytes(folder.scene(30).read_bytes())
    results = []
    for words in ([str(folder.path)], [str(folder.path), "--dataset", str(capture)]):
        out = tmp_path / "out.ply"
        assert cli(["clean", *words, "--out", str(out)]) == 0
        results.append(out.read_bytes())
    assert results[0] == results[1]
    assert cli(["clean", str(scene), "--dataset", str(capture)]) == 0
    assert len(read_scene(tmp_path / "scene.clean.ply").gaussians) < len(read_scene(scene).gaussians)


def test_a_dry_run_writes_nothing(made, cli, capsys):
    folder, _, _ = made
    before = sorted(
        (path, path.stat().st_mtime_ns) for path in folder.path.rglob("*") if path.name != ".lock"
    )
    assert cli(["clean", str(folder.path), "--dry-run"]) == 0
    after = sorted((path, path.stat().st_mtime_ns) for path in folder.path.rglob("*") if path.name != ".lock")
    assert before == after
    assert "dry run: no scene was written" in capsys.readouterr().out


def test_the_preview_shows_what_was_removed(made, cli, tmp_path):
    """All splats are in the page: removed ones in a pure colour and not faint, the others in grey."""
    folder, _, own = made
    shown = tmp_path / "preview.html"
    out = tmp_path / "clean.ply"
    assert cli(["clean", str(folder.path), "--out", str(out), "--preview", str(shown)]) == 0
    gaussians = page.read(shown).gaussians
    assert len(gaussians) == own + 8
    colors = gaussians.sh0[:, 0].numpy()
    marked = np.ptp(colors, axis=1) > 0.05  # the page stores 16-bit floats
    assert marked.sum() == own + 8 - len(read_scene(out).gaussians)
    assert float(gaussians.opacities[torch.from_numpy(marked)].min()) > 0.59


def test_mistakes_are_one_line(made, cli, capsys, tmp_path):
    folder, capture, _ = made
    scene = tmp_path / "scene.ply"
    scene.write_bytes(folder.scene(30).read_bytes())
    for words, said in {
        (str(scene),): "a scene file has no photos to judge it by; give its capture with --dataset PATH",
        (str(tmp_path / "none.ply"),): "does not exist",
        (str(capture),): "is not a run",
        (str(scene), "--dataset", str(tmp_path / "none")): "does not exist; give the folder of a capture",
        (
            str(scene),
            "--dataset",
            str(capture),
            "--out",
            str(scene),
        ): "is the scene itself; give another file",
        (str(folder.path), "--max-loss", "-1"): "--max-loss",
        (str(folder.path), "--dry-run", "--out", "x.ply"): "--dry-run: writes no scene; remove --out",
        (str(folder.path), "--preview", "x.png"): "--preview: x.png is no page",
        (str(folder.path), "--out", "x.obj"): "--out: x.obj: unknown scene format",
    }.items():
        assert cli(["clean", *words]) == 2, words
        complaint = capsys.readouterr().err
        assert said in complaint, words
        assert complaint.count("\n") == 1


def test_the_scene_of_another_place_is_refused(made, cli, capsys, tmp_path):
    folder, capture, _ = made
    far = read_scene(folder.scene(30)).gaussians
    save_ply(tmp_path / "far.ply", dataclasses.replace(far, means=far.means + torch.tensor([0.0, 1e4, 0.0])))
    assert cli(["clean", str(tmp_path / "far.ply"), "--dataset", str(capture)]) == 2
    assert "is supported by the photos" in capsys.readouterr().err


def test_names_of_cleaned_files(tmp_path):
    for name, cleaned in {
        "a.ply": "a.clean.ply",
        "a.compressed.ply": "a.clean.ply",
        "b.spz": "b.clean.ply",
        "c.x.sog": "c.x.clean.ply",
    }.items():
        assert default_target(tmp_path / name).name == cleaned


def test_a_training_cleans_its_scene_on_request(made, cli, capsys, tmp_path):
    _, capture, _ = made
    run = tmp_path / "run"
    assert cli(["train", str(capture), "--out", str(run), "--iterations", "5", "--clean"]) == 0
    printed = capsys.readouterr().out
    record = json.loads((run / "metrics.json").read_text())
    removed = sum(record["cleaning"]["removed"].values())
    assert f"removed {removed:,} of " in printed
    assert set(record["cleaning"]["removed"]) == {"unseen", "in_front", "refuted"}
    assert record["num_gaussians"] == len(read_scene(RunFolder(run).scene(5)).gaussians)
    assert record["test"]["psnr"] == pytest.approx(record["cleaning"]["psnr_after"], abs=1e-9)


def test_the_edits_of_a_scene_are_carried_over(made, cli, capsys, tmp_path):
    """The cleaned scene has the same operations, which remove what they removed of the run, and can be applied."""
    folder, _, _ = made
    source = open_source(folder.path)
    x = source.scene.gaussians.means[:, 0]
    half = {
        "op": "select",
        "how": "replace",
        "by": "sphere",
        "center": [float(x.max()), 0.0, 0.0],
        "radius": float(x.max()),
    }
    identity = identity_of(source.scene).document()
    document = {
        "format": "gsplat_edu edits",
        "version": 1,
        "scene": identity,
        "operations": [
            half,
            {"op": "shrink", "radius": 0.05},
            {"op": "select", "how": "add", "by": "list", "reason": "by hand", "runs": [0, 3, 40, 20]},
            {"op": "delete"},
        ],
    }
    edits = tmp_path / "edits.json"
    edits.write_text(json.dumps(document))
    out = tmp_path / "clean" / "clean.ply"
    assert cli(["clean", str(folder.path), "--out", str(out), "--edits", str(edits)]) == 0
    carried = json.loads((out.parent / "edits.json").read_text())
    assert [entry["op"] for entry in carried["operations"]] == ["select", "select", "select", "delete"]
    assert carried["operations"][0] == half
    assert carried["operations"][2]["reason"] == "by hand" and len(carried["operations"][2]["runs"]) > 2
    assert cli(["convert", str(out), str(tmp_path / "a.ply"), "--edits", str(out.parent / "edits.json")]) == 0
    assert cli(["convert", str(folder.path), str(tmp_path / "b.ply"), "--edits", str(edits)]) == 0
    of_run, of_clean, both = (
        read_scene(path).gaussians for path in (tmp_path / "b.ply", out, tmp_path / "a.ply")
    )
    rows = [{tuple(row) for row in some.means.tolist()} for some in (of_run, of_clean, both)]
    assert rows[2] == rows[0] & rows[1] and 0 < len(rows[2]) < min(len(rows[0]), len(rows[1]))
    capsys.readouterr()
    for words, said in (
        (["--out", str(out), "--edits", str(edits)], "there is an edits.json beside"),
        (["--edits", str(edits)], "--edits: fit only a PLY"),
        (
            ["--out", str(tmp_path / "x" / "x.ply"), "--edits", str(out.parent / "edits.json")],
            "another scene",
        ),
    ):
        assert cli(["clean", str(folder.path), *words]) == 2
        assert said in capsys.readouterr().err
