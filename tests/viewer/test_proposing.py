"""Splats that the editor's server proposes to delete: by photos, by shape, in a process that can be stopped."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from gsplat_edu.clean.shape import Shape, judge_shape
from gsplat_edu.edits.runs import mask_of
from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.runs.floaters import UNSEEN, propose
from gsplat_edu.runs.source import open_source
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer.proposing import MODULE, Proposing
from waiting import PATIENCE, until


def cloud(n=400, infinite=torch.inf):
    """A ball of small splats, then one of each unusual kind: invisible, infinite, large, alone, large but far away."""
    rng = np.random.default_rng(0)
    means = torch.from_numpy(rng.uniform(-1, 1, (n + 5, 3))).float()
    sizes, logits = torch.full((n + 5,), 0.05), torch.full((n + 5,), 2.0)
    logits[n], means[n + 1, 0], sizes[n + 2] = -8.0, infinite, 2.0
    means[n + 3] = torch.tensor([40.0, 0.0, 0.0])
    means[n + 4], sizes[n + 4] = torch.tensor([0.0, 40.0, 0.0]), 0.7
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n + 5, 1)
    scales = sizes.log()[:, None].repeat(1, 3)
    return Gaussians(means, quats, scales, torch.zeros(n + 5, 1, 3), torch.zeros(n + 5, 0, 3), logits)


def written(folder, n=400):
    """Write the ball as a file, whose numbers have to be finite."""
    found = cloud(n, infinite=0.0)
    found.logit_opacities[n + 1] = -9.0
    write_scene(folder / "cloud.ply", Scene(found))


def test_unusual_shapes_are_named():
    found = judge_shape(cloud())
    assert found[-5:].tolist() == [Shape.INVISIBLE, Shape.INVISIBLE, Shape.LARGE, Shape.ALONE, Shape.ALONE]
    assert not found[:-5].any()
    wide = cloud()
    wide.log_scales[-1] = np.log(
        14.0
    )  # its neighbours are within three of its sizes, but it is as wide as the scene
    assert judge_shape(wide)[-1] == Shape.LARGE
    for count in (0, 1, 5):
        few = wide.map(lambda tensor: tensor[:count])  # noqa: B023
        assert judge_shape(few).shape == (count,)


def test_a_clump_floats_unless_each_of_its_splats_has_eight_others_near():
    clump = torch.tensor([-40.0, 0.0, 0.0])
    for count in (8, 9):
        scene = cloud()
        scene.means[:count] = clump + 0.01 * torch.arange(count)[:, None]
        assert (judge_shape(scene)[:count] == Shape.ALONE).all() == (count == 8)


def test_a_scene_file_is_judged_by_shape_and_says_so(tmp_path):
    written(tmp_path)
    found = propose(tmp_path / "cloud.ply")
    assert (
        found["basis"].startswith("Judged by shape alone, without photos: ") and "cloud.ply" in found["basis"]
    )
    groups = {group["reason"].split(":")[0]: group["runs"] for group in found["groups"]}
    assert groups == {"never drawn": [400, 2], "too large": [402, 1], "floating": [403, 2]}


def ended(proposing):
    """Wait until a judgement has ended; return all states on the way."""
    states = []

    def is_over():
        states.append(proposing.state())
        return states[-1]["state"] != "running"

    until(is_over, "the end of the judgement")
    return states


@pytest.mark.slow
def test_a_judgement_runs_in_a_process_and_can_be_repeated(tmp_path):
    written(tmp_path)
    proposing = Proposing(tmp_path / "cloud.ply")
    assert proposing.state() == {"state": "idle"}
    for _ in range(2):
        proposing.start()
        proposing.start()  # joins the one that runs
        last = ended(proposing)[-1]
        assert last["state"] == "done" and len(last["groups"]) == 3
    proposing.stop()
    assert proposing.state() == {"state": "idle"}


@pytest.mark.slow
def test_a_scene_that_cannot_be_read_is_one_line(tmp_path):
    (tmp_path / "odd.ply").write_bytes(b"ply\n")
    proposing = Proposing(tmp_path / "odd.ply")
    proposing.start()
    last = ended(proposing)[-1]
    assert last["state"] == "failed" and "odd.ply" in last["error"] and "\n" not in last["error"]


@pytest.mark.slow
def test_a_judgement_is_stopped_at_once(tmp_path, monkeypatch):
    """The first one would never end by itself."""
    written(tmp_path)
    (tmp_path / "endless.py").write_text("import threading\nthreading.Event().wait()\n")
    proposing = Proposing(tmp_path / "cloud.ply")
    with monkeypatch.context() as patch:
        patch.setattr("gsplat_edu.viewer.proposing.MODULE", "endless")
        patch.setenv("PYTHONPATH", str(tmp_path))
        proposing.start()
    process = proposing.process
    proposing.stop()
    assert proposing.state() == {"state": "idle"}
    assert process.wait(PATIENCE) < 0
    proposing.start()  # a stopped one can start again, and the old process does not change its state
    assert ended(proposing)[-1]["state"] == "done"


@pytest.mark.slow
def test_the_process_ends_with_its_parent(tmp_path):
    written(tmp_path, 40_000)
    command = [sys.executable, "-m", MODULE, str(tmp_path / "cloud.ply")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdin.close()
        assert process.wait(PATIENCE) in (0, 1)


@pytest.fixture(scope="module")
def run_with_floater(tmp_path_factory):
    """A run on a procedural capture, whose scene has a splat before all cameras and one that none sees."""
    import dataclasses

    from gsplat_edu.data.procedural import procedural_capture
    from gsplat_edu.io.ply import save_ply
    from gsplat_edu.render.settings import RenderSettings
    from gsplat_edu.runs.folder import RunFolder
    from splats import splats_on

    views, points, colors = procedural_capture(size=48, count=8)
    gaussians = splats_on(points, colors)
    behind = gaussians.map(lambda tensor: tensor[:1].clone())
    behind.means[:] = torch.tensor([0.0, 500.0, 0.0])
    joined = Gaussians(
        **{name: torch.cat([a, behind.tensors()[name]]) for name, a in gaussians.tensors().items()}
    )
    folder = RunFolder(tmp_path_factory.mktemp("run") / "egg")
    settings = RenderSettings(antialiased=True, jacobian_limit=1.3)
    folder.write_config({"render": dataclasses.asdict(settings), "origin": [0, 0, 0], "data": {}})
    save_ply(folder.scene(30), joined)
    folder.write_cameras(views[:6], views[6:])
    return folder


def test_a_run_without_its_photos_is_judged_by_what_its_cameras_see(run_with_floater):
    steps = []
    found = propose(run_with_floater.path, lambda done, total: steps.append((done, total)))
    assert found["basis"].startswith("Judged by shape alone, without photos: ")
    count = len(open_source(run_with_floater.path).scene.gaussians)
    by = {group["reason"]: mask_of(tuple(group["runs"]), count) for group in found["groups"]}
    hidden = [mask for reason, mask in by.items() if reason == UNSEEN.format(8) or "floating" in reason]
    assert np.any(hidden, axis=0)[-1]
    assert steps == [(k, 8) for k in range(1, 9)]
    assert json.dumps(found)
