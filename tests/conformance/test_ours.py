"""Our backends pass the kit, and make.py still makes its files. tests/gpu tests the GPU kernels."""

import ast
import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import make
import run
from kit_lenses import plans
from ours import Renderer

PLANS = {plan.name: plan for plan in plans()}


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_native_kernels(isa, dtype):
    renderer = Renderer("cpu", dtype)
    report = run.check(renderer.render, renderer.gradients, precision=str(dtype).removeprefix("torch."))
    assert report.passed, str(report)
    assert not report.left_out


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_dense_renderer(dtype):
    renderer = Renderer("torch", dtype)
    report = run.check(renderer.render, renderer.gradients, precision=str(dtype).removeprefix("torch."))
    assert report.passed, str(report)
    assert not report.left_out


@pytest.mark.parametrize("name", PLANS)
def test_make_reproduces_the_inputs(name):
    """They agree up to a float32 rounding, because another C library may round exp, log and sin differently."""
    (case,), plan = run.load_cases([name]), PLANS[name]
    assert (case.name, case.shows, case.hint) == (plan.name, plan.shows, plan.hint)
    for stored, made in (
        (case.gaussians, plan.gaussians),
        (case.camera, plan.camera),
        (case.settings, plan.settings),
    ):
        assert set(stored) == set(made)
        for key, value in made.items():
            if isinstance(value, np.ndarray | float) and key != "jacobian_limit":
                np.testing.assert_allclose(stored[key], value, rtol=2.4e-7, atol=1e-9, err_msg=key)
            else:
                assert stored[key] == value, key


@pytest.mark.parametrize("name", PLANS)
def test_make_reproduces_the_results(name):
    """From the stored inputs, results agree within the float64 tolerance and sensitivities within 1 %."""
    (case,) = run.load_cases([name])
    stored = {"gaussians": case.gaussians, "camera": case.camera, "settings": case.settings}
    arrays, about = make.build(dataclasses.replace(PLANS[name], **stored))
    compared = set()
    for key, made in arrays.items():
        group, _, rest = key.partition(".")
        compared.add(group)
        if group in ("truth", "gradient"):
            known = case.truth if group == "truth" else case.gradients
            allowed = run.tolerance(case, rest if group == "truth" else key, "float64")
            assert (np.abs(known[rest] - made) <= allowed).all(), key
        elif group == "upstream":
            np.testing.assert_allclose(case.upstream[rest], made, rtol=1e-12, err_msg=key)
        elif group == "sensitivity":
            known = case.sensitivity[rest]
            noise = 1e-4 * max(1.0, known.max(initial=0))
            np.testing.assert_allclose(known, made, rtol=1e-2, atol=noise, err_msg=key)
    assert {"truth", "sensitivity"} <= compared
    assert {"gradient", "upstream"} <= compared or not case.gradients
    assert {name: case.stopped[name] for name in about["stopped"]} == pytest.approx(about["stopped"])


@pytest.mark.parametrize("name", PLANS)
def test_gradients_are_finite_differences_and_rounding_decides_no_pixel(name):
    """Every 17th number of the gradients is compared with a finite difference."""
    make.verify(PLANS[name], every=17)
    make.agrees(PLANS[name], run.CASES)


def test_a_case_that_rounding_decides_is_not_written():
    """The near plane lies within a rounding of the mean, so rounding decides whether the Gaussian is drawn."""
    plan = PLANS["one_gaussian"]
    depth = plan.camera["R"][2] @ (plan.gaussians["means"][0] - plan.camera["eye"])
    near = float(np.float32(depth * (1 - 1e-7)))
    edge = dataclasses.replace(plan, settings=plan.settings | {"z_near": near})
    with pytest.raises(AssertionError, match="one_gaussian: rounding decides drawn"):
        make.verify(edge)


def test_a_wrong_gradient_is_not_written(monkeypatch):
    right = make.gradients
    wrong = lambda *given: {n: g * (1 + 1e-4) for n, g in right(*given).items()}  # noqa: E731
    monkeypatch.setattr(make, "gradients", wrong)
    with pytest.raises(AssertionError, match="gradient_smooth: d/d means"):
        make.verify(PLANS["gradient_smooth"])


def test_the_kit_is_small_and_complete():
    files = list(run.CASES.iterdir())
    assert {path.stem for path in files} == set(PLANS)
    assert sum(path.stat().st_size for path in files) < 3e6


def test_no_gradient_case_is_trivial():
    """Every gradient is far from zero in some case, and every gradient case has all that its camera has."""
    cases = [case for case in run.load_cases() if case.gradients]
    for case in cases:
        camera = make.camera_inputs(PLANS[case.name])
        assert set(case.gradients) == {*run.GRADIENTS[:7], *camera}, case.name
    for name in run.GRADIENTS:
        having = [case for case in cases if name in case.gradients]
        largest = max(np.abs(case.gradients[name]).max() for case in having)
        assert largest > 1e3 * max(
            run.tolerance(case, f"gradient.{name}", "float32").min() for case in having
        ), name


def test_the_runner_needs_numpy_and_safetensors_only():
    tree = ast.parse(Path(run.__file__).read_text())
    imported = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(node.module.partition(".")[0])
    assert imported - set(sys.stdlib_module_names) == {"numpy", "safetensors"}
