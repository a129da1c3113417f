"""Terms of depth, normals and patches with a sky behind the scene: they see the scene alone.

The scene is a translucent sheet of splats before a shell that fills the image. Every tile stays above the transmittance
at which compositing stops, so that all backends sum the same splats.
"""

import math

import numpy as np
import pytest
import torch

from gsplat_edu import Camera, build_cov3d_batch, load_backend, quat_to_R_batch, render_gaussians
from gsplat_edu.cli.main import main
from gsplat_edu.io.ply import save_ply
from gsplat_edu.parts.given_depth.term import DepthTerm
from gsplat_edu.parts.surface.patches import Neighbourhood, PatchTerm
from gsplat_edu.parts.surface.terms import NormalTerm, Turns
from gsplat_edu.render.api import render
from gsplat_edu.render.planes import depth_features
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.given_depth import GivenDepth
from gsplat_edu.scene.views import View
from gsplat_edu.train.far import Shell, features_before
from gsplat_edu.train.feed import ViewFeed
from gsplat_edu.train.objective import Objective
from gsplat_edu.train.rendered import without_shell
from gsplat_edu.train.step import StepParts, StepView, TensorStepper
from gsplat_edu.train.view_model import Identity
from lens_scenes import LENSES

SHELL = Shell(np.zeros(3), 300.0)
SHEET = 60
"""Number of splats of the sheet; those of the shell come after them."""


def camera(x=0.0):
    return Camera.looking_at((x, 0.2 * x, -3.0), (x, 0.2 * x, 0.0), 40.0, 40.0, H=24, W=32)


def scene(shell=True, opacity=0.1):
    """Return a tilted sheet three units away, and behind it 40 splats of the shell that fill the image."""
    rng = np.random.default_rng(3)
    sheet = rng.uniform((-1, -0.8, 0), (1, 0.8, 0), (SHEET, 3))
    sheet[:, 2] = 0.3 * sheet[:, 0] + 0.02 * rng.normal(size=SHEET)
    sky = np.column_stack([rng.uniform(-90, 90, (40, 2)), np.full(40, 290.0)])
    means = np.concatenate([sheet, sky]) if shell else sheet
    count = len(means)
    scales = np.full((count, 3), (0.3, 0.25, 0.02))
    scales[SHEET:] = (60.0, 60.0, 5.0)
    opacities = np.full(count, opacity)
    opacities[SHEET:] = 0.6
    quats = np.tile((1.0, 0.02, -0.15, 0.0), (count, 1)) + 0.02 * rng.normal(size=(count, 4))
    return Gaussians(
        means=torch.tensor(means),
        quats=torch.tensor(quats),
        log_scales=torch.tensor(np.log(scales)),
        sh0=torch.tensor(np.random.default_rng(4).uniform(-1, 1, (100, 1, 3)))[:count],
        sh_rest=torch.zeros(count, 0, 3, dtype=torch.float64),
        logit_opacities=torch.tensor(np.log(opacities / (1 - opacities))),
    )


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_depth_before_a_shell_is_that_of_the_scene_alone(backend):
    """The NumPy renderer composites depths and ones of the sheet alone. Rounding in float64 is 1e-14."""
    gaussians, one = scene(), camera()
    with torch.no_grad():
        features = features_before(SHELL, gaussians, one, None)
        output = render(
            gaussians, one, features=features, settings=RenderSettings(depth=True), backend=backend
        )
        found = without_shell(output)
    alone = scene(shell=False)
    z = (alone.means.numpy() - one.eye) @ one.R[2]
    channels = np.stack([z, np.ones(SHEET), np.zeros(SHEET)], axis=1)
    cov3ds = build_cov3d_batch(alone.scales.numpy(), quat_to_R_batch(alone.quats.numpy()))
    drawn, _ = render_gaussians(
        one,
        alone.means.numpy(),
        cov3ds,
        channels,
        alone.opacities.numpy(),
        extent="exact",
        stop="tile",
        jacobian_limit=RenderSettings().jacobian_limit,
    )
    assert 0.2 < drawn[..., 1].mean() < 0.95  # translucent: the shell shines through
    np.testing.assert_allclose(found.depth, drawn[..., 0], atol=1e-11)
    np.testing.assert_allclose(found.alpha, drawn[..., 1], atol=1e-12)
    mixed = (output.depth / output.alpha)[output.alpha > 0.5]
    assert mixed.median() > 10 * (found.depth / found.alpha).median()  # as all splats together give it


def stepper(term, gaussians, shell):
    """Return a stepper whose objective is one term."""
    objective = Objective({"photo": lambda rendered: 0.0 * rendered.image.sum(), "tested": term})
    return TensorStepper(gaussians, load_backend("cpu"), {}, StepParts(objective, shell=shell), batch=1)


