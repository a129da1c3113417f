"""Choose the capture for a benchmark: the given one, the project's own, or a procedural one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

NAME = "snowmiku97"
"""The capture behind the figures in RESULTS.md."""


@contextmanager
def capture(named: Path | None, smoke: bool) -> Iterator[Path]:
    """Yield the folder of a capture.

    Args:
        named: Path given by the user; None for snowmiku97 in $GSPLAT_EDU_DATA or ../shared/data.
        smoke: Make a tiny procedural capture instead of the default.

    Raises:
        SystemExit: the given path does not exist.
    """
    if named is not None and not named.exists():
        raise SystemExit(f"{named}: does not exist; give another capture")
    default = Path(os.environ.get("GSPLAT_EDU_DATA", "../shared/data")) / NAME
    if named is not None or (default.exists() and not smoke):
        yield named or default
        return
    # imported late, because limits.py would count their memory as its children's
    from gsplat_edu.data.procedural import procedural_capture
    from gsplat_edu.data.writers import write_colmap

    with TemporaryDirectory() as scratch:
        made = Path(scratch) / "procedural"
        size, count = (16, 10) if smoke else (128, 24)
        if not smoke:
            print(
                f"no {NAME} in {default.parent}: measuring a procedural capture of {count} photos, {size} px"
            )
        write_colmap(made, *procedural_capture(size, count, splats=60 if smoke else 300))
        yield made
