"""What the tests of the site's moving figures share: pages, data, gestures, and functions of chapters."""

import ast
import json
from collections.abc import Iterable
from pathlib import Path

import site_figures
from chapters import ROOT
from gsplat_edu.base.styles import tokens_by_theme
from waiting import until_in

STATIC = ROOT / "docs" / "site" / "static"
FIGURES = [(figure.chapter, figure.name) for figure in site_figures.FIGURES]
CHAPTERS = sorted({chapter for chapter, _ in FIGURES})
HEAD = (
    '<!doctype html><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    f"<style>{tokens_by_theme()}</style>"
    '<link rel="stylesheet" href="../_static/site.css">'
    "<style>body { margin: 0; --color-brand-primary: #2962ff; }</style>"
)


NO_ADAPTER = "No available adapters."
"""Chromium itself says so in the console when a page asks for WebGPU and there is no GPU."""


def write_pages(out: Path, chapters: Iterable[str]) -> Path:
    """Write a page for each chapter with the cells that `with_figures` adds, and return their folder."""
    (out / "notebooks").mkdir()
    (out / "_static").symlink_to(STATIC)
    for chapter in chapters:
        notebook = json.loads((ROOT / "notebooks" / f"{chapter}.ipynb").read_text())
        before = len(notebook["cells"])
        site_figures.with_figures(chapter, notebook)
        added = [cell["source"] for cell in notebook["cells"] if cell["id"].startswith("figure-")]
        assert len(added) == len(notebook["cells"]) - before
        (out / "notebooks" / f"{chapter}.html").write_text(HEAD + "\n".join(added))
    return out / "notebooks"


def read_data(name: str) -> dict:
    """Read the data of a figure as the page does: a script with one JSON value."""
    text = (STATIC / "play" / f"{name}-data.js").read_text()
    return json.loads(text.split(" = ", 1)[1].rstrip(";\n"))


def state(page, name):
    """Return the state of a figure."""
    return page.evaluate(f"gsplatPlay.live.{name}.state")


def told(page, name):
    """Return what a figure says about its state."""
    return page.locator(f"[data-play={name}] output").inner_text()


def canvas_box(page, name):
    """Scroll a figure's canvas into view; return its locator and its box."""
    canvas = page.locator(f"[data-play={name}] canvas")
    canvas.scroll_into_view_if_needed()
    return canvas, canvas.bounding_box()


def tap(page, place):
    """Tap an element, or a place of the window; wait until the page has heard of it, which Playwright does not."""
    page.evaluate(
        "() => { window.tapped = false;"
        " addEventListener('click', () => requestAnimationFrame(() => { window.tapped = true; }), { once: true }); }"
    )
    page.touchscreen.tap(*place) if isinstance(place, tuple) else place.tap()
    until_in(page, page, "window.tapped")


def chapter_functions(chapter, names, **given):
    """Execute functions of a chapter, by name, without the rest of the chapter."""
    tree = ast.parse((ROOT / "notebooks" / "source" / f"{chapter}.py").read_text())
    chosen = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name in names]
    assert len(chosen) == len(names)
    space = dict(given)
    exec(compile(ast.Module(chosen, []), chapter, "exec"), space)
    return [space[name] for name in names]
