"""What the tests of the chapters share: sources, the builder, and the names of the package that a text binds."""

import ast
import functools
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"\]\(([^)\s]+)\)")
SOURCES = sorted((ROOT / "notebooks" / "source").glob("*.py"))
CHAPTERS = pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)


def top_level_names(text: str) -> set[str]:
    """Collect the functions, classes and constants that a module defines."""
    names = set()
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found = (n for target in targets for n in ast.walk(target) if isinstance(n, ast.Name))
            names |= {n.id for n in found if isinstance(n.ctx, ast.Store)}
    return names


def taught(module: Path) -> bool:
    """Return whether a module names a chapter, or a chapter imports from it."""
    dotted = ".".join(module.relative_to(ROOT / "src").with_suffix("").parts)
    text = "\n".join(path.read_text() for path in SOURCES)
    named = re.search(r"^Chapters?: ", module.read_text(), flags=re.MULTILINE)
    return (
        bool(named) or re.search(rf"^from {re.escape(dotted)} import ", text, flags=re.MULTILINE) is not None
    )


@functools.cache
def public_names() -> set[str]:
    """Collect the names that a reader of the chapters meets in the package."""
    modules = (ROOT / "src" / "gsplat_edu").rglob("*.py")
    names = {name for module in modules if taught(module) for name in top_level_names(module.read_text())}
    return {name for name in names if not name.startswith("_")}


def redefinitions(text: str) -> set[str]:
    """Find names of the package that a chapter binds, in any scope and by any statement."""
    bound = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            bound.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store | ast.Del):
            bound.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store | ast.Del):
            bound.add(node.attr)
        elif isinstance(node, ast.arg):
            bound.add(node.arg)
        elif isinstance(node, ast.MatchAs | ast.MatchStar) and node.name:
            bound.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            ours = isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "gsplat_edu"
            for alias in node.names:
                renamed = alias.asname not in (None, alias.name)
                bound |= (
                    {alias.asname or alias.name, alias.name}
                    if not ours
                    else {alias.name}
                    if renamed
                    else set()
                )
    return bound & public_names()
