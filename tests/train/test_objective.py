"""The replaceable parts of a step: named terms, view models, and the reduction of gradients over views."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from gains import Gains
from gsplat_edu import ArgumentError
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.evaluate.figures import run_curve_figures
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.log import LogWriter
from gsplat_edu.scene.views import View
from gsplat_edu.train import Start, Views, training
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.objective import Objective, PhotoTerm, Rendered, joined_terms, make_objective
from gsplat_edu.train.rendered import Needs
from gsplat_edu.train.step import mean_over_views

CONFIG = recipe(40, densify_start=2, densify_every=5, grad_threshold=5e-5, sh_degree=0)
MCMC = recipe(20, strategy="mcmc", max_gaussians=60, sh_degree=0)


@pytest.fixture(scope="module")
def capture():
    return procedural_capture(24, 4, splats=60)


def trainer(capture, config, parts=None, callbacks=(), views=None):
    start = from_points(*capture[1:], config)
    started = Start(start, extent=2.0)
    return training(
        config,
        Views(views or capture[0]),
        load_backend("cpu"),
        started,
        callbacks=callbacks,
        **(parts or {}),
    )


def grads(run):
    return {name: tensor.grad.clone() for name, tensor in run.stepper.parameters().items() if tensor.numel()}


def test_regularisers_match_the_paper(capture):
    """Values and gradients equal those of autograd of weight mean(opacity) + weight mean(scale)."""
    run, seen = trainer(capture, MCMC), []
    run.stepper.parts.objective.terms["seen"] = lambda rendered: seen.append(rendered) or torch.zeros(())
    run.stepper.gradients(list(run.step_views()), 0)
    (rendered,) = seen
    assert isinstance(rendered, Rendered) and rendered.iteration == 0
    with_all = grads(run)
    values = {name: term(rendered) for name, term in make_objective(MCMC).terms.items() if name != "photo"}
    twin = run.gaussians.trainable()
    expected = {"opacity": 0.01 * twin.opacities.mean(), "scale": 0.01 * twin.scales.mean()}
    torch.testing.assert_close(values, expected)
    for tensor in run.stepper.parameters().values():
        tensor.grad = None
    Objective({"photo": PhotoTerm(MCMC.ssim_weight)}).backward(
        Rendered(run.gaussians, rendered.draw, *_rendered_again(run, rendered), rendered.target, 0)
    )
    sum(expected.values()).backward()
    for name in ("logit_opacities", "log_scales"):
        without = run.stepper.parameters()[name].grad
        torch.testing.assert_close(with_all[name], without + getattr(twin, name).grad)
    assert torch.equal(with_all["means"], run.gaussians.means.grad)


def test_a_term_of_a_part_replaces_no_other():
    """Neither ours nor another part's."""
    mean, other = (lambda rendered: rendered.image.mean()), (lambda rendered: rendered.image.max())
    assert set(joined_terms({"mean": mean}, {"other": other})) == {"mean", "other"}
    with pytest.raises(ArgumentError, match="^terms: two are named 'mean'"):
        joined_terms({"mean": mean}, {"mean": other})
    for taken in ("photo", "opacity", "scale"):
        with pytest.raises(ArgumentError, match=f"^terms: two are named '{taken}'"):
            make_objective(MCMC, others={taken: mean})