def views():
    """Return two photos of waves on the sheet's plane, z = 0.3 x, with the depth of a plane three units away."""
    made = []
    v, u = np.mgrid[:24, :32]
    for x in (0.0, 0.4):
        one = camera(x)
        rays = np.stack([(u - one.cx) / one.fx, (v - one.cy) / one.fy], axis=-1).reshape(-1, 2)
        given = GivenDepth(rays, np.full(len(rays), 3.3))
        z = (3.0 + 0.3 * x) / (1.0 - 0.3 * rays[:, 0])
        waves = 0.5 + 0.25 * np.sin(9 * (x + z * rays[:, 0])) + 0.2 * np.sin(7 * (0.2 * x + z * rays[:, 1]))
        photo = np.repeat(np.round(255 * waves).astype(np.uint8).reshape(24, 32, 1), 3, axis=2)
        made.append(View(one, photo).with_depth(lambda given=given: given))
    return made


TURNS = Turns(0)
TERMS = {
    "depth": lambda photos: DepthTerm(1.0, 1.0, 1.0, TURNS),
    "normal": lambda photos: NormalTerm(1.0, TURNS),
    "patches": lambda photos: PatchTerm(1.0, TURNS, Neighbourhood(photos, Identity(), 1.0), 0),
}


@pytest.mark.parametrize("name", TERMS)
def test_a_shell_changes_no_gradient_of_a_term(name):
    """Value and gradients of the scene's splats are those of the scene without a shell; the shell's own are 0."""
    photos, values, gradients = views(), [], []
    draw = ViewFeed(photos, "shuffled", 0).next()
    target = ViewFeed(photos, "shuffled", 0).target(draw, (0.0, 0.0, 0.0))
    for shell in (False, True):
        gaussians = scene(shell, opacity=0.4 if name == "patches" else 0.1)
        run = stepper(TERMS[name](photos), gaussians, SHELL if shell else None)
        terms = run.gradients([StepView(draw, target, RenderSettings())], 0)
        values.append(float(terms["tested"]))
        gradients.append({key: tensor.grad for key, tensor in run.gaussians.tensors().items()})
    assert values[0] > 0
    assert values[1] == pytest.approx(values[0], rel=1e-9)
    alone, before = gradients
    assert alone["means"].abs().max() > 1e-6
    for key in ("means", "quats", "log_scales", "logit_opacities"):
        scale = float(alone[key].abs().max())
        torch.testing.assert_close(before[key][:SHEET], alone[key], rtol=1e-7, atol=1e-9 * scale)
        assert float(before[key][SHEET:].abs().max()) <= 1e-9 * scale


LENS_KINDS = ["opencv", "fisheye", "orthographic", "pinhole, moving", "fisheye, moving"]


@pytest.mark.parametrize("name", LENS_KINDS)
def test_depths_of_means_are_those_that_the_renderer_composites(name):
    """A splat's composited depth divided by its alpha is its depth; gradients are those of finite differences."""
    one = camera().through(*LENSES[name])
    alone = scene(shell=False)
    for index in range(0, SHEET, 12):
        single = alone[index : index + 1]
        drawn = render(single, one, settings=RenderSettings(depth=True), backend="cpu")
        at = drawn.alpha.argmax()
        depth = drawn.depth.flatten()[at] / drawn.alpha.flatten()[at]
        features = depth_features(single, one, torch.ones(1, dtype=torch.bool))
        assert features[0].tolist() == pytest.approx([float(depth), 1.0], rel=1e-9)
    some, counted = alone[:5], torch.tensor([True, True, False, True, True])
    means = some.means.clone().requires_grad_()

    def features_of(moved):
        tensors = some.tensors() | {"means": moved}
        return depth_features(Gaussians(**tensors), one, counted)

    assert torch.autograd.gradcheck(features_of, (means,))
    assert features_of(means)[2].tolist() == [0.0, 0.0]


def test_a_mean_that_is_not_finite_does_not_count():
    gaussians = scene()
    gaussians.means[0, 1] = math.nan
    features = features_before(SHELL, gaussians, camera(), None)
    assert features[0].tolist() == [0.0, 0.0]
    assert torch.isfinite(features).all()


def test_maps_of_a_scene_with_a_sky_show_the_scene(tmp_path):
    """`render --maps depth` beside NumPy's depth of the sheet alone; the image still shows the sky."""
    import cv2

    gaussians = Gaussians(**{name: t.float() for name, t in scene().tensors().items()})
    save_ply(tmp_path / "scene.ply", gaussians)
    words = [
        "render",
        str(tmp_path / "scene.ply"),
        "--out",
        str(tmp_path / "out"),
        "--size",
        "48",
        "--frames",
        "2",
    ]
    assert main([*words, "--maps", "depth,alpha", "--backend", "cpu"]) == 0
    for frame in ("frame_0000", "frame_0001"):
        alpha = cv2.imread(str(tmp_path / "out" / f"{frame}.alpha.tiff"), cv2.IMREAD_UNCHANGED)
        depth = cv2.imread(str(tmp_path / "out" / f"{frame}.depth.tiff"), cv2.IMREAD_UNCHANGED)
        assert (alpha < 0.01).any()
        assert 0 < depth.max() < 30  # the shell is 300 away
    image = cv2.imread(str(tmp_path / "out" / "frame_0000.png"))
    assert (image.max(axis=2) > 20).mean() > 0.9
