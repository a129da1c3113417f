"""Photos with alpha: the scene stays empty outside of what they cut out, and what does not is seen and removed.

The start points are those of structure from motion: some lie in the white room behind the object, and are white.
"""

import functools

import numpy as np
import pytest
import torch

from gsplat_edu import build_cov3d_batch, quat_to_R_batch, render_gaussians
from gsplat_edu.base.constants import C0, SH_OFFSET
from gsplat_edu.clean.guard import clean
from gsplat_edu.clean.report import report_lines
from gsplat_edu.data import procedural
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.writers import write_blender, write_colmap, write_transforms
from gsplat_edu.doctor.after import examine_run
from gsplat_edu.evaluate.metrics import score_views
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.views import View
from gsplat_edu.survey.residuals import residuals
from gsplat_edu.survey.trained import Trained
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points

WHITE = (1.0, 1.0, 1.0)


def cut_out(width=32, count=16, splats=120, seed=0):
    """Photograph the object, with its alpha; return views, start points and their colours.

    400 white points lie around it.
    """
    rng = np.random.default_rng(seed)
    means, cov3ds, colors, opacities = procedural.egg_splats(rng, splats)
    views = []
    for i in range(count):
        camera = procedural.ring_camera(i, count, width, round(0.75 * width))
        image, transmittance = render_gaussians(camera, means, cov3ds, colors, opacities)
        alpha = np.round(255 * (1 - transmittance)).astype(np.uint8)
        straight = image / np.maximum(1 - transmittance, 1e-6)[..., None]
        pixels = np.round(255 * np.clip(np.where(alpha[..., None] > 0, straight, 1.0), 0, 1)).astype(np.uint8)
        views.append(View(camera, pixels, alpha=alpha, name=f"view_{i:03d}.png"))
    room = rng.normal(size=(400, 3))
    room *= (rng.uniform(1.2, 2.5, len(room)) / np.linalg.norm(room, axis=1))[:, None]
    points = np.concatenate([means + 0.03 * rng.normal(size=means.shape), room])
    return views, points, np.concatenate([np.clip(colors, 0, 1), np.ones_like(room)])


def trainer(capture, iterations=150, strategy="fast", **changes):
    views, points, colors = capture
    changes = {"max_gaussians": 800, "sh_degree": 0, "background": WHITE} | changes
    if strategy == "fast":
        changes |= {"fast_start_factor": 1.0}
    config = recipe(iterations, strategy=strategy, **changes)
    start = from_points(points, colors, config)
    return training(config, Views(views), load_backend("cpu"), Start(start, extent=3.5))


def phantom(gaussians, views):
    """Return the opaque area outside of the cut-outs, as a fraction of theirs, by the NumPy renderer."""
    outside = inside = 0
    tensors = {name: t.detach().double().numpy() for name, t in gaussians.tensors().items()}
    cov3ds = build_cov3d_batch(np.exp(tensors["log_scales"]), quat_to_R_batch(tensors["quats"]))
    colors = np.clip(C0 * tensors["sh0"][:, 0] + SH_OFFSET, 0, None)
    opacities = 1 / (1 + np.exp(-tensors["logit_opacities"]))
    for view in views:
        _, T = render_gaussians(view.camera, tensors["means"], cov3ds, colors, opacities)
        alpha = view.read().alpha
        outside += int(((T < 0.5) & (alpha == 0)).sum())
        inside += int((alpha > 127).sum())
    return outside / inside


@pytest.fixture(scope="module")
def capture():
    return cut_out()


def split(capture):
    views, points, colors = capture
    return ([v for i, v in enumerate(views) if i % 4], points, colors), views[::4]


@pytest.fixture(scope="module")
def haunted(capture):
    """A scene trained over white alone, with what that leaves outside."""
    shown, _ = split(capture)
    run = trainer(shown, alpha_background="fixed")
    run.run()
    return run.gaussians


