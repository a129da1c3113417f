"""`gsplat-edu grade`: give points for each part of an assignment, and say what is wrong."""

from __future__ import annotations

import argparse

from gsplat_edu.cli.terminal import Terminal
from gsplat_edu.grading.submission import grades


def run(arguments: argparse.Namespace) -> None:
    """Print the sum, then a line for each part."""
    name, given = grades(arguments.file, arguments.seed)
    width = max(len(one.part) for one in given)
    lines = [f"  {one.part:<{width}}  {one.points} of {one.of}  {one.reason}" for one in given]
    total, most = sum(one.points for one in given), sum(one.of for one in given)
    Terminal().say(f"{name}: {total} of {most} points", *lines)
