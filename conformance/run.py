"""Check any renderer of 3D Gaussians against the conformance kit's cases.

    python conformance/run.py MODULE:RENDER [MODULE:GRADIENTS] [--precision float32] [--without NAME,...]

RENDER is a function (gaussians, camera, settings) -> outputs, and GRADIENTS one
(gaussians, camera, settings, upstream) -> gradients. All four are dicts of float64 arrays and numbers, see README.md.
The conventions and the derivation of the tolerances are in SPECIFICATION.md. Needs NumPy and safetensors only.
Exits with 1 if a case fails, with 2 if a name is unknown.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open

Arrays = dict[str, Any]
Render = Callable[[Arrays, Arrays, Arrays], Arrays]
Gradients = Callable[[Arrays, Arrays, Arrays, Arrays], Arrays]

CASES = Path(__file__).parent / "cases"
"""The folder with one file per case."""

EPSILON = {"float32": float(np.finfo(np.float32).eps), "float64": float(np.finfo(np.float64).eps)}
"""Rounding of one operation, by precision."""

INPUT_ROUNDINGS = 16
"""A renderer may be as far off as if each input had been off by this many roundings."""

FLOOR = {"float32": 100 * EPSILON["float32"], "float64": 1e-12}
"""In addition, each number may be off by this fraction of the largest number of its array. In float64, this is the
rounding of the truth itself."""

T_STOP = 1e-4
"""Transmittance below which a renderer may stop compositing."""

OUTPUTS = ("image", "transmittance", "alpha", "depth", "median_depth", "features")
"""The outputs of a render that are compared."""

GRADIENTS = (
    *("means", "quats", "log_scales", "sh", "logit_opacities", "features", "background"),
    *("R", "eye", "fx", "fy", "cx", "cy", "distortion", "turn", "shift"),
)
"""The gradients that are compared. Those of lens and shutter exist where a camera has them."""

LENSES = ("distortion", "fisheye", "equirectangular", "orthographic", "rolling_shutter", "motion_blur")
"""What a camera may have beyond a pinhole's; `without` names what a renderer does not know, as "lens.fisheye"."""

PINHOLE: Arrays = {
    "projection": "perspective",
    "distortion": np.zeros(15),
    "radial_first": False,
    "readout": "none",
    "turn": np.zeros(3),
    "shift": np.zeros(3),
    "exposure": 0.0,
}
"""Lens and shutter of a pinhole at rest, which the files of such cases leave out."""


@dataclass(frozen=True)
class Case:
    """One scene with its true outputs and, in some cases, gradients.

    Args:
        name: Name of the case and of its file.
        shows: What the case tests.
        hint: What a failure usually means.
        gaussians: means (N, 3), quats (N, 4), log_scales (N, 3), sh (N, K, 3), logit_opacities (N,), features (N, C).
        camera: R (3, 3), eye (3,), fx, fy, cx, cy, width, height; and lens and shutter, as `PINHOLE`.
        settings: background (3,), sh_degree, antialiased, jacobian_limit, alpha_max, z_near.
        truth: The true outputs by name.
        upstream: The gradients of a loss in the outputs; empty if the case has no gradients.
        gradients: The true gradients of that loss, by name.
        sensitivity: For each number of an output ("image") or a gradient ("gradient.means"), its largest change if
            each input changes, relative to that change.
        stopped: For each output, its largest change where a renderer may stop or continue; empty if it may not.
    """

    name: str
    shows: str
    hint: str
    gaussians: Arrays
    camera: Arrays
    settings: Arrays
    truth: Arrays
    upstream: Arrays
    gradients: Arrays
    sensitivity: Arrays
    stopped: dict[str, float]

    @property
    def needs(self) -> tuple[str, ...]:
        """Which of the `LENSES` the camera has."""
        found = {self.camera["projection"]}
        found |= {"distortion"} if np.any(self.camera["distortion"]) else set()
        found |= {"rolling_shutter"} if self.camera["readout"] != "none" else set()
        found |= {"motion_blur"} if self.camera["exposure"] else set()
        return tuple(name for name in LENSES if name in found)


