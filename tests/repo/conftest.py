"""Pages with the site's moving figures, and a browser that opens them."""

import json

import pytest

from browsers import chromium
from chapters import ROOT, tool
from figure_pages import CHAPTERS, STATIC


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Pages with nothing but the cells that `with_figures` adds, one for each chapter."""
    out = tmp_path_factory.mktemp("figures")
    (out / "notebooks").mkdir()
    (out / "_static").symlink_to(STATIC)
    for chapter in CHAPTERS:
        notebook = json.loads((ROOT / "notebooks" / f"{chapter}.ipynb").read_text())
        before = len(notebook["cells"])
        tool("site_figures").with_figures(chapter, notebook)
        added = [cell["source"] for cell in notebook["cells"] if cell["id"].startswith("figure-")]
        assert len(added) == len(notebook["cells"]) - before
        head = '<!doctype html><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        head += '<link rel="stylesheet" href="../_static/site.css">'
        head += "<style>body { margin: 0; --color-brand-primary: #2962ff; }</style>"
        (out / "notebooks" / f"{chapter}.html").write_text(head + "\n".join(added))
    return out / "notebooks"


@pytest.fixture(scope="module")
def browser():
    with chromium() as launched:
        yield launched


@pytest.fixture
def opened(browser, pages):
    """Open a chapter's page on a phone with a touch screen; a message in the console fails the test."""
    messages, contexts = [], []

    def opening(chapter, **settings):
        context = browser.new_context(viewport={"width": 390, "height": 800}, has_touch=True, **settings)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: messages.append(message.text))
        page.on("pageerror", lambda error: messages.append(str(error)))
        page.goto((pages / f"{chapter}.html").as_uri())
        return page

    yield opening
    for context in contexts:
        context.close()
    assert messages == []
