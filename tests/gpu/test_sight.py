"""The kernels of sight, in float64, agree with `gsplat_edu.scene.sight` and its derivatives by torch up to rounding."""

import numpy as np
import pytest
import torch

from gsplat_edu import Camera
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.cuda.lens import seen_through
from gsplat_edu.render.torch.sight import seen_by
from lens_scenes import CLAMPED, LENSES, LIMIT, STEPS, around, beyond, lens_camera

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # the interpreter computes with NumPy

NAMES = ("R", "eye", "intrinsics", "coefficients", "motion")


def near_the_axis(camera, means):
    """Return which means a moving perspective camera sees at a tangent of 1.5 at most; any, of other cameras."""
    points = camera.world_to_cam(means)
    near = np.hypot(points[:, 0], points[:, 1]) < 1.5 * points[:, 2]
    return near | (camera.projection.kind != "perspective") | (camera.shutter is None)


def with_gradients(camera, means, see):
    """Return the numbers of what is seen, and the gradients of their randomly weighted sum."""
    means = means.clone().requires_grad_()
    tensors = CameraTensors.of(camera)
    for tensor in tensors.tensors():
        tensor.requires_grad_()
    numbers = see(means, tensors)
    weights = torch.randn(numbers.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (numbers * weights.to(numbers)).sum().backward()
    found = {name: getattr(tensors, name).grad for name in NAMES if getattr(tensors, name) is not None}
    if "coefficients" in found:
        found["coefficients"] = found["coefficients"] * STEPS
    return numbers.detach().cpu(), found | {"means": means.grad.cpu().double()}


@pytest.mark.parametrize(
    ("name", "limit"), [*((name, None) for name in LENSES), *((name, LIMIT) for name in CLAMPED)]
)
def test_values_and_gradients(device, name, limit, monkeypatch):
    camera = lens_camera(name)
    means = torch.tensor(around(150).means, dtype=torch.float32).to(torch.device(device))
    if limit is not None:  # bounds within the image, and constant, whatever the lens
        inner = tuple((0.4 * low, 0.4 * high) for low, high in camera.jacobian_bounds(limit))
        monkeypatch.setattr(Camera, "jacobian_bounds", lambda camera, limit: inner)
        assert beyond(around(150), camera).sum() > 5
    with torch.no_grad():
        valid = seen_by(means.double(), camera, 0.2, limit).valid
    everything = seen_through(means, camera, 0.2, torch.float64, limit)
    assert torch.equal(everything[:, 12] > 0, valid) and valid.sum() > 20
    assert (everything[~valid] == 0).all()

    def exact(means, camera):
        found = seen_by(means.double(), camera, 0.2, limit)
        rows = (found.u, found.v, *found.jacobian[0], *found.jacobian[1], found.depth, *found.direction)
        rows += found.blur or ()
        return torch.stack([row.expand(len(means)) for row in rows], dim=1)

    # Gradients are those of the row that is found; far beside the image, three steps of Newton's method leave some
    # hundredths of a px, and the two derivatives take them differently.
    steady = valid & torch.tensor(near_the_axis(camera, means.cpu().double().numpy())).to(valid.device)
    assert steady.sum() > 20
    columns = [*range(12), *((14, 15) if camera.exposure else ())]
    truth, expected = with_gradients(camera, means[steady], exact)
    ours, found = with_gradients(
        camera,
        means[steady],
        lambda means, camera: seen_through(means, camera, 0.2, torch.float64, limit)[:, columns],
    )
    np.testing.assert_allclose(ours, truth, rtol=1e-11, atol=1e-11 * float(truth.abs().max()))
    assert found.keys() == expected.keys()
    for key, gradient in expected.items():
        # Those of the means are rounded to the means' float32; those of a shutter have the error of Newton's method.
        bound = 1e-6 if key == "means" else 1e-8 if camera.shutter else 1e-10
        assert (found[key] - gradient).abs().max() <= bound * gradient.abs().max() > 0, key