def test_fast_regularises_the_opacity_of_visible_gaussians_if_they_are_few(capture):
    """Value and gradient equal those of autograd of the mean over the visible ones. Four fifths of the Gaussians are
    in no view and get no gradient, so Adam does not move them. A tiny but constant gradient would move them by the
    full rate in each step, in 60 steps at 0.1 from an opacity of 0.1 to below 0.001.
    """
    views, points, colors = capture
    more = np.concatenate([points, *(points + np.array([0.0, 100.0 + 10 * k, 0.0]) for k in range(4))])
    config = recipe(60, strategy="fast", max_gaussians=5 * len(points), sh_degree=0)
    run, seen = trainer((views, more, np.concatenate([colors] * 5)), config), []
    run.stepper.parts.objective.terms["seen"] = lambda rendered: seen.append(rendered) or torch.zeros(())
    run.stepper.gradients(list(run.step_views()), 0)
    (rendered,) = seen
    term, twin = make_objective(config).terms["opacity"], run.gaussians.trainable()
    run.gaussians.logit_opacities.grad = None
    value, expected = term(rendered), 0.002 * twin.opacities[rendered.output.visible].mean()
    assert 0 < len(rendered.output.visible) <= len(points)
    torch.testing.assert_close(value, expected)
    value.backward()
    expected.backward()
    torch.testing.assert_close(run.gaussians.logit_opacities.grad, twin.logit_opacities.grad)
    del run.stepper.parts.objective.terms["seen"]
    far = run.gaussians.means[:, 1] > 50
    before = run.gaussians.logit_opacities[far].detach().clone()
    run.run()
    assert torch.equal(run.gaussians.logit_opacities[far], before) and len(before) == 4 * len(points)


def test_fast_regularises_the_opacity_of_all_if_many_are_visible(capture):
    run, seen = trainer(capture, recipe(60, strategy="fast", max_gaussians=100, sh_degree=0)), []
    run.stepper.parts.objective.terms["seen"] = lambda rendered: seen.append(rendered) or torch.zeros(())
    run.stepper.gradients(list(run.step_views()), 0)
    (rendered,) = seen
    output = rendered.output
    few = replace(rendered, output=replace(output, visible=output.visible[:20], radii=output.radii[:20]))
    term, opacities = make_objective(run.config).terms["opacity"], run.gaussians.opacities
    assert 0.25 * len(opacities) < 20 < len(output.visible)
    torch.testing.assert_close(term(few), 0.002 * opacities.mean())


def _rendered_again(run, rendered):
    from gsplat_edu.render.settings import RenderSettings

    settings = RenderSettings(sh_degree=0, jacobian_limit=1.3, depth=False)
    output = render(run.gaussians, rendered.draw.view.camera, settings=settings)
    return output, output.image


def test_a_batch_has_the_mean_gradient_of_its_views(capture):
    run = trainer(capture, CONFIG)
    views = [view for _ in range(3) for view in run.step_views()]
    assert len({view.draw.index for view in views}) == 3
    single, losses = [], []
    for view in views:
        losses.append(run.stepper.gradients([view], 0)["photo"])
        single.append(grads(run))
        for tensor in run.stepper.parameters().values():
            tensor.grad = None
    terms = run.stepper.gradients(views, 0)
    mean_over_views(run.stepper.parameters(), 3)
    torch.testing.assert_close(terms["photo"], sum(losses) / 3)
    for name, found in grads(run).items():
        # two sums of three float32 numbers in different orders differ by at most four roundings of the largest
        largest = float(torch.stack([each[name].abs() for each in single]).max())
        expected = sum(each[name] for each in single) / 3
        assert float((found - expected).abs().max()) <= 4 * 2**-24 * largest, name


def test_terms_are_summed_and_logged_by_name(capture, tmp_path):
    class Transmittance:
        def __call__(self, rendered):
            return 0.5 * rendered.output.transmittance.mean()

    objective = Objective({"photo": PhotoTerm(0.2), "empty": Transmittance()})
    log, events = LogWriter(tmp_path / "log.jsonl"), []

    def note(_, event):
        events.append(event)
        log.record(event, 1.0)

    config = recipe(10, strategy="none", sh_degree=0)
    run = trainer(capture, config, {"objective": objective}, [note])
    plain = trainer(capture, config)
    result = run.run()
    assert result.losses[0] == plain.run().losses[0], "the reported loss is that of the photo term"
    assert not torch.equal(run.gaussians.logit_opacities, plain.gaussians.logit_opacities)
    log.close()
    (line,) = RunFolder(tmp_path).log()
    means = {name: sum(float(event.terms[name]) for event in events) / 10 for name in ("photo", "empty")}
    assert line["terms"] == pytest.approx(means, rel=1e-6) and line["loss"] == line["terms"]["photo"]
    figures = run_curve_figures([line, {**line, "iteration": 20}])
    (drawn,) = [f.axes[0] for f in figures if f.axes[0].get_title() == "terms of the objective"]
    assert [text.get_text() for text in drawn.get_legend().get_texts()] == ["photo", "empty"]