@pytest.mark.parametrize("strategy", ["fast", "adc", "mcmc"])
def test_no_phantom_grows_in_the_colour_of_the_background(capture, haunted, strategy):
    """Over white alone, a quarter of the object's area and more is opaque white outside of it, in views held out."""
    assert phantom(haunted, split(capture)[1]) > 0.25
    shown, held_out = split(capture)
    run = trainer(shown, strategy=strategy)
    run.run()
    assert phantom(run.gaussians, held_out) < 0.02


def bits(run):
    return b"".join(tensor.detach().numpy().tobytes() for tensor in run.gaussians.tensors().values())


def test_a_resumed_run_draws_the_same_colours(capture, tmp_path):
    whole, half, rest = (trainer(capture, 40) for _ in range(3))
    whole.run()
    half.run(lambda: half.iteration == 23)
    load_checkpoint(save_checkpoint(tmp_path, half, 0.0), rest)
    rest.run()
    assert bits(rest) == bits(whole)
    other = trainer(capture, 40, seed=1)
    other.run()
    assert bits(other) != bits(whole)


def test_opaque_photos_are_trained_over_the_background(capture):
    """Without alpha, the colour behind the scene is that of the settings in every step, and no number is drawn."""
    views, points, colors = capture
    opaque = [View(view.camera, view.read().over(WHITE), name=view.name) for view in views]
    runs = [trainer((opaque, points, colors), 20, alpha_background=name) for name in ("random", "fixed")]
    before = runs[0].state()[1]["backgrounds"]
    for run in runs:
        run.run()
    assert bits(runs[0]) == bits(runs[1])
    assert runs[0].state()[1]["backgrounds"] == before


def test_colours_differ_between_the_places_of_a_batch_and_between_steps(capture):
    """All of them depend on the seed alone, so that processes draw the same."""
    run = trainer(capture, 40, batch=4, strategy="adc")
    colors = []
    for _ in range(2):
        colors += [view.settings.background for view in run.step_views()]
        run.iteration += 4
    assert len(set(colors)) == 8
    assert all(0 <= value <= 1 for color in colors for value in color)
    again = trainer(capture, 40, batch=4, strategy="adc")
    again.iteration = 4
    assert [view.settings.background for view in again.step_views()] == colors[4:]
    (fixed,) = trainer(capture, 40, alpha_background="fixed").step_views()
    assert fixed.settings.background == WHITE


@pytest.mark.parametrize("layout", ["colmap", "transforms", "blender"])
def test_every_layout_keeps_the_alpha_unless_a_background_is_given(capture, tmp_path, layout):
    """Training then draws colours; photos over a given background are opaque, and are trained over that."""
    views, points, colors = capture
    writes = {
        "colmap": lambda: write_colmap(tmp_path, views, points, colors),
        "transforms": lambda: write_transforms(tmp_path, views, points, colors),
        "blender": lambda: write_blender(tmp_path, views[:12], views[12:]),
    }
    writes[layout]()
    drawn = {}
    for background in (None, WHITE):
        dataset = load_dataset(tmp_path, DataSettings(background=background))
        assert all((view.read().alpha is None) == (background is not None) for view in dataset.train)
        run = trainer((dataset.train, points, colors), 10)
        drawn[background] = [view.settings.background for _ in range(3) for view in run.step_views()]
    assert set(drawn[WHITE]) == {WHITE}
    assert WHITE not in drawn[None]
    assert load_dataset(tmp_path).train[0].read().alpha is not None


