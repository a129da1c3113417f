"""Pixels that masks exclude are not drawn where nothing reads them, and a training ends with the same bits."""

import numpy as np
import pytest
import torch

from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.scene.views import View
from gsplat_edu.train import step
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.objective import Objective, PhotoTerm, make_objective
from gsplat_edu.train.rendered import NOTHING, Needs
from gsplat_edu.train.view_model import Chain, Identity
from masked_object import masked_object

SIDE = 48


def views_with_masks():
    """Return views of which a third counts in two of three, and all in the others."""
    views, points, colors = masked_object(SIDE, 9, splats=80)
    found = []
    for i, view in enumerate(views):
        mask = np.ones((view.camera.H, view.camera.W), dtype=bool)
        if i % 3:
            mask[:, SIDE // 3 :] = False
        found.append(View(view.camera, view.image, mask=mask, name=view.name))
    return found, points, colors


def trained(monkeypatch, draws_all, **settings):
    """Train for 60 iterations; return the parameters, and the number of pairs of all renders."""
    pairs = []

    def counted(gaussians, camera, needed=None, **rest):
        out = render(gaussians, camera, needed=None if draws_all else needed, **rest)
        pairs.append((out.num_pairs, needed is None))
        return out

    monkeypatch.setattr(step, "render", counted)
    views, points, colors = views_with_masks()
    given = {"max_gaussians": 300, "sh_degree": 1, "fast_start_factor": 1.0} | settings
    config = recipe(60, strategy="fast", **given)
    start = from_points(points, colors, config)
    run = training(config, Views(views), load_backend("cpu"), Start(start, extent=3.5))
    run.run()
    return run.gaussians.tensors(), pairs


@pytest.mark.parametrize("settings", [{}, {"appearance": "exposure"}, {"batch": 2}])
def test_a_training_has_the_same_bits_and_draws_less(monkeypatch, settings):
    whole, all_pairs = trained(monkeypatch, True, **settings)
    part, fewer = trained(monkeypatch, False, **settings)
    for name, values in whole.items():
        assert torch.equal(part[name], values), name
    assert not any(drawn_whole for _, drawn_whole in fewer)
    assert sum(n for n, _ in fewer) < 0.9 * sum(n for n, _ in all_pairs)


@pytest.mark.parametrize(
    "settings", [{"refine": "poses"}, {"outside_masks": "empty"}, {"surface": True, "patch_weight": 0.0}]
)
def test_everything_is_drawn_where_other_pixels_are_used(monkeypatch, settings):
    _, pairs = trained(monkeypatch, False, **settings)
    assert all(drawn_whole for _, drawn_whole in pairs)


def test_own_terms_and_models_are_drawn_whole_unless_they_say_so():
    class Own(Identity):
        pass

    class OwnObjective(Objective):
        pass

    terms = {"photo": PhotoTerm(0.2)}
    assert Identity().needs == Chain([Identity()]).needs == NOTHING
    assert Own().needs == Chain([Identity(), Own()]).needs == Needs(every_pixel=True)
    assert Objective(terms).needs(0) == make_objective(recipe(10, strategy="mcmc")).needs(0) == NOTHING
    own = (OwnObjective(terms), Objective(terms | {"mine": lambda rendered: rendered.image.sum()}))
    assert all(objective.needs(0) == Needs(every_pixel=True) for objective in own)