def test_a_depth_term_gets_the_depth_and_moves_the_gaussians(capture):
    """With a large enough weight, the mean depth falls, because Gaussians move towards the cameras or fade."""
    found = []

    class Depth:
        needs = Needs(depth=True)

        def __call__(self, rendered):
            value = rendered.output.depth.mean()
            found.append(float(value.detach()))
            return value

    objective = Objective({"photo": PhotoTerm(0.2), "depth": Depth()})
    trainer(capture, recipe(20, strategy="none", sh_degree=0), {"objective": objective}).run()
    assert found[-1] < 0.9 * found[0]


def test_an_objective_needs_the_photo_term():
    with pytest.raises(ArgumentError, match="^terms: .*photo"):
        Objective({"depth": PhotoTerm(0.2)})


def test_a_view_model_learns_brightness_differences(capture):
    """Two of four photos are half as bright, so their gains become nearly half of the others'."""
    views, brightness = capture[0], [1.0, 0.5, 1.0, 0.5]
    dimmed = [
        View(view.camera, (view.read().image * factor).astype("uint8"), name=view.name)
        for view, factor in zip(views, brightness, strict=True)
    ]
    model = Gains(4)
    run = trainer(capture, recipe(150, strategy="none", sh_degree=0), {"view_model": model}, views=dimmed)
    run.run()
    gains = model.gains.detach()
    ratio = float((gains[1] + gains[3]) / (gains[0] + gains[2]))
    # 150 steps are 37 steps of at most 0.02 per gain, enough to reach 0.5. The untrained ratio is 1.
    assert 0.4 < ratio < 0.65, gains


@pytest.mark.parametrize("at", [3, 13])
def test_a_view_model_resumes_to_the_bit_across_density_surgery(capture, tmp_path, at):
    def make():
        return trainer(capture, CONFIG, {"view_model": Gains(4)})

    whole, first, second = make(), make(), make()
    whole.run()
    assert len(whole.gaussians) != len(capture[1])
    first.run(lambda: first.iteration >= at)
    path = save_checkpoint(tmp_path, first, 1.0)
    load_checkpoint(path, second)
    second.run()
    tensors, numbers = whole.state()
    resumed, resumed_numbers = second.state()
    assert json.dumps(numbers) == json.dumps(resumed_numbers) and tensors.keys() == resumed.keys()
    assert {"view_model.gains", "first.gains", "second.gains"} <= tensors.keys()
    for name, tensor in tensors.items():
        assert torch.equal(tensor, resumed[name]), name


def test_a_checkpoint_with_another_view_model_is_refused(capture, tmp_path):
    from gsplat_edu.base.errors import CheckpointError

    with_gains = trainer(capture, CONFIG, {"view_model": Gains(4)})
    path = save_checkpoint(tmp_path, with_gains, 0.0)
    with pytest.raises(CheckpointError, match="view_model: 'gains' is unknown"):
        load_checkpoint(path, trainer(capture, CONFIG))
    with pytest.raises(CheckpointError, match=r"view_model\.gains: is .*\(4,\), but has to be .*\(3,\)"):
        load_checkpoint(path, trainer(capture, CONFIG, {"view_model": Gains(3)}))


def test_a_view_model_cannot_reuse_a_parameter_name(capture):
    class Greedy(Gains):
        def parameters(self):
            return {"means": self.gains}

    with pytest.raises(ArgumentError, match="^view_model: 'means'"):
        trainer(capture, CONFIG, {"view_model": Greedy(4)})
