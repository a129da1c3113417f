"""Gaussians from activated quantities, for torch's optimisers, and from a state."""

import pytest
import torch

from gsplat_edu import ArgumentError, Gaussians, ShapeError
from gsplat_edu.base.constants import C0
from gsplat_edu.train.initialize import random_ball


def activated(count=5, dtype=torch.float64, coefficients=None):
    g = torch.Generator().manual_seed(0)
    colors = torch.rand(count, 3, generator=g, dtype=dtype)
    if coefficients is not None:
        colors = torch.randn(count, coefficients, 3, generator=g, dtype=dtype)
    return {
        "means": torch.randn(count, 3, generator=g, dtype=dtype),
        "quats": torch.randn(count, 4, generator=g, dtype=dtype),
        "scales": 0.01 + torch.rand(count, 3, generator=g, dtype=dtype),
        "opacities": 0.01 + 0.98 * torch.rand(count, generator=g, dtype=dtype),
        "colors": colors,
    }


def test_activations_give_the_quantities_back():
    """exp(log x) and sigmoid(logit x) round a few times each: 1e-14 is 45 float64 roundings of values below 1."""
    given = activated()
    made = Gaussians.from_activated(**given)
    for name in ("means", "quats", "scales", "opacities"):
        torch.testing.assert_close(getattr(made, name), given[name], rtol=0, atol=1e-14)
    torch.testing.assert_close(0.5 + C0 * made.sh0[:, 0], given["colors"], rtol=0, atol=1e-14)
    assert made.sh_degree == 0


@pytest.mark.parametrize(("coefficients", "degree"), [(1, 0), (4, 1), (9, 2), (16, 3)])
def test_harmonics_are_taken_as_they_are(coefficients, degree):
    given = activated(coefficients=coefficients)
    made = Gaussians.from_activated(**given)
    assert made.sh_degree == degree and torch.equal(made.sh, given["colors"])


def test_small_and_large_opacities_keep_their_digits():
    given = activated(2) | {"opacities": torch.tensor([1e-12, 1 - 1e-12], dtype=torch.float64)}
    made = Gaussians.from_activated(**given)
    # The opacity 1 - 1e-12 is stored to 1.1e-16, so that 1 - o, and with it the logit, is known to 1.1e-4 of 1e-12.
    torch.testing.assert_close(
        made.logit_opacities[0].exp(), torch.tensor(1e-12, dtype=torch.float64), rtol=1e-11, atol=0
    )
    assert abs(float(made.logit_opacities.sum())) < 2e-4


def test_it_is_differentiable_in_every_argument():
    """Away from the bounds of the ranges the maps are smooth."""
    given = {name: value.requires_grad_() for name, value in activated(2).items()}

    def raw(*values):
        return tuple(Gaussians.from_activated(*values).parameters())

    assert torch.autograd.gradcheck(raw, tuple(given.values()))


@pytest.mark.parametrize(
    ("name", "entry", "value", "wanted"),
    [
        ("means", (1, 2), float("nan"), r"means\[1, 2\]: is NaN or infinite"),
        ("quats", 3, 0.0, r"quats\[3\]: has zero length"),
        ("scales", (2, 1), 0.0, r"scales\[2, 1\]: is 0, but has to be above 0"),
        ("scales", (0, 0), float("inf"), r"scales\[0, 0\]: is NaN or infinite"),
        ("opacities", 4, 1.0, r"opacities\[4\]: is 1, but has to be between 0 and 1"),
        ("opacities", 0, -0.5, r"opacities\[0\]: is -0.5, but has to be between 0 and 1"),
        ("colors", (1, 0), 1.5, r"colors\[1, 0\]: is 1.5, but has to be from 0 to 1"),
    ],
)
def test_entries_out_of_range_are_named(name, entry, value, wanted):
    given = activated()
    given[name][entry] = value
    with pytest.raises(ArgumentError, match=wanted):
        Gaussians.from_activated(**given)


