"""Write the table of docs/RECIPE.md from the settings in `gsplat_edu.train.config`.

    python tools/build_recipe_table.py

`tests/repo/test_recipe_document.py` fails if the table differs from this script's output.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from gsplat_edu.base.files import written_aside
from gsplat_edu.train.config import FOR_FAST, SETTINGS, Setting

RECIPE = Path(__file__).resolve().parent.parent / "docs" / "RECIPE.md"

HEAD = "| setting | default | meaning | source |\n|---|---|---|---|\n"


def table() -> str:
    """Return the table: one row per setting; a star marks settings that scale with the run."""
    return HEAD + "".join(_row(setting) for setting in SETTINGS)


def _row(setting: Setting) -> str:
    meaning = setting.meaning + (" *" if setting.milestone else "")
    default = f"{setting.default}" + (
        f"; fast: {FOR_FAST[setting.name]:g}" if setting.name in FOR_FAST else ""
    )
    return f"| `{setting.name}` | {default} | {meaning} | {setting.source or 'ours'} |\n"


def with_table(document: str) -> str:
    """Return the document with its first table replaced."""
    return re.sub(r"(?:^\|.*\n)+", lambda _: table(), document, count=1, flags=re.MULTILINE)


def main() -> None:
    """Write the file."""
    argparse.ArgumentParser(description="Write the table of docs/RECIPE.md.").parse_args()
    document = RECIPE.read_text(encoding="utf-8")
    with written_aside(RECIPE) as aside:
        aside.write_text(with_table(document), encoding="utf-8")
    print(f"wrote the table of docs/{RECIPE.name}")


if __name__ == "__main__":
    main()
