"""Start a job without importing the enclosing package, whose libraries conflict with COLMAP's."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

NAME = "gsplat_edu_sfm_engine"
"""Name under which this folder is imported: a top-level package, so that no parent is loaded."""


def load() -> None:
    """Make this folder importable as a top-level package."""
    here = Path(__file__).parent
    spec = spec_from_file_location(NAME, here / "__init__.py", submodule_search_locations=[str(here)])
    assert spec is not None and spec.loader is not None
    sys.modules[NAME] = module_from_spec(spec)
    spec.loader.exec_module(sys.modules[NAME])


if __name__ == "__main__":
    load()
    sys.exit(import_module(f"{NAME}.jobs").main())
