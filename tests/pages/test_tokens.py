"""The tokens of all pages: contrasts of what is read and seen, and no colour beside them."""

import re
from pathlib import Path

import pytest

import gsplat_edu
from gsplat_edu.base.styles import components, sheet, tokens, tokens_by_theme
from gsplat_edu.evaluate.report import STYLE

PACKAGE = Path(gsplat_edu.__file__).parent

REPOSITORY = Path(__file__).parents[2]

RULE = re.compile(r"([^{}]+)\{([^{}]*)\}")

COLOR = re.compile(r"#[0-9a-fA-F]{3,8}\b|\brgba?\(|\bhsla?\(")

GROUNDS = ("background", "surface", "raised")

TEXTS = {
    **dict.fromkeys(("text", "quiet"), GROUNDS),
    "accent": ("background", "surface"),
    "on-accent": ("accent",),
    "on-danger": ("danger",),
    "background": ("text",),
    **{tone: (f"{tone}-sheet", "background", "surface") for tone in ("good", "fair", "poor")},
}
"""Grounds on which a token is read as text."""

SHEETS = ("good-sheet", "fair-sheet", "poor-sheet", "accent-sheet")
"""Grounds of banners and badges, with ordinary text."""

SEEN = {
    **dict.fromkeys(
        ("edge", "accent", "danger", *(f"series-{i}" for i in range(1, 7))), ("background", "surface")
    ),
    "focus": GROUNDS,
    **{tone: (f"{tone}-sheet",) for tone in ("good", "fair", "poor")},
}
"""Grounds on which a token is a line, a bar or a mark."""


def values_of(text, selector, scheme=None):
    """Return the custom properties that a selector sets, in a colour scheme; later ones win, as in a browser."""
    light = re.search(r"@media \(prefers-color-scheme: light\) \{(.*?)\n\}", text, re.DOTALL)
    rest = text.replace(light[0], "")
    blocks = RULE.findall(
        re.sub(r"@media[^{]*\{[^{}]*\{[^{}]*\} \}", "", re.sub(r"/\*.*?\*/", "", rest, flags=re.DOTALL))
    )
    if scheme == "light":
        blocks += RULE.findall(light[1])
    found = {}
    for names, body in blocks:
        if selector in (name.strip() for name in names.split(",")):
            found.update(re.findall(r"--([\w-]+):\s*([^;]+);", body))
    return found


def rgba(value):
    digits = value.removeprefix("#")
    assert len(digits) in (6, 8), value
    return [int(digits[i : i + 2], 16) / 255 for i in range(0, len(digits), 2)]


def over(color, ground):
    """Return a colour that may be transparent, on an opaque ground."""
    *channels, alpha = [*rgba(color), 1.0][:4]
    return [alpha * c + (1 - alpha) * g for c, g in zip(channels, ground, strict=True)]


def luminance(color):
    """WCAG 2.2, relative luminance."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in color]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one, other):
    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_every_text_and_mark_stands_out_from_its_ground(scheme):
    found = values_of(tokens(), ":root", scheme)
    pairs = [(text, ground, 4.5) for text, grounds in TEXTS.items() for ground in grounds]
    pairs += [("text", ground, 4.5) for ground in SHEETS]
    pairs += [(mark, ground, 3.0) for mark, grounds in SEEN.items() for ground in grounds]
    measured = {(a, b): (contrast(rgba(found[a]), rgba(found[b])), least) for a, b, least in pairs}
    low = {pair: round(ratio, 2) for pair, (ratio, least) in measured.items() if ratio < least}
    assert low == {}
    # a new colour belongs into one of the tables
    unchecked = {name for name, value in found.items() if re.fullmatch("#[0-9a-f]{6}", value)}
    unchecked -= {name for pair in measured for name in pair}
    assert unchecked <= {"line", "stage", "mask", "halo", "on-glass", "paper"}


@pytest.mark.parametrize("scene", ["#ffffff", "#7f7f7f", "#000000"])
def test_text_on_glass_is_legible_over_every_scene(scene):
    found = values_of(tokens(), ":root") | values_of(tokens(), ".glass")
    found = {
        name: found.get(value[6:-1], value) if value.startswith("var(") else value
        for name, value in found.items()
    }
    ground = over(found["glass"], rgba(scene))
    raised = over(found["raised"], ground)
    for text in ("text", "quiet", "good", "fair", "accent"):
        assert contrast(rgba(found[text]), ground) >= 4.5, text
    assert contrast(rgba(found["text"]), raised) >= 4.5
    for mark in ("edge", "focus", "accent"):
        assert contrast(rgba(found[mark]), ground) >= 3, mark


def test_both_themes_set_the_same_colours():
    light = re.search(r"prefers-color-scheme: light\) \{\s*:root \{(.*?)\n  \}", tokens(), re.DOTALL)[1]
    dark = re.search(r":root, \.glass \{(.*?)\n\}", tokens(), re.DOTALL)[1]
    names = [set(re.findall(r"--([\w-]+):", block)) for block in (light, dark)]
    assert names[0] == names[1]


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_a_reader_of_the_site_may_choose_either_theme(theme):
    chosen = values_of(tokens_by_theme(), f'body[data-theme="{theme}"]')
    usual = values_of(tokens(), ":root", theme)
    assert chosen and {name: usual[name] for name in chosen} == chosen
    assert chosen["text"] != values_of(tokens(), ":root", "light" if theme == "dark" else None)["text"]


SHEETS_OF_PAGES = {
    "components": "".join(components().values()),
    "report": STYLE.replace(tokens(), ""),
    "site": (REPOSITORY / "docs" / "site" / "static" / "site.css").read_text("utf-8"),
    "studio": (PACKAGE / "studio" / "web" / "style.css").read_text("utf-8"),
}
"""Style sheets by their pages, without the tokens."""


@pytest.mark.parametrize("page", SHEETS_OF_PAGES)
def test_a_page_has_no_colours_beside_the_tokens_and_names_only_known_ones(page):
    text = re.sub(r"/\*.*?\*/", "", SHEETS_OF_PAGES[page], flags=re.DOTALL)
    assert COLOR.findall(text) == []
    known = set(re.findall(r"--([\w-]+):", tokens() + text))
    set_by_scripts = {"cut", "ratio"}
    assert set(re.findall(r"var\(--([\w-]+)", text)) <= known | set_by_scripts


def test_a_sheet_has_the_components_that_are_asked_for_and_no_others():
    text = sheet("banner", "page")
    assert text.startswith(tokens()) and ".banner" in text and ".segments" not in text
    assert text.index("body {") < text.index(".banner {")  # in the order of the file, so that later rules win
    with pytest.raises(KeyError):
        sheet("no such component")
