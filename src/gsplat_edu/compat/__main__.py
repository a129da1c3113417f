"""Run a script, or a module with `-m`, that imports gsplat: `python -m gsplat_edu.compat script.py [arguments]`."""

from __future__ import annotations

import argparse
import runpy
import sys
from pathlib import Path

from gsplat_edu.compat.unmodified import install


def main() -> None:
    """Install, and run what the command line names as Python would."""
    parser = argparse.ArgumentParser(
        prog="python -m gsplat_edu.compat",
        description="Run a script that imports gsplat on our kernels; its device cuda is the CPU.",
    )
    parser.add_argument("-m", dest="module", action="store_true", help="the script is the name of a module")
    parser.add_argument("script", help="a Python file")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="what the script gets")
    given = parser.parse_args()
    if not given.module and not Path(given.script).is_file():
        parser.error(f"script: {given.script} is not a file")
    install()
    sys.argv = [given.script, *given.arguments]
    sys.path[0] = "" if given.module else str(Path(given.script).resolve().parent)
    if given.module:
        runpy.run_module(given.script, run_name="__main__", alter_sys=True)
    else:
        runpy.run_path(given.script, run_name="__main__")


if __name__ == "__main__":
    main()
