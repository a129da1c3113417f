"""Assignment 6: one's own capture, trained and judged by photos that were held out.

It follows chapter 14.
"""

from __future__ import annotations

import functools
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.grading.assignment import RIGHT, Grade
from gsplat_edu.io.formats import read_scene
from gsplat_edu.render.api import render
from gsplat_edu.runs.dataset import run_dataset
from gsplat_edu.runs.folder import RunFolder, render_settings

PHOTOS, HELD_OUT = 30, 3
"""The least numbers of photos, and of those among them that are held out."""

LEVELS = (20.0, 22.0, 24.0, 26.0, 28.0)
"""PSNR of the held-out photos, dB: a point each."""

AGREED = 0.1
"""Largest difference between the scores in metrics.json and new ones, dB: backends differ by less."""


def grades(folder: Path, run: object) -> list[Grade]:
    """Judge a run by its capture; its scene is rendered and scored anew.

    Args:
        folder: Where a relative path of the run begins.
        run: The run's folder, from the variable RUN.

    Raises:
        ArgumentError: there is no such run.
        CheckpointError: the run has no scene, or its files are damaged.
        DatasetError: its capture cannot be read.
    """
    if not isinstance(run, str) or not RunFolder(folder / run).exists():
        raise ArgumentError(
            f'RUN: {run!r} is no run folder; write for example RUN = "runs/plush", the folder of train --out'
        )
    found = RunFolder(folder / run)
    config = found.read_config()
    dataset = run_dataset(config)
    gaussians = read_scene(found.latest_scene()[0]).relative_to(dataset.origin)
    settings = render_settings(config)
    draw = functools.partial(render, settings=settings, backend="cpu")
    measured = summarize(score_views(gaussians, dataset.test, draw, settings.background))["psnr"]
    return judged(len(dataset.train) + len(dataset.test), len(dataset.test), measured, _noted(found))


def judged(photos: int, held_out: int, psnr: float | None, noted: float | None) -> list[Grade]:
    """Return the grades of a run.

    Args:
        photos: Number of photos, with those that are held out.
        held_out: Number of those.
        psnr: Their mean PSNR, dB; None without any.
        noted: The same, as metrics.json has it; None if it has none.
    """
    reached = sum(psnr is not None and psnr >= level for level in LEVELS)
    levels = ", ".join(f"{level:.0f}" for level in LEVELS)
    said = "no photo is held out" if psnr is None else f"{psnr:.2f} dB; a point for each of {levels} dB"
    agrees = psnr is not None and noted is not None and abs(psnr - noted) <= AGREED
    told = (
        "has no score of the scene"
        if noted is None
        else f"says {noted:.2f} dB, which the scene does not have"
    )
    return [
        _all_or_nothing("photos", 2, photos >= PHOTOS, f"{photos} photos; take at least {PHOTOS}"),
        _all_or_nothing(
            "held_out", 1, held_out >= HELD_OUT, f"{held_out} are held out; hold out at least {HELD_OUT}"
        ),
        Grade("quality", reached, len(LEVELS), RIGHT if reached == len(LEVELS) else said),
        _all_or_nothing("metrics", 2, agrees, f"metrics.json {told}; run gsplat-edu eval"),
    ]


def _all_or_nothing(part: str, points: int, is_right: bool, reason: str) -> Grade:
    return Grade(part, points if is_right else 0, points, RIGHT if is_right else reason)


def _noted(run: RunFolder) -> float | None:
    test = run.read_metrics().get("test")
    value = test.get("psnr") if isinstance(test, dict) else None
    return float(value) if isinstance(value, int | float) else None
