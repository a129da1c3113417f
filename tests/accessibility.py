"""Faults of accessibility that axe-core finds in pages, and the contrast of colours."""

import re
from pathlib import Path

import numpy as np
import pytest

from waiting import resize

FOLDER = Path(__file__).parent / "npm"
"""Has the package.json and the lock with axe-core's version."""

FINDS = """async () => {
  const { violations } = await axe.run(document, { resultTypes: ["violations"] });
  const grave = violations.filter(({ impact }) => impact === "serious" || impact === "critical");
  const text = (id) => ({ html, failureSummary: why }) => `${id}: ${html.slice(0, 160)}: ${why}`;
  return grave.flatMap(({ id, nodes }) => nodes.map(text(id)));
}"""
"""Describes what axe-core calls serious or critical, a text for each place in the document."""

STYLES = [(1440, 900, "light"), (390, 844, "dark"), (1440, 900, "dark"), (390, 844, "light")]
"""Windows of a desktop and of a phone, px, and colour schemes."""


def axe_core():
    """Return the source of axe-core, or skip the test if it is not installed."""
    source = FOLDER / "node_modules" / "axe-core" / "axe.min.js"
    if not source.exists():
        pytest.skip("axe-core is not installed: npm ci --prefix tests/npm")
    return source.read_text()


def grave_faults(tab):
    """Return what axe-core calls serious or critical in the document of a tab and in its frames.

    `Frame.evaluate` is no subject of the pages' policies, which forbid scripts from elsewhere.
    """
    source = axe_core()
    found = []
    for frame in tab.frames:
        frame.wait_for_load_state()
        if not frame.locator("body > *").count():  # a frame that the page has not filled yet
            continue
        frame.evaluate(f"{source}\n;void 0")
        found += frame.evaluate(FINDS)
    return found


def grave_faults_in_all_styles(tab):
    """Return the same for every window and scheme of `STYLES`, after the style's name."""
    found = []
    for width, height, scheme in STYLES:
        tab.emulate_media(color_scheme=scheme)
        resize(tab, width, height)
        found += [f"{width} px, {scheme}: {fault}" for fault in grave_faults(tab)]
    return found


def numbers(color):
    """Return red, green and blue from 0 to 255 and the opacity of a computed colour, (4,)."""
    found = [float(number) for number in re.findall(r"[\d.]+", color)]
    return np.array([*found, 1.0][:4])


def contrast(one, other):
    """Return the contrast ratio of WCAG 2 of two colours, red, green and blue from 0 to 255."""
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


def _luminance(color):
    value = np.asarray(color) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4) @ (
        0.2126,
        0.7152,
        0.0722,
    )
