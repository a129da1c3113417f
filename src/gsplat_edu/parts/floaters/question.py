"""The option `--clean`: remove floaters from the trained scene."""

from __future__ import annotations

from gsplat_edu.train.setting import Question

CLEAN = Question(
    name="clean",
    help="remove floaters and splats that no camera sees from the trained scene, as `gsplat-edu clean` does",
    common=True,
    instead_in_blocks="run `gsplat-edu clean` on the merged run",
)
