"""Run a script that imports the engine in a process of its own, so that the tests' process never loads pycolmap."""

import subprocess
import sys
from pathlib import Path

import gsplat_edu.sfm

START = f"""
import sys
sys.path.insert(0, {str(Path(gsplat_edu.sfm.__file__).parent)!r})
import numpy as np
import pycolmap
"""


def printed(script):
    """Return the lines that a script prints."""
    ran = subprocess.run(
        [sys.executable, "-P", "-c", START + script], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.splitlines()