def test_other_kinds_and_shapes_name_the_argument():
    given = activated()
    with pytest.raises(ArgumentError, match="scales: is torch.float32 on cpu, but means are torch.float64"):
        Gaussians.from_activated(**(given | {"scales": given["scales"].float()}))
    with pytest.raises(ShapeError, match="colors: holds 5 coefficients"):
        Gaussians.from_activated(**(given | {"colors": torch.zeros(5, 5, 3).double()}))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"means": [[0.0, 0.0, 0.0]]}, "means: is of type list, but has to be a tensor"),
        ({"opacities": 0.5}, "opacities: is of type float, but has to be a tensor"),
        ({"colors": None}, "colors: is of type NoneType, but has to be a tensor"),
        ({"scales": torch.ones(5, 3).long()}, "scales: is torch.int64, but has to be a float tensor"),
        ({"means": torch.zeros(5, 3).half()}, "means: is float16, which is too coarse"),
        ({"means": torch.zeros(5, 2).double()}, "means: expected shape (N, 3), got (5, 2)"),
        ({"quats": torch.ones(4, 4).double()}, "quats: expected shape (N=5, 4), got (4, 4)"),
        ({"opacities": torch.full((5, 1), 0.5).double()}, "opacities: expected shape (N=5,), got (5, 1)"),
        ({"colors": torch.zeros(5).double()}, "colors: expected shape (N=5, K, 3), got (5,)"),
        ({"quats": torch.zeros(5, 4).double()}, "quats[0]: has zero length"),
        ({"scales": -torch.ones(5, 3).double()}, "scales[0, 0]: is -1, but has to be above 0"),
    ],
    ids=lambda each: next(iter(each)) if isinstance(each, dict) else "",
)
@pytest.mark.usefixtures("as_shipped")
def test_a_wrong_argument_is_one_line_that_starts_with_its_name(wrong, said):
    with pytest.raises(ArgumentError) as caught:
        Gaussians.from_activated(**(activated() | wrong))
    assert str(caught.value).startswith(said) and "\n" not in str(caught.value)


def ball(count=4):
    return random_ball(count, torch.Generator().manual_seed(2))


def test_groups_have_the_tensors_and_rates_that_were_named():
    scene = ball().trainable()
    groups = scene.parameter_groups({"means": 1e-3, "sh0": 1e-2})
    assert [(group["name"], group["lr"]) for group in groups] == [("means", 1e-3), ("sh0", 1e-2)]
    assert groups[0]["params"][0] is scene.means and groups[1]["params"][0] is scene.sh0
    with pytest.raises(ArgumentError, match="rates: 'colour' is not one of means"):
        scene.parameter_groups({"colour": 1.0})


def test_all_parameters_go_to_an_optimiser():
    scene = ball().trainable()
    assert [id(p) for p in torch.optim.SGD(scene.parameters(), lr=1.0).param_groups[0]["params"]] == [
        id(tensor) for tensor in scene.tensors().values()
    ]


def test_a_state_gives_the_gaussians_back(tmp_path):
    scene = ball().trainable()
    torch.save(scene.state_dict(), tmp_path / "scene.pt")
    again = Gaussians.from_state_dict(torch.load(tmp_path / "scene.pt"))
    for name, tensor in scene.tensors().items():
        assert torch.equal(again.tensors()[name], tensor) and not again.tensors()[name].requires_grad
    state = scene.state_dict()
    with pytest.raises(ArgumentError, match="state: 'weights' is unknown"):
        Gaussians.from_state_dict(state | {"weights": state["means"]})
    del state["quats"]
    with pytest.raises(ArgumentError, match="state: 'quats' is missing"):
        Gaussians.from_state_dict(state)


def test_only_like_gaussians_are_joined():
    scene = ball()
    assert torch.equal(Gaussians.concatenated([scene[:1], scene[1:]]).means, scene.means)
    with pytest.raises(ArgumentError, match="parts: is empty"):
        Gaussians.concatenated([])
    richer = Gaussians(**(scene.tensors() | {"sh_rest": torch.zeros(4, 3, 3)}))
    with pytest.raises(ArgumentError, match=r"parts\[1\]: has SH degree 1, but parts\[0\] has 0"):
        Gaussians.concatenated([scene, richer])
    with pytest.raises(ArgumentError, match=r"parts\[1\]: is torch.float64 on cpu, but parts\[0\] is torch"):
        Gaussians.concatenated([scene, scene.map(torch.Tensor.double)])
