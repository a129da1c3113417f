"""`skipping_bad_gaussians` leaves out bad rows with zero gradients; the others have the bits they have alone."""

import pytest
import torch

from gsplat_calls import arguments
from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.compat.gsplat import rasterization, skipping_bad_gaussians

BAD = {
    "means": float("nan"),
    "quats": 0.0,
    "scales": float("inf"),
    "opacities": float("nan"),
    "colors": float("-inf"),
}


@pytest.mark.parametrize("per_camera", [False, True])
@pytest.mark.parametrize("name", BAD)
def test_a_bad_row_is_left_out(name, per_camera):
    given = arguments()
    if per_camera:
        given["colors"] = given["colors"].expand(2, 6, 3).clone()
    keep = torch.tensor([0, 1, 2, 4, 5])
    rows = {"means": 0, "quats": 0, "scales": 0, "opacities": 0, "colors": int(per_camera)}
    alone = given | {key: given[key].index_select(axis, keep) for key, axis in rows.items()}
    given[name] = given[name].clone()
    (given[name][:, 3] if name == "colors" and per_camera else given[name])[
        ... if name == "colors" and per_camera else 3
    ] = BAD[name]
    with pytest.raises(ArgumentError, match=rf"^{name}\["):
        rasterization(**given)
    for each in (given, alone):
        for key in rows:
            each[key] = each[key].detach().requires_grad_()
    with skipping_bad_gaussians():
        image, alpha, _ = rasterization(**given)
    wanted, wanted_alpha, _ = rasterization(**alone)
    assert torch.equal(image, wanted) and torch.equal(alpha, wanted_alpha)
    for out in (image, wanted):
        (out.square().sum()).backward()
    for key, axis in rows.items():
        gradient = given[key].grad
        assert float(gradient.index_select(axis, torch.tensor([3])).abs().sum()) == 0
        assert torch.equal(gradient.index_select(axis, keep), alone[key].grad)
    with pytest.raises(ArgumentError, match=rf"^{name}\["):  # as before, outside the block
        rasterization(**given)


def test_other_mistakes_stay_errors():
    given = arguments(scales=torch.ones(7, 3))
    given["means"][2] = float("nan")
    with skipping_bad_gaussians(), pytest.raises((ShapeError, ArgumentError)):
        rasterization(**given)
    with skipping_bad_gaussians(), pytest.raises(ArgumentError, match=r"^viewmats\["):
        rasterization(**arguments(viewmats=torch.full((2, 4, 4), float("nan"))))
