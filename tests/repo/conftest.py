"""Pages with the site's moving figures, and a browser that opens them."""

import re

import pytest

from figure_pages import CHAPTERS, NO_ADAPTER, STATIC, write_pages
from node import Node


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Pages with nothing but the cells that `with_figures` adds, one for each chapter."""
    return write_pages(tmp_path_factory.mktemp("figures"), CHAPTERS)


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
    assert [text for text in messages if text != NO_ADAPTER] == []


@pytest.fixture
def formulas(pages):
    """Run the scripts of a chapter's page in node, for what they compute."""
    made = []

    def running(chapter):
        names = re.findall(r'<script src="../_static/([^"]+)"', (pages / f"{chapter}.html").read_text())
        made.append(Node([STATIC / name for name in names]))
        return made[-1]

    yield running
    for node in made:
        node.close()
