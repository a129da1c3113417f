"""The process in which CoACD cuts a mesh: CoACD may end the process that calls it, as at islands beside a torn hole.

    python -m gsplat_edu.mesh.coacd_process SOLID PARTS OPTIONS

`cut` starts it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from safetensors.numpy import load_file, save_file

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.scene.mesh import Mesh

LAST_WORDS = 200
"""Characters of what a failed process printed last that a message repeats."""


def cut(solid: Mesh, options: Mapping[str, Any]) -> list[Float64[np.ndarray, "N 3"]]:
    """Return the corners of each convex part, by CoACD in a process of its own.

    Args:
        solid: The mesh, of coordinates around 0 and at most 1.
        options: Keyword arguments of `coacd.run_coacd`.

    Raises:
        ArgumentError: CoACD failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "solid", Path(folder) / "parts"
        save_file({"vertices": solid.vertices.copy(), "faces": solid.faces.copy()}, given)
        command = [sys.executable, "-m", "gsplat_edu.mesh.coacd_process", str(given), str(found)]
        command.append(json.dumps(dict(options)))
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
        if done.returncode or not found.is_file():
            said = done.stderr.decode(errors="replace").strip().splitlines()
            why = f"signal {-done.returncode}" if done.returncode < 0 else f"exit code {done.returncode}"
            last = f": {said[-1][:LAST_WORDS]}" if said else ""
            raise ArgumentError(
                f"convex parts: CoACD cannot cut this mesh ({why}{last}); write a collider of triangles, or keep only"
                " the large parts of the mesh"
            )
        parts = load_file(found)
        return [parts[str(number)].reshape(-1, 3) for number in range(len(parts))]


def main(given: str, found: str, options: str) -> None:
    """Cut the mesh of a file, and write the parts' corners."""
    import coacd

    solid = load_file(given)
    mesh = coacd.Mesh(solid["vertices"], solid["faces"])
    coacd.set_log_level("off")
    parts = coacd.run_coacd(mesh, **json.loads(options))
    save_file(
        {str(n): np.ascontiguousarray(points, np.float64) for n, (points, _) in enumerate(parts)}, found
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
