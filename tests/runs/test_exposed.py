"""Photos are converted to the exposure of the scene: scaled photos are recovered, masks count, `clean` uses them."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.ops.exposure import falloff
from gsplat_edu.parts.exposure.photos import at_exposure_of_scene
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.runs.cleaning import open_subject
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points
from test_exposure import photographed

pytestmark = pytest.mark.slow


def shows(image):
    """Return a renderer that shows this image, opaque everywhere."""
    seen = torch.from_numpy(image).float()

    def render(gaussians, camera):
        none = torch.zeros(0, dtype=torch.int64)
        return RenderOutput(
            seen, torch.zeros(seen.shape[:2]), None, none, torch.zeros(0, 2), None, lambda: none
        )

    return render


def test_a_photo_is_converted_to_the_exposure_of_the_scene(tmp_path):
    views, points, colors = procedural_capture(24, 4, splats=60)
    camera = views[0].camera
    image = np.random.default_rng(0).uniform(0.15, 0.6, (camera.H, camera.W, 3))
    darker = photographed(image, np.array([0.6, 0.7, 0.8]))
    write_colmap(tmp_path, [View(v.camera, darker, name=v.name) for v in views], points, colors)
    dataset = load_dataset(tmp_path)
    gaussians = from_points(points, colors, recipe(1))
    found = at_exposure_of_scene(dataset, gaussians, shows(image), (0.0, 0.0, 0.0))
    assert len(found.train) == len(dataset.train) and len(found.test) == len(dataset.test)
    # A byte is 1/255, which dividing by the gain enlarges by up to a quarter; the gains are accurate to 1 %.
    np.testing.assert_allclose(found.train[0].read().image, image, atol=0.012)
    assert found.train[0].camera is dataset.train[0].camera


def test_the_vignetting_of_a_photo_is_removed(tmp_path):
    views, points, colors = procedural_capture(24, 4, splats=60)
    camera = views[0].camera
    image = np.random.default_rng(0).uniform(0.2, 0.6, (camera.H, camera.W, 3))
    plane = falloff(torch.tensor(-0.4, dtype=torch.float64), camera.H, camera.W).numpy()[..., None]
    write_colmap(
        tmp_path,
        [View(v.camera, photographed(image, 0.8 * plane**2.4), name=v.name) for v in views],
        points,
        colors,
    )
    dataset = load_dataset(tmp_path)
    gaussians = from_points(points, colors, recipe(1))
    found = at_exposure_of_scene(dataset, gaussians, shows(image), (0.0, 0.0, 0.0), vignetting=True)
    # As above; 144 pixels in a third of the photo measure k to 0.02.
    np.testing.assert_allclose(found.train[0].read().image, image, atol=0.02)


@pytest.mark.parametrize("appearance", ["none", "exposure", "vignetting"])
def test_clean_judges_a_corrected_run_at_its_exposure(tmp_path, appearance, capsys):
    """The photos that judge a run are converted if its training corrected exposures, and only then."""
    views, points, colors = procedural_capture(32, 8, splats=120)
    rng = np.random.default_rng(1)
    scales = 2.0 ** rng.uniform(-0.7, 0.7, (8, 1)) * np.ones(3)
    uneven = [
        View(v.camera, photographed(v.read().image / 255.0, s), name=v.name)
        for v, s in zip(views, scales, strict=True)
    ]
    write_colmap(tmp_path / "capture", uneven, points, colors)
    run = tmp_path / "run"
    words = [
        "train",
        str(tmp_path / "capture"),
        "--out",
        str(run),
        "--iterations",
        "60",
        "--appearance",
        appearance,
    ]
    assert main([*words, "--max-gaussians", "400"]) == 0
    backend, renders = load_backend("cpu"), []

    def counted(*arguments):
        renders.append(arguments)
        return backend.rasterize(*arguments)

    dataset = open_subject(run, None, dataclasses.replace(backend, rasterize=counted)).dataset
    assert len(renders) == (0 if appearance == "none" else len(views)), "the given backend measures exposures"
    photos = [view.read().image for view in dataset.train]
    given = [view.read().image for view in load_dataset(tmp_path / "capture").train]
    same = all(np.array_equal(a, b) for a, b in zip(photos, given, strict=True))
    assert same == (appearance == "none")
    capsys.readouterr()
    assert main(["clean", str(run), "--dry-run"]) == 0
    assert "dry run: no scene was written" in capsys.readouterr().out
