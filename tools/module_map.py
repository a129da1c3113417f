"""Write docs/MODULES.md: every module of the package, by room, with the first sentence of its docstring.

    python tools/module_map.py             write it
    python tools/module_map.py --check     exit 1 if the file is not current

tests/repo/test_docs.py runs the check.
"""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "src" / "gsplat_edu"
DOCUMENT = ROOT / "docs" / "MODULES.md"

INTRODUCTION = """# Modules

Made by tools/module_map.py from the docstrings. [ARCHITECTURE.md](../ARCHITECTURE.md) says how the rooms fit together
and who may import whom.
"""


def first_sentence(path: Path) -> str:
    """Return the first sentence of a module's docstring, on one line.

    Raises:
        SystemExit: the module has no docstring; names it.
    """
    text = ast.get_docstring(ast.parse(path.read_text("utf-8")))
    if not text:
        raise SystemExit(
            f"{path.relative_to(ROOT)}: has no docstring; say in one sentence what the module is for"
        )
    line = " ".join(text.split("\n\n")[0].split())
    return re.split(r"(?<=[a-z0-9)`'\"])\. (?=[A-Z`])", line, maxsplit=1)[0].rstrip(".")


def document() -> str:
    """Return the text of docs/MODULES.md."""
    parts = [INTRODUCTION]
    for folder in sorted({path.parent for path in PACKAGE.rglob("*.py")}):
        name = ".".join(("gsplat_edu", *folder.relative_to(PACKAGE).parts))
        rows = [f"## `{name}`", "", f"{first_sentence(folder / '__init__.py')}.", ""]
        modules = sorted(path for path in folder.glob("*.py") if path.name != "__init__.py")
        if modules:
            rows += ["| module | what it is for |", "|---|---|"]
            rows += [
                f"| `{path.stem}` | {first_sentence(path).replace('|', chr(92) + '|')} |" for path in modules
            ]
            rows.append("")
        parts.append("\n".join(rows))
    return "\n".join(parts)


def main(arguments: list[str]) -> int:
    """Write the document, or compare it."""
    text = document()
    if "--check" in arguments:
        current = DOCUMENT.is_file() and DOCUMENT.read_text("utf-8") == text
        if not current:
            print("docs/MODULES.md: is not current; run tools/module_map.py", file=sys.stderr)
        return 0 if current else 1
    DOCUMENT.write_text(text, "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
