"""The icons of all pages: one file has them, pages name them, and a browser draws each on its grid."""

import re
from pathlib import Path

import pytest

import gsplat_edu
from gsplat_edu.base.icons import NAMED, icons, icons_of
from gsplat_edu.base.styles import components
from gsplat_edu.viewer import capture_page, page_parts
from gsplat_edu.viewer.modules import script, web

PACKAGE = Path(gsplat_edu.__file__).parent

REPOSITORY = Path(__file__).parents[2]

ICONS = PACKAGE / "base" / "web" / "icons.svg"

DRAWN = re.compile(r"""viewBox\W{1,4}0 0 24 24|<path[^>]* d=""")
"""An icon drawn in place: its grid, or strokes in markup."""

KINDS = {
    "plain": page_parts.PLAIN,
    "levels": page_parts.LEVELS,
    "live": page_parts.LIVE,
    "pictured": page_parts.PICTURED,
    "editor": page_parts.EDITOR,
}


def test_no_other_file_of_ours_draws_an_icon():
    folders = [PACKAGE, REPOSITORY / "course", REPOSITORY / "tests" / "pages"]
    texts = [
        path
        for folder in folders
        for ending in ("js", "html", "py", "css", "svg")
        for path in folder.rglob(f"*.{ending}")
        if path not in (ICONS, PACKAGE / "studio" / "web" / "icon.svg", Path(__file__))
    ]
    assert len(texts) > 300
    assert [str(path) for path in texts if DRAWN.search(path.read_text("utf-8"))] == []
    assert DRAWN.search(ICONS.read_text("utf-8"))


def test_every_icon_is_named_once_and_shown_somewhere():
    assert len(re.findall("<symbol", ICONS.read_text("utf-8"))) == len(icons())
    shown = "".join(
        path.read_text("utf-8") for path in PACKAGE.rglob("web/*") if path.suffix in (".js", ".html")
    )
    studio = (PACKAGE / "studio" / "web" / "rail.js").read_text("utf-8")
    words = {*NAMED.findall(shown), *re.findall(r'"([\w-]+)"', studio)}
    assert set(icons()) <= words


def test_strokes_are_as_wide_as_the_design_says():
    rule = components()["icon"]
    assert "width: 24px; height: 24px;" in rule and "stroke-width: 1.75;" in rule and "fill: none" in rule
    assert all('viewBox="0 0 24 24"' in symbol for symbol in icons().values())
    assert "stroke-width" not in ICONS.read_text("utf-8")


@pytest.mark.parametrize("kind", KINDS)
def test_a_page_of_one_file_has_the_icons_that_it_names_and_no_others(kind):
    template = web("index.html")
    named = set(NAMED.findall(template + script(KINDS[kind].entries)))
    template = template.replace("{{splats}}", "")  # the caller's
    text = page_parts.filled(template, "scene", {KINDS[kind].fact: True})
    assert set(re.findall(r'<symbol id="icon-([\w-]+)"', text)) == named and {"help", "close"} <= named
    assert ("lasso" in named) == (kind == "editor")


def test_the_page_of_a_capture_has_its_icons():
    named = set(NAMED.findall(web("capture.html") + script(capture_page.ENTRIES)))
    assert named and icons_of(web("capture.html")).count("<symbol") == len(named)


def test_an_icon_that_does_not_exist_is_refused():
    with pytest.raises(KeyError):
        icons_of('<use href="#icon-no-such"/>')


def test_a_browser_draws_every_icon_within_its_grid(browser, gallery):
    tab = browser.new_page()
    tab.goto(gallery)
    boxes = tab.eval_on_selector_all(
        "[aria-label='all icons'] use",
        "(all) => all.map((one) => { const { x, y, width, height } = one.getBBox(); return [x, y, width, height]; })",
    )
    half = 1.75 / 2
    assert len(boxes) == len(icons())
    for name, (x, y, width, height) in zip(icons(), boxes, strict=True):
        assert min(x, y) >= half and max(x + width, y + height) <= 24 - half, name
        assert max(width, height) >= 12, name