def expected_score(view, gaussians, background):
    """Return the PSNR over black and white together from its definition, with the NumPy renderer."""
    tensors = {name: t.detach().double().numpy() for name, t in gaussians.tensors().items()}
    cov3ds = build_cov3d_batch(np.exp(tensors["log_scales"]), quat_to_R_batch(tensors["quats"]))
    colors = np.clip(C0 * tensors["sh0"][:, 0] + SH_OFFSET, 0, None)
    opacities = 1 / (1 + np.exp(-tensors["logit_opacities"]))
    photo, errors = view.read(), []
    for behind in (0.0, 1.0):
        image, _ = render_gaussians(
            view.camera,
            tensors["means"],
            cov3ds,
            colors,
            opacities,
            bg=(behind,) * 3,
            extent="exact",
            stop="tile",
        )
        share = photo.alpha[..., None] / 255
        truth = np.round(photo.image * share + 255 * behind * (1 - share)) / 255
        errors.append(np.square(np.clip(image, 0, 1) - truth).mean())
    return -10 * np.log10(np.mean(errors))


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), WHITE, (0.2, 0.7, 0.4)])
def test_scores_are_over_black_and_white(capture, haunted, background):
    """Whatever the scene's background is: the score sees the phantom. The tolerance is float32's."""
    (view, *_), _, _ = capture
    settings = RenderSettings(background=background, sh_degree=0)
    show = functools.partial(render, settings=settings, backend="cpu")
    (score,) = score_views(haunted, [view], show, background)
    assert score.psnr == pytest.approx(expected_score(view, haunted, background), abs=1e-4)
    alone = View(view.camera, view.read().over(WHITE))
    (blind,) = score_views(
        haunted, [alone], functools.partial(render, settings=RenderSettings(background=WHITE)), WHITE
    )
    assert score.psnr < blind.psnr - 6


def test_clean_removes_the_phantom(capture, haunted):
    shown, held_out = split(capture)
    settings = RenderSettings(background=WHITE, sh_degree=0)
    cleaning = clean(haunted, shown[0], held_out, settings)
    left = cleaning.apply(haunted)
    assert phantom(left, held_out) < 0.1 * phantom(haunted, held_out)
    assert cleaning.after > cleaning.before + 3
    assert len(left) > 100
    assert cleaning.outside < 0.03


def test_clean_says_what_it_left_outside_of_the_cut_outs(capture):
    """Held-out photos that cut out nothing: whatever is left of the scene lies outside."""
    shown, held_out = split(capture)
    empty = []
    for view in held_out:
        photo = view.read()
        empty.append(View(view.camera, photo.image, alpha=np.zeros_like(photo.alpha), name=view.name))
    run = trainer(shown, 20)
    run.run()
    cleaning = clean(run.gaussians, shown[0], empty, RenderSettings(background=WHITE, sh_degree=0))
    assert cleaning.outside == 1.0
    assert "100 % of the scene's solid area still lies outside" in report_lines(cleaning)[-1]


def test_the_doctor_names_what_lies_outside_of_the_cut_outs(capture, haunted, tmp_path):
    shown, held_out = split(capture)
    show = functools.partial(
        render, settings=RenderSettings(background=WHITE, depth=True, sh_degree=0), backend="cpu"
    )
    found = residuals(haunted, held_out, show, WHITE)
    for view, residual in zip(held_out, found, strict=True):
        with torch.no_grad():
            solid = show(haunted, view.camera).transmittance.numpy() < 0.5
        clear = np.pad(view.read().alpha == 0, 1, constant_values=True)
        inner = np.lib.stride_tricks.sliding_window_view(clear, (3, 3)).all(axis=(2, 3))
        assert residual.outside == pytest.approx((solid & inner).sum() / solid.sum())
    run = Trained(tmp_path, haunted, 3.0, found, [], 150, 150)
    (finding,) = [finding for finding in examine_run(run).findings if finding.name == "outside cut-outs"]
    assert f"{100 * np.mean([residual.outside for residual in found]):.0f} %" in finding.sentence
    good = trainer(shown)
    good.run()
    fine = Trained(
        tmp_path, good.gaussians, 3.0, residuals(good.gaussians, held_out, show, WHITE), [], 150, 150
    )
    assert "cut-outs" in examine_run(fine).fine
