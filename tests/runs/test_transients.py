"""Masks of a run have the same bytes after a kill and a resumption, and their names stay inside the folder."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.parts.transients.files import mask_path, masked_names, write_masks
from gsplat_edu.parts.transients.search import Transients
from gsplat_edu.render.api import render
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.train.config import recipe
from passers_by import pasted


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("struck")
    views, points, colors = procedural_capture(48, 18, splats=200)
    write_colmap(folder, pasted(views)[0], points, colors)
    return folder


def run_of(capture, out, resume=False):
    config = recipe(200, strategy="fast", max_gaussians=1_500, sh_degree=1, transients="mask")
    options = RunOptions(capture, out, config, DataSettings(), save_every=50, resume=resume)
    return CaptureRun(options)


def written(run):
    run.finish()
    masks = {path.name: path.read_bytes() for path in (run.folder.path / "transients").iterdir()}
    return run.folder.latest_scene()[0].read_bytes(), masks


class KilledError(Exception):
    pass


@pytest.mark.slow
def test_a_killed_and_resumed_run_writes_the_same_bytes(capture, tmp_path):
    whole = run_of(capture, tmp_path / "whole")
    whole.train()
    scene, masks = written(whole)

    def kill(trainer, event):
        if trainer.iteration == 83:
            raise KilledError

    killed = run_of(capture, tmp_path / "killed")
    with pytest.raises(KilledError):
        killed.train(callbacks=[kill])
    resumed = run_of(capture, tmp_path / "killed", resume=True)
    assert resumed.trainer.iteration == 50, "the checkpoint has the masks of the 21st and 41st step"
    assert any(mask is not None for mask in resumed.trainer.maskers["transients"].masks)
    resumed.train()
    assert written(resumed) == (scene, masks) and masks


def test_masks_have_the_size_of_the_files_and_old_masks_are_removed(capture, tmp_path):
    dataset = load_dataset(capture)
    found = Transients(dataset.train, 100, render)
    found.masks[2] = np.zeros((36, 48), dtype=bool)
    found.masks[2][:9] = True
    found.too_large[4] = True
    folder = RunFolder(tmp_path / "run")
    old = folder.path / "transients" / "old" / "mask.png"
    old.parent.mkdir(parents=True)
    Image.new("L", (2, 2)).save(old)
    sentence, facts = write_masks(folder.path, dataset, found)
    name = dataset.train[2].name
    assert f"masked in 1 of {len(dataset.train)} photos, most of {name} (25.0 %)" in sentence
    assert (
        f"more than 40 % of each differs: 1 of {len(dataset.train)} photos, first {dataset.train[4].name}"
        in sentence
    )
    assert facts == {"photos": [{"name": name, "share": 0.25}], "left_alone": [dataset.train[4].name]}
    assert masked_names({"transients": facts}) == [name] and not old.exists()
    mask = np.asarray(Image.open(folder.path / "transients" / f"{name}.png"))
    assert mask.shape == (36, 48) and not mask[:9].any() and (mask[9:] == 255).all()


@pytest.mark.parametrize("name", ["../../up.png", "/root/photo.png", "C:\\photo.png"])
def test_names_cannot_leave_the_folder(tmp_path, name):
    folder = RunFolder(tmp_path / "run")
    assert mask_path(folder.path, name).parent == folder.path / "transients"
    assert mask_path(folder.path, "left/a.jpg") == folder.path / "transients" / Path("left/a.jpg.png")


@pytest.mark.parametrize("metrics", [{}, {"transients": 3}, {"transients": {"photos": [1, "a"]}}])
def test_damaged_metrics_name_no_masks(metrics):
    assert masked_names(metrics) == []
