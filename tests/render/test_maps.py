"""Alpha, depths and normals equal the reference's; tests/native/test_map_gradients.py checks their gradients."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu import ArgumentError, build_cov3d_batch, quat_to_R_batch, render_gaussians
from gsplat_edu.render.api import render
from gsplat_edu.render.maps import render_maps
from gsplat_edu.render.planes import facing_normals
from gsplat_edu.render.settings import MAPS, RenderSettings
from native_scenes import SCENES, random, smooth_scene

BACKENDS = ("cpu", "torch")


def arrays(maps):
    return {name: tensor.detach().numpy() for name, tensor in maps.items()}


def splats(scene):
    """Return the reference's weights (N, H, W), near to far, and the depths in that order."""
    covs = build_cov3d_batch(np.exp(scene.log_scales), quat_to_R_batch(scene.quats))
    opacities, depths = 1 / (1 + np.exp(-scene.logits)), scene.camera.world_to_cam(scene.means)[:, 2]
    order = np.argsort(depths, kind="stable")
    order = order[depths[order] > 0.05]
    eye, found = np.eye(len(depths)), []
    for i in order:
        white = np.repeat(eye[i][:, None], 3, axis=1)
        drawn = render_gaussians(
            scene.camera, scene.means, covs, white, opacities, extent="exact", stop="tile"
        )
        found.append(drawn[0][..., 0])
    return np.stack(found), depths[order]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["random", "17 x 33", "partly behind"])
def test_depths_and_alpha_are_those_of_the_reference(name, backend):
    scene = SCENES[name]
    maps, view = render_maps(scene.gaussians(), scene.camera, MAPS, backend=backend)
    found = arrays(maps)
    weights, depths = splats(scene)
    left = 1 - np.cumsum(weights, axis=0)
    alpha, expected = weights.sum(axis=0), np.einsum("nyx,n->yx", weights, depths)
    bound = {"rtol": 0, "atol": 1e-9}
    np.testing.assert_allclose(found["alpha"], alpha, **bound)
    np.testing.assert_allclose(found["expected-depth"], expected, **bound)
    safe = np.where(alpha > 0, alpha, 1)
    # The quotient by alpha loses digits where alpha is near 1/255, so the bound is relative to alpha.
    np.testing.assert_allclose(found["depth"], np.where(alpha > 0, expected / safe, 0), rtol=0, atol=1e-6)
    crossed = (left < 0.5).any(axis=0)
    median = np.where(crossed, depths[(left < 0.5).argmax(axis=0)], 0.0)
    decided = np.abs(left - 0.5).min(axis=0) > 1e-9
    assert decided.mean() > 0.99 and crossed.mean() > 0.005
    np.testing.assert_allclose(found["median-depth"][decided], median[decided], **bound)
    assert torch.equal(view.alpha, maps["alpha"]) and view.median_depth is maps["median-depth"]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_wall_has_its_depth_and_its_normal(backend):
    """A camera on the z axis looks at flat Gaussians in the plane z = 0, from either side."""
    rng = np.random.default_rng(0)
    base = random(60, (33, 25))
    wall = dataclasses.replace(
        base,
        means=np.concatenate([rng.uniform(-0.8, 0.8, (60, 2)), np.zeros((60, 1))], axis=1),
        quats=np.stack([rng.normal(size=60), *np.zeros((2, 60)), rng.normal(size=60)], axis=1),
        log_scales=np.tile(np.log([0.3, 0.2, 1e-4]), (60, 1)),
        logits=np.full(60, 2.0),
        camera=dataclasses.replace(base.camera, R=np.eye(3), eye=np.array([0.0, 0.0, -3.0])),
    )
    behind = dataclasses.replace(wall.camera, R=np.diag([-1.0, 1.0, -1.0]), eye=np.array([0.0, 0.0, 3.0]))
    for camera, toward in ((wall.camera, -1.0), (behind, 1.0)):
        maps, _ = render_maps(wall.gaussians(), camera, MAPS, backend=backend)
        solid = maps["alpha"].numpy() > 0.5
        assert solid.mean() > 0.5
        for name in ("depth", "median-depth"):
            np.testing.assert_allclose(maps[name].numpy()[solid], 3.0, rtol=0, atol=1e-12)
        normals = maps["normal"].numpy()
        np.testing.assert_allclose(
            normals[solid], np.array([0.0, 0.0, toward]) * np.ones((solid.sum(), 1)), atol=1e-12
        )
        assert not normals[maps["alpha"].numpy() == 0].any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_median_depth_has_no_gradient_and_empty_pixels_have_finite_ones(backend):
    scene = SCENES["random"]
    gaussians = scene.gaussians().trainable()
    maps, _ = render_maps(gaussians, scene.camera, MAPS, backend=backend)
    assert not maps["median-depth"].requires_grad and (maps["alpha"] == 0).any()
    (maps["depth"].sum() + maps["normal"].sum()).backward()
    assert all(tensor.grad.isfinite().all() for tensor in gaussians.tensors().values())


def test_undefined_rotations_have_no_normal():
    scene = smooth_scene(1)
    scene.quats[2] = 0
    normals = facing_normals(scene.gaussians(), scene.camera)
    assert not normals[2].any()
    lengths = normals.norm(dim=1)
    assert torch.allclose(lengths, torch.tensor([1.0, 1, 0, 1, 1], dtype=torch.float64))
    assert (
        render_maps(scene.gaussians(), scene.camera, ["normal"], backend="cpu")[0]["normal"].isfinite().all()
    )


def test_wrong_names_and_missing_depths_are_named():
    scene = smooth_scene(0)
    with pytest.raises(ArgumentError, match="does not know 'height'; use alpha, depth"):
        render_maps(scene.gaussians(), scene.camera, ["depth", "height"])
    view = render(scene.gaussians(), scene.camera, settings=RenderSettings(depth=False), backend="cpu")
    with pytest.raises(ArgumentError, match="depth: was not rendered"):
        _ = view.mean_depth