@dataclass(frozen=True)
class Row:
    """The comparison of one output or gradient of one case, at the number that is worst relative to its tolerance.

    Args:
        case: Name of the case.
        what: Name of the output, or "d/d" and the name of the parameter.
        error: Its error there; infinite for a missing, misshapen or NaN result.
        allowed: The tolerance there.
        note: What is wrong if no number could be compared.
    """

    case: str
    what: str
    error: float
    allowed: float
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether the error is within the tolerance."""
        return self.error <= self.allowed


@dataclass(frozen=True)
class Report:
    """The result of `check`.

    Args:
        rows: One per compared array.
        hints: What a failure usually means, by case.
        left_out: What was not compared, at the caller's request.
        skipped: The lenses that the renderer does not know, by the case that needs them and was not run.
    """

    rows: tuple[Row, ...]
    hints: dict[str, str]
    left_out: tuple[str, ...]
    skipped: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def failures(self) -> tuple[Row, ...]:
        """The rows that failed."""
        return tuple(row for row in self.rows if not row.passed)

    @property
    def failed_cases(self) -> tuple[str, ...]:
        """Names of the cases with a failed row, in order."""
        return tuple(dict.fromkeys(row.case for row in self.failures))

    @property
    def passed(self) -> bool:
        """Whether something was compared and nothing failed."""
        return bool(self.rows) and not self.failures

    def __str__(self) -> str:
        """Format the table, the hints of the failed cases, and a summary."""
        lines = [f"{'case':<26}{'array':<20}{'error':>10}{'allowed':>11}  result"]
        for row in self.rows:
            result = "pass" if row.passed else f"FAIL {row.note}".rstrip()
            lines.append(f"{row.case:<26}{row.what:<20}{row.error:>10.2e}{row.allowed:>11.2e}  {result}")
        lines += [f"\n{name} failed. {self.hints[name]}" for name in self.failed_cases]
        cases, failed = len({row.case for row in self.rows}), len(self.failed_cases)
        lines.append(f"\n{cases - failed} of {cases} cases pass, {len(self.rows)} arrays compared.")
        lines += [f"Left out: {', '.join(self.left_out)}."] if self.left_out else []
        if self.skipped:
            lacks = [f"{name} ({', '.join(missing)})" for name, missing in self.skipped.items()]
            lines.append(
                f"{len(lacks)} cases not run, of lenses that the renderer lacks: {'; '.join(lacks)}."
            )
        return "\n".join(lines)


def read_case(path: Path) -> Case:
    """Read one case from its file."""
    with safe_open(path, framework="numpy") as file:
        flat = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        about = json.loads(file.metadata()["case"])
    groups: dict[str, Arrays] = {
        name: {}
        for name in ("gaussians", "camera", "settings", "truth", "upstream", "gradient", "sensitivity")
    }
    for key, array in flat.items():
        group, _, name = key.partition(".")
        groups[group][name] = array
    groups["camera"] = PINHOLE | groups["camera"] | about["camera"]
    groups["settings"] |= about["settings"]
    groups["truth"]["alpha"] = 1.0 - groups["truth"]["transmittance"]
    groups["sensitivity"]["alpha"] = groups["sensitivity"]["transmittance"]
    stopped = about["stopped"] | ({"alpha": about["stopped"]["transmittance"]} if about["stopped"] else {})
    return Case(
        about["name"],
        about["shows"],
        about["hint"],
        gaussians=groups["gaussians"],
        camera=groups["camera"],
        settings=groups["settings"],
        truth=groups["truth"],
        upstream=groups["upstream"],
        gradients=groups["gradient"],
        sensitivity=groups["sensitivity"],
        stopped=stopped,
    )


def load_cases(names: Iterable[str] | None = None, folder: Path = CASES) -> tuple[Case, ...]:
    """Read cases by name, or all of them in alphabetical order.

    Raises:
        KeyError: there is no case of that name.
    """
    files = {path.stem: path for path in sorted(folder.glob("*.safetensors"))}
    return tuple(read_case(files[name]) for name in (files if names is None else names))


def tolerance(case: Case, name: str, precision: str) -> np.ndarray:
    """Return the allowed error of each number of an output ("image") or a gradient ("gradient.means")."""
    gradient = name.startswith("gradient.")
    truth = case.gradients[name.removeprefix("gradient.")] if gradient else case.truth[name]
    scale = np.abs(truth).max(initial=0.0)
    allowed = INPUT_ROUNDINGS * EPSILON[precision] * case.sensitivity[name] + FLOOR[precision] * scale
    if not gradient and name in case.stopped:
        below = case.truth["transmittance"] < 1.001 * T_STOP
        stopped = case.stopped[name] * below
        allowed = allowed + stopped.reshape(below.shape + (1,) * (allowed.ndim - below.ndim))
    return np.asarray(allowed)


def check(
    render: Render,
    gradients: Gradients | None = None,
    *,
    precision: str = "float64",
    cases: Iterable[Case] | None = None,
    without: Collection[str] = (),
) -> Report:
    """Compare a renderer with the cases.

    Args:
        render: Function (gaussians, camera, settings) -> outputs.
        gradients: Function (gaussians, camera, settings, upstream) -> gradients; None to compare outputs only.
        precision: "float64" or "float32", that of the renderer's arithmetic.
        cases: The cases; None for all.
        without: Outputs ("median_depth"), gradients ("gradient.R") and lenses ("lens.fisheye"; "lens" for all) that
            the renderer does not have. The report names the cases of lenses that it does not know.

    Raises:
        ValueError: the precision or a name in `without` is unknown.
    """
    known = {
        *OUTPUTS,
        *(f"gradient.{name}" for name in GRADIENTS),
        "lens",
        *(f"lens.{name}" for name in LENSES),
    }
    if unknown := sorted(set(without) - known):
        raise ValueError(f"without: does not know {unknown[0]!r}; use {', '.join(sorted(known))}")
    if precision not in EPSILON:
        raise ValueError(f"precision: is {precision!r}, but has to be float32 or float64")
    chosen = load_cases() if cases is None else tuple(cases)
    rows: list[Row] = []
    skipped: dict[str, tuple[str, ...]] = {}
    for case in chosen:
        if missing := tuple(lens for lens in case.needs if {"lens", f"lens.{lens}"} & set(without)):
            skipped[case.name] = missing
            continue
        rows += _compare(case, "", _outcome(render, case, with_upstream=False), precision, without)
        if case.gradients and gradients is not None:
            found = _outcome(gradients, case, with_upstream=True)
            rows += _compare(case, "gradient.", found, precision, without)
    left_out = (*sorted(without), *(("all gradients",) if gradients is None else ()))
    return Report(tuple(rows), {case.name: case.hint for case in chosen}, left_out, skipped)


def _outcome(function: Callable[..., Arrays], case: Case, *, with_upstream: bool) -> Arrays | str:
    """Call the renderer with copies, so that it cannot change the case; return its error as text."""
    given = (case.gaussians, case.camera, case.settings) + ((case.upstream,) if with_upstream else ())
    copies = [
        {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in part.items()}
        for part in given
    ]
    try:
        return function(*copies)
    except Exception as error:  # the other cases are still worth knowing
        return f"{type(error).__name__}: {error}"


def _compare(
    case: Case, prefix: str, found: Arrays | str, precision: str, without: Collection[str]
) -> Iterator[Row]:
    truths = case.gradients if prefix else {name: case.truth[name] for name in OUTPUTS}
    for name, truth in truths.items():
        if prefix + name in without:
            continue
        what = f"d/d {name}" if prefix else name
        result = found.get(name) if isinstance(found, dict) else None
        if result is None:
            note = "is missing" if isinstance(found, dict) else found.splitlines()[0]
        elif np.shape(result) != truth.shape:
            note = f"has shape {np.shape(result)}, expected {truth.shape}"
        else:
            allowed = tolerance(case, prefix + name, precision)
            yield _row(case.name, what, np.asarray(result, np.float64), truth, allowed)
            continue
        yield Row(case.name, what, float("inf"), 0.0, note)


def _row(case: str, what: str, result: np.ndarray, truth: np.ndarray, allowed: np.ndarray) -> Row:
    if truth.size == 0:
        return Row(case, what, 0.0, 0.0)
    if not np.isfinite(result).all():
        return Row(case, what, float("inf"), 0.0, "has NaN or infinite values")
    error = np.abs(result - truth)
    # Relative to the tolerance; where that is zero, any error is the worst.
    ratio = np.where(error <= allowed, 0.0, np.inf)
    np.divide(error, allowed, out=ratio, where=allowed > 0)
    worst = int(ratio.argmax())
    return Row(case, what, float(error.flat[worst]), float(allowed.flat[worst]))


def _function(path: str) -> Callable[..., Arrays]:
    module, _, name = path.partition(":")
    found: Callable[..., Arrays] = getattr(importlib.import_module(module), name)
    return found


def main(argv: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(description="Check a renderer against the conformance kit.")
    parser.add_argument("render", metavar="MODULE:RENDER", help="the function that renders")
    parser.add_argument(
        "gradients", metavar="MODULE:GRADIENTS", nargs="?", help="the function that differentiates"
    )
    parser.add_argument("--precision", choices=sorted(EPSILON), default="float64")
    parser.add_argument("--case", action="append", help="check only this case; may be repeated")
    parser.add_argument(
        "--without", default="", help="what the renderer lacks: median_depth,lens.fisheye,..."
    )
    options = parser.parse_args(argv)
    sys.path.insert(0, "")  # modules in the working directory
    try:
        cases = load_cases(options.case)
        functions = [_function(path) for path in (options.render, options.gradients) if path]
        without = [name for name in options.without.split(",") if name]
        report = check(*functions, precision=options.precision, cases=cases, without=without)
    except (AttributeError, ImportError, KeyError, ValueError) as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    print(report)
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
