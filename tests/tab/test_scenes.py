"""Start points, files, lengths and verdicts of the page, against their Python twins."""

import base64
import itertools

import numpy as np
import pytest
import torch

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.visible_cloud import FARTHEST, LEAST_VIEWS, NEAREST, seen_by
from gsplat_edu.evaluate.verdict import Measured, judged
from gsplat_edu.io.formats import read_scene
from gsplat_edu.io.ply import save_ply
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.rig import point_nearest_axes, scene_extent
from gsplat_edu.train.length import QUALITIES, planned_iterations
from modules_in_node import answer

NAMES = ("means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities")


def test_random_points_lie_where_two_photos_look():
    views, *_ = procedural_capture(24, 6, splats=60)
    cameras = [view.camera for view in views]
    fields = ("fx", "fy", "cx", "cy", "W", "H")
    given = [
        {"R": c.R.ravel().tolist(), "eye": c.eye.tolist(), **{name: getattr(c, name) for name in fields}}
        for c in cameras
    ]
    body = """const twice = [0, 0, 1].map((seed) => randomPoints(given, seed, 500));
    return twice.map(({ points, colors }) => ({ points: [...points], colors: [...colors] }));"""
    first, again, other = answer("points.js", "randomPoints", body, given)
    assert first == again != other
    points, colors = (np.reshape(first[name], (-1, 3)) for name in ("points", "colors"))
    assert len(points) == len(colors) == 500
    assert seen_by(points, cameras, LEAST_VIEWS).all()
    assert 0 <= colors.min() < 0.01 and 0.99 < colors.max() < 1 and abs(colors.mean() - 0.5) < 0.05
    focus = point_nearest_axes(cameras)
    assert focus is not None
    middle = float(np.median([camera.world_to_cam(focus)[2] for camera in cameras]))
    size = max(scene_extent(cameras), middle)
    depths = np.stack([camera.world_to_cam(points)[:, 2] for camera in cameras])
    in_range = (depths > NEAREST * size * (1 - 1e-9)) & (depths < FARTHEST * size * (1 + 1e-9))
    assert in_range.any(axis=0).all() and np.ptp(depths) > size


def test_photos_that_share_nothing_are_refused():
    back = [-1.0, 0, 0, 0, 1, 0, 0, 0, -1]
    sides = {"fx": 20, "fy": 20, "cx": 11.5, "cy": 8.5, "W": 24, "H": 18}
    given = [
        {"R": np.eye(3).ravel().tolist(), "eye": [0, 0, 1], **sides},
        {"R": back, "eye": [0, 0, -1], **sides},
    ]
    body = "try { return randomPoints(given); } catch (error) { return error.message; }"
    assert "No two photos show the same place" in answer("points.js", "randomPoints", body, given)


PLY_BODY = """const Float32 = (values) => Float32Array.from(values);
const gaussians = Object.fromEntries(given.map(([name, values]) => [name, Float32(values)]));
const blob = new Blob(plyOf({ ...gaussians, count: gaussians.logit_opacities.length }));
return Buffer.from(await blob.arrayBuffer()).toString("base64");"""


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 7])
def test_scenes_are_the_bytes_that_python_writes(tmp_path, degree, count):
    generator = torch.Generator().manual_seed(degree)
    rest = (degree + 1) ** 2 - 1
    shapes = [(3,), (4,), (3,), (1, 3), (rest, 3), ()]
    tensors = {
        name: torch.randn((count, *shape), generator=generator)
        for name, shape in zip(NAMES, shapes, strict=True)
    }
    given = [[name, tensor.ravel().tolist()] for name, tensor in tensors.items()]
    written = base64.b64decode(answer("ply.js", "plyOf", PLY_BODY, given))
    (tmp_path / "page.ply").write_bytes(written)
    save_ply(tmp_path / "python.ply", Gaussians(**tensors))
    if count:  # without Gaussians, the page does not know how many harmonics they would have
        assert written == (tmp_path / "python.ply").read_bytes()
    scene = read_scene(tmp_path / "page.ply").gaussians
    for name, tensor in tensors.items():
        if count or name != "sh_rest":
            assert torch.equal(getattr(scene, name), tensor), name


def test_trainings_are_as_long_as_in_python():
    cases = list(itertools.product(QUALITIES, (1, 3, 8, 40, 85, 86, 200, 3000, 90_000), (True, False)))
    body = "return given.map(([quality, views, measured]) => plannedIterations(quality, views, measured));"
    assert answer("length.js", "plannedIterations", body, cases) == [
        planned_iterations(*case) for case in cases
    ]


def test_what_is_left_counts_the_growth():
    """Three quarters of a step's time grow with the Gaussians, whose number grows evenly until 0.6 of the training.

    From 100 to 300 Gaussians, the mean of all steps is 0.6 * 200 + 0.4 * 300 = 240, so a step takes
    1/4 + 3/4 * 2.4 = 2.05 times as long as the first; after half of the training, with 200 of them, it is
    0.2 * 250 + 0.8 * 300 = 290, 1/4 + 3/4 * 1.45; after 0.6, all steps are alike.
    """
    cases = [(100, 100, 100), (100, 100, 300), (50, 200, 300), (40, 300, 300), (40, 300, 400), (0, 300, 300)]
    given = [
        {"steps": steps, "iterations": 100, "perStep": 2, "count": count, "planned": planned}
        for steps, count, planned in cases
    ]
    found = answer("length.js", "secondsLeft", "return given.map(secondsLeft);", given)
    np.testing.assert_allclose(found, [200, 410, 100 * (0.25 + 0.75 * 1.45), 80, 80, 0], rtol=1e-12)


def test_verdicts_are_those_of_python():
    scores, photos = (12.0, 17.99, 18.0, 23.9, 24.0, 25.0, 29.9, 30.0, 34.0), (1, 14, 29, 30, 200)
    cases = [
        {"test": test, "train": train, "photos": count, "worst": worst}
        for test in (None, *scores)
        for train in scores
        for count in photos
        for worst in (None, "a.jpg")
    ]
    found = answer("verdict.js", "judged", "return given.map(judged);", cases)
    for case, mine in zip(cases, found, strict=True):
        worst = None if case["worst"] is None else (case["worst"], 12.0)
        wanted = judged(Measured(case["test"], case["train"], photos=case["photos"], worst=worst))
        assert (mine["grade"], mine["sentence"]) == (wanted.grade, wanted.sentence), case
