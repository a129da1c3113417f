"""Runs in blocks of photos that keep their lens: fisheyes, panoramas, and photos with a rolling shutter."""

import json
import shutil

import pytest
import torch

from block_runs import RECIPE
from gsplat_edu.blocks.plan import BlockPlan
from gsplat_edu.cli.main import main
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.io.ply import load_ply
from gsplat_edu.runs.blocks_folder import BlocksFolder
from gsplat_edu.runs.dataset import run_dataset
from gsplat_edu.scene.projection import Projection
from lab.captures.lens_captures import lens_capture
from lens_captures import FISHEYE, write_room

pytestmark = pytest.mark.slow

KINDS = ["fisheye", "panorama", "shutter"]
LENSES = {"fisheye": FISHEYE, "panorama": Projection("equirectangular")}
WORDS = ["--blocks", "2", "--lens", "native", *RECIPE, "--min-views", "6"]


def write(folder, kind):
    """Write a capture of 24 photos."""
    if kind == "shutter":
        made = lens_capture("shutter_20", "solids", 48, 24, 600)
        write_transforms(folder, made.views, made.points, made.colors)
    else:
        write_room(folder, LENSES[kind], 24, 32)
    return folder


def scene(folder):
    return folder / "point_cloud" / "iteration_40" / "point_cloud.ply"


@pytest.fixture(scope="module", params=KINDS)
def split(request, tmp_path_factory):
    """A capture, and a run of it that is split."""
    folder = tmp_path_factory.mktemp(request.param)
    data = write(folder / "data", request.param)
    assert main(["train", str(data), "--out", str(folder / "run"), *WORDS, "--until", "split"]) == 0
    return request.param, data, folder / "run"


def test_blocks_have_the_same_bytes_for_any_threads_and_caps_hold(split, tmp_path):
    """Each block has its cap, the merged scene that of the whole, and held-out views are scored through the lens."""
    kind, _, run = split
    plan, before, found = BlockPlan.read(run), torch.get_num_threads(), []
    assert len(plan.blocks) == 2 and plan.recipe["data"]["lens"] == "native"
    try:
        for threads in (1, 2, 5):
            here = tmp_path / str(threads)
            shutil.copytree(run, here)
            torch.set_num_threads(threads)
            assert all(main(["block", str(here), str(number)]) == 0 for number in (1, 0))
            assert main(["merge", str(here)]) == 0
            found.append(scene(here).read_bytes())
    finally:
        torch.set_num_threads(before)
    assert found[0] == found[1] == found[2]
    for number, block in enumerate(plan.blocks):
        assert BlocksFolder(here).read_done(number, plan.digest()).gaussians <= block.max_gaussians
    assert 0 < len(load_ply(scene(here)).means) <= 3_000
    assert json.loads((here / "metrics.json").read_text())["test"]["psnr"] > 12
    dataset = run_dataset(json.loads((here / "config.json").read_text()))
    views = [*dataset.train, *dataset.test]
    assert len(views) == 24 and not any(view.camera.pinhole for view in views)
    assert (views[0].camera.shutter is not None) == (kind == "shutter")


def test_a_block_starts_from_what_its_lenses_show(split):
    """Each Gaussian of the coarse model is in a start, and those are left out that no pixel of the cell shows."""
    _, _, run = split
    coarse = next((run / "coarse" / "point_cloud").rglob("*.ply"))
    counts = [len(load_ply(BlocksFolder(run).start(number)).means) for number in (0, 1)]
    whole = len(load_ply(coarse).means)
    assert all(0 < count < whole for count in counts) and sum(counts) >= whole
