"""In Chromium, a picture of every component in both themes is that of `pictures/`, but for a rasteriser's rounding.

Fonts and their rasterisation differ between machines. The pictures are therefore set in a font of this file, in which
every character is the same solid bar: text keeps its place, size, weight and colour, and has no curves. The rest is
drawn by Chromium's own code with the flags of the tests' browser, on any machine: the pictures were equal in every
pixel with and without --enable-gpu-rasterization. The tolerance is for the rounding of another Chromium; each change
that a test here makes exceeds it threefold. With --disable-gpu, which no test uses, Chromium draws
strokes and rounded corners differently (up to 620 pixels of a picture by more than 8 levels, 2,842 of the icons).

After a change of a component that is meant, make the pictures again, and look at them:

    MAKE_PICTURES=1 python -m pytest tests/pages/test_component_pictures.py
"""

import base64
import io
import os
from pathlib import Path

import numpy as np
import pytest
from fontTools.fontBuilder import FontBuilder
from fontTools.pens.ttGlyphPen import TTGlyphPen
from PIL import Image

from gsplat_edu.base.styles import components
from waiting import resize

PICTURES = Path(__file__).with_name("pictures")

WIDTH = 640
"""Of the window, CSS px."""

STEP = 6
"""Levels of 255 by which a pixel may differ."""

MOST_PIXELS = 64
"""Of a picture that may differ by more. Another machine's Chromium differed by 36; the smallest change here by 196."""

UNDRAWN = """
select, input { appearance: none; }
input[type="range"] { background: none; }
textarea { resize: none; }
"""
"""Hides what Chromium itself draws, differently in each version: a list's arrow, a check, a dot, a track, a grip."""

NAMES = [name for name in components() if name not in ("page", "badge")]


def bars():
    """Return a TrueType font whose characters are bars, half an em wide, as base64."""
    pen = TTGlyphPen(None)
    for i, place in enumerate([(50, 0), (50, 500), (450, 500), (450, 0)]):
        (pen.lineTo if i else pen.moveTo)(place)
    pen.closePath()
    bar, nothing = pen.glyph(), TTGlyphPen(None).glyph()
    builder = FontBuilder(1000, isTTF=True)
    builder.setupGlyphOrder([".notdef", "space", "bar"])
    builder.setupCharacterMap(
        {32: "space"} | dict.fromkeys([*range(33, 0x180), *range(0x2000, 0x2200)], "bar")
    )
    builder.setupGlyf({".notdef": bar, "space": nothing, "bar": bar})
    builder.setupHorizontalMetrics({".notdef": (500, 50), "space": (500, 0), "bar": (500, 50)})
    builder.setupHorizontalHeader(ascent=800, descent=-200)
    builder.setupNameTable({"familyName": "bars", "styleName": "Regular"})
    builder.setupOS2(sTypoAscender=800, sTypoDescender=-200, usWinAscent=800, usWinDescent=200)
    builder.setupPost()
    data = io.BytesIO()
    builder.save(data)
    return base64.b64encode(data.getvalue()).decode()


@pytest.fixture(scope="module")
def tab(browser, gallery):
    opened = browser.new_page(reduced_motion="reduce")
    opened.goto(gallery)
    face = f"@font-face {{ font-family: bars; src: url(data:font/ttf;base64,{bars()}); }}"
    opened.add_style_tag(content=face + ":root { --font: bars; --mono: bars; font-synthesis: none; }")
    opened.add_style_tag(content=UNDRAWN)
    opened.evaluate("document.fonts.load('16px bars')")
    resize(opened, WIDTH, 900)
    yield opened
    opened.close()


def picture(tab, name, theme):
    """Return a component's picture, (H, W, 3) levels."""
    tab.emulate_media(color_scheme=theme)
    png = tab.locator(f"main > section[aria-label='{name.replace('-', ' ')}']").screenshot()
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def apart(one, other):
    """Return the number of pixels in which two pictures differ; all of the larger one's if their sizes do."""
    if one.shape != other.shape:
        return max(one[..., 0].size, other[..., 0].size)
    return int((np.abs(one.astype(int) - other).max(2) > STEP).sum())


@pytest.mark.parametrize("theme", ["dark", "light"])
@pytest.mark.parametrize("name", NAMES)
def test_a_component_looks_as_in_its_picture(tab, name, theme):
    shown = picture(tab, name, theme)
    path = PICTURES / f"{name}-{theme}.png"
    if os.environ.get("MAKE_PICTURES"):
        PICTURES.mkdir(exist_ok=True)
        Image.fromarray(shown).quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
            path, optimize=True
        )
    different = apart(shown, np.asarray(Image.open(path).convert("RGB")))
    assert different <= MOST_PIXELS


CHANGES = {
    "colour": ".banner.good { background: #24402b; }",
    "colour of text": ".badge.good { color: #c0f0c8; }",
    "radius": ".card { border-radius: 9px; }",
    "padding": ".menu { padding: 5px; }",
    "border": ".sheet { border-width: 2px; }",
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_picture_shows_a_small_change(tab, change):
    names = {
        "colour": "banner",
        "colour of text": "card",
        "radius": "card",
        "padding": "menu",
        "border": "sheet",
    }
    name = names[change]
    before = picture(tab, name, "dark")
    style = tab.add_style_tag(content=CHANGES[change])
    try:
        different = apart(picture(tab, name, "dark"), before)
        assert different > 3 * MOST_PIXELS
    finally:
        style.evaluate("(one) => one.remove()")


def test_the_pictures_are_small_and_there_is_one_for_each_component():
    assert {path.name for path in PICTURES.iterdir()} == {
        f"{name}-{theme}.png" for name in NAMES for theme in ("dark", "light")
    }
    assert sum(path.stat().st_size for path in PICTURES.iterdir()) < 100_000
