"""Our backends pass the kit, and its files are those that make.py makes today. tests/gpu has the kernels for GPUs."""

import ast
import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import make
import run
from kit_scenes import plans
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
def test_the_files_are_those_that_are_made_today(name):
    """Inputs are equal. Another C library may round exp and sin differently: results are equal within the tolerance."""
    arrays, about = make.build(PLANS[name])
    (case,) = run.load_cases([name])
    assert (case.name, case.shows, case.hint) == (about["name"], about["shows"], about["hint"])
    groups = {"truth": case.truth, "gradient": case.gradients}
    exact = {
        "gaussians": case.gaussians,
        "camera": case.camera,
        "settings": case.settings,
        "upstream": case.upstream,
    }
    for key, made in arrays.items():
        group, _, rest = key.partition(".")
        if group in exact:
            np.testing.assert_array_equal(exact[group][rest], made, err_msg=key)
        elif group in groups:
            allowed = run.tolerance(case, rest if group == "truth" else key, "float64")
            assert (np.abs(groups[group][rest] - made) <= allowed).all(), key
        else:
            stored = case.sensitivity[rest]
            noise = 1e-4 * max(1.0, stored.max(initial=0))
            np.testing.assert_allclose(stored, made, rtol=1e-2, atol=noise, err_msg=key)
    assert {**about["camera"], **about["settings"]}.items() <= {**case.camera, **case.settings}.items()
    assert {name: case.stopped[name] for name in about["stopped"]} == pytest.approx(about["stopped"])


@pytest.mark.parametrize("name", PLANS)
def test_the_cases_hold_what_they_promise(name):
    """Gradients, of which every 17th number is tested, are those of finite differences; no rounding decides a pixel."""
    make.verify(PLANS[name], every=17)
    make.agrees(PLANS[name], run.CASES)


def test_a_case_that_rounding_decides_is_not_written():
    """A mean on the rim: one opacity is exactly at the cut-off."""
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
    """Every gradient is far from zero in some case, and every gradient case has all of them."""
    cases = [case for case in run.load_cases() if case.gradients]
    assert all(tuple(sorted(case.gradients)) == tuple(sorted(run.GRADIENTS)) for case in cases)
    for name in run.GRADIENTS:
        largest = max(np.abs(case.gradients[name]).max() for case in cases)
        assert largest > 1e3 * max(
            run.tolerance(case, f"gradient.{name}", "float32").min() for case in cases
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
