"""Every projection and shutter: the renderers agree with the NumPy reference.

Those that compute in float64 do up to rounding; test_float32_lenses.py has the others.
"""

import dataclasses

import numpy as np
import pytest

from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.shutter import AT_ONCE, READOUTS
from lens_scenes import CLAMPED, LENSES, LIMIT, around, beyond, lens_camera, lens_truth
from native_scenes import BACKGROUND

SETTINGS = RenderSettings(background=BACKGROUND)
EPS = float(np.finfo(np.float32).eps)


@pytest.mark.parametrize("backend", ["torch", "cpu"])
@pytest.mark.parametrize("name", LENSES)
def test_images_agree_with_the_reference(name, backend):
    scene, camera = around(150), lens_camera(name)
    image, T, depth = lens_truth(scene, camera)
    out = render(scene.gaussians(), camera, settings=SETTINGS, backend=backend)
    assert len(out.visible) > 20
    # The dense renderer has no tile stop: behind a transmittance of 1e-4, it adds at most that much of any colour.
    atol = 2e-3 if backend == "torch" else 1e-10
    np.testing.assert_allclose(out.image.numpy(), image, rtol=0, atol=atol)
    np.testing.assert_allclose(
        out.transmittance.numpy(), T, rtol=0, atol=1e-4 if backend == "torch" else 1e-10
    )
    np.testing.assert_allclose(out.depth.numpy(), depth, rtol=0, atol=atol)


@pytest.mark.parametrize("backend", ["torch", "cpu"])
@pytest.mark.parametrize("name", CLAMPED)
def test_clamped_images_agree_with_the_reference(name, backend):
    scene, camera = around(300), lens_camera(name)
    image, T, depth = lens_truth(scene, camera, LIMIT)
    settings = dataclasses.replace(SETTINGS, jacobian_limit=LIMIT)
    out = render(scene.gaussians(), camera, settings=settings, backend=backend)
    drawn = beyond(scene, camera)[out.visible]
    free = render(scene.gaussians(), camera, settings=SETTINGS, backend=backend)
    if name != "opencv, moving up":
        assert drawn.sum() > 3 and (free.image - out.image).abs().max() > 0.01
    atol = 2e-3 if backend == "torch" else 1e-10  # as above
    np.testing.assert_allclose(out.image.numpy(), image, rtol=0, atol=atol)
    np.testing.assert_allclose(
        out.transmittance.numpy(), T, rtol=0, atol=1e-4 if backend == "torch" else atol
    )
    np.testing.assert_allclose(out.depth.numpy(), depth, rtol=0, atol=atol)


def test_every_kind_and_readout_is_tested():
    kinds = {projection.kind for projection, _ in LENSES.values()}
    readouts = {shutter.readout for _, shutter in LENSES.values() if shutter is not None}
    assert kinds == {"perspective", "fisheye", "equirectangular", "orthographic"}
    assert readouts == {*READOUTS, AT_ONCE}
    assert any(shutter and shutter.exposure for _, shutter in LENSES.values())
