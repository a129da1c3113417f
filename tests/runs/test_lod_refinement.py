"""Levels of detail are refined by photos, and scored at the size at which they are displayed."""

import re

import numpy as np
import pytest

from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.lod import codec
from gsplat_edu.io.lod.levels import LodOptions, build_levels, leaves_of
from gsplat_edu.runs import lod_refinement
from gsplat_edu.runs.lod_refinement import refine_levels
from gsplat_edu.runs.source import open_source
from scene_files import random_scene

pytestmark = pytest.mark.slow

OPTIONS = LodOptions(smallest=30, leaf=40)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short run on photos of 64 x 48 px."""
    folder = tmp_path_factory.mktemp("refine")
    write_colmap(folder / "capture", *procedural_capture(64, 16, splats=150))
    words = ["train", folder / "capture", "--out", folder / "run", "--iterations", "60"]
    assert main([str(word) for word in words]) == 0
    return folder / "run"


def test_refined_levels_match_the_photos_better(run):
    source = open_source(run)
    root = build_levels(source.scene.gaussians, OPTIONS)
    said = []
    refined, scores = refine_levels(source, root, 80, "cpu", said.append)
    assert len(scores) == len(said) == len(leaves_of(root)[0].levels) >= 3
    assert scores[0].before == scores[0].after
    for score in scores[1:]:
        assert score.after > score.before + 0.2
        assert score.factor == pytest.approx(2 ** (score.level / 2))
    for before, after in zip(leaves_of(root), leaves_of(refined), strict=True):
        assert after.levels[0] is before.levels[0] and after.errors == before.errors
        assert [len(level) for level in after.levels] == [len(level) for level in before.levels]


def test_photos_are_reduced_by_the_factor_of_the_level(run):
    source = open_source(run)
    for factor, width in ((1.0, 64), (2.0, 32)):
        train, test = lod_refinement.photos_of_run(source, lod_refinement.run_of(source.path), factor, "cpu")
        assert {view.camera.W for view in (*train, *test)} == {width} and len(test) == 2
        known = dict(source.cameras)
        for view in train:
            np.testing.assert_array_equal(view.camera.eye, known[view.name].eye)


def test_resolutions_of_reduced_photos():
    reduced = lod_refinement._reduced
    assert reduced(None, 2.0) == 2.0 and reduced(4.0, 2.0) == 8.0 and reduced(None, 100.0) == 31.0
    assert reduced(800.0, 2.0) == 400.0 and reduced(40.0, 2.0) == 32.0


def test_a_scene_without_photos_is_compared_with_its_renders(tmp_path, capsys):
    write_scene(tmp_path / "in.ply", random_scene(120, 3))
    out = tmp_path / "lod" / "lod-meta.json"
    words = ["convert", tmp_path / "in.ply", out, "--lod-smallest", 30, "--lod-refine", 15]
    assert main([str(word) for word in words]) == 0
    said = capsys.readouterr().out
    pattern = r"level (\d), (\d+) splats, against renders of the scene reduced by [\d.]+: ([\d.]+) dB, refined ([\d.]+)"
    found = [tuple(map(float, one)) for one in re.findall(pattern, said)]
    assert [one[:2] for one in found] == [(1, 60), (2, 30)]
    assert all(min(before, after) > 10 for *_, before, after in found)
    assert said.count("so it stays as merged") == sum(after <= before for *_, before, after in found)
    assert codec.read_index(out).counts() == [120, 60, 30]


def test_a_level_that_training_makes_worse_is_not_refined(run, monkeypatch):
    def spoilt(source, gaussians, views, steps, backend):
        return gaussians.map(lambda tensor: tensor + 1.0)

    monkeypatch.setattr(lod_refinement, "retrained", spoilt)
    source = open_source(run)
    root = build_levels(source.scene.gaussians, OPTIONS)
    said = []
    same, scores = refine_levels(source, root, 5, "cpu", said.append)
    assert all(score.after < score.before for score in scores[1:])
    assert all(line.endswith(", so it stays as merged") for line in said[1:])
    for before, after in zip(leaves_of(root), leaves_of(same), strict=True):
        assert all(a is b for a, b in zip(before.levels, after.levels, strict=True))


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--lod-refine", "0"], "at least 1"),
        (["--lod-refine", "5", "--transform", "scale=2"], "after --transform"),
        (["--lod-refine", "5", "--crop=-1,-1,-1,1,1,1"], "after --crop"),
    ],
)
def test_scenes_that_cannot_be_refined_are_refused_in_one_line(tmp_path, capsys, more, says):
    write_scene(tmp_path / "in.ply", random_scene(20, 0))
    assert main(["convert", str(tmp_path / "in.ply"), str(tmp_path / "lod-meta.json"), *more]) == 2
    assert says in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "in.ply"), str(tmp_path / "a.ply"), "--lod-refine"]) == 2
    assert "cannot be refined" in capsys.readouterr().err
