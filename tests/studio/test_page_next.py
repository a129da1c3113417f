"""In Chromium, from dropped photos to a shared page by nothing but the button for the next step."""

import io
import os
import re
import time
from pathlib import Path
from urllib.parse import quote

import pytest
from PIL import Image

from lab.captures.textured_box import box_orbit, photograph_box
from studio.pages import BY_DAY, DROP, encoded, go
from waiting import resize, until_in

NEXT = re.compile("^Next: ")

SIZES = ((390, 844), (1440, 900))

CONTROLS = "[...document.querySelectorAll('.timeline a, .next-step .button, .project a, .project summary')]"

CONTRASTS = f"""(() => {{
  const light = (color) => {{
    const [r, g, b] = color.match(/[\\d.]+/g).map(Number).map((c) => c / 255)
      .map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  }};
  const ground = (element) => {{
    for (let at = element; at; at = at.parentElement) {{
      const {{ backgroundColor: color }} = getComputedStyle(at);
      if (!/, 0\\)$/.test(color) && color !== 'transparent') return color;
    }}
    return 'rgb(255, 255, 255)';
  }};
  const texts = {CONTROLS}.concat([...document.querySelectorAll('.timeline span, .project .quiet')]);
  return texts.filter((one) => one.checkVisibility()).map((one) => {{
    const [a, b] = [light(getComputedStyle(one).color), light(ground(one))].sort((x, y) => y - x);
    return [one.textContent, (a + 0.05) / (b + 0.05)];
  }});
}})()"""
"""Contrast of the texts of timelines, next steps and projects, as WCAG 2 defines it."""


def next_of(tab):
    return tab.get_by_role("link", name=NEXT).or_(tab.get_by_role("button", name=NEXT))


def press_next(tab, label, patience=180):
    """Wait until the next step has a label, check that it is the only primary button, and press it."""
    button = next_of(tab)
    button.filter(has_text=label).wait_for(timeout=1000 * patience)
    assert button.count() == 1
    primary = "[...document.querySelectorAll('main .primary')].filter((one) => one.checkVisibility())"
    assert tab.evaluate(f"{primary}.map((one) => one.textContent)") == [f"Next: {label}"]
    check_access(tab, label)
    button.click()


def check_access(tab, label):
    """On a phone and a wide screen, in both colour schemes: contrasts, sizes of targets, nothing beside the screen."""
    before = tab.viewport_size
    for width, height in SIZES:
        resize(tab, width, height)
        assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth"), (label, width)
        small = (
            f"{CONTROLS}.filter((one) => one.checkVisibility() && one.getBoundingClientRect().height < 24)"
        )
        assert tab.evaluate(f"{small}.map((one) => one.textContent)") == [], (label, width)
        for scheme in ("light", "dark"):
            tab.emulate_media(color_scheme=scheme, reduced_motion="reduce")
            low = [pair for pair in tab.evaluate(CONTRASTS) if pair[1] < 4.5]
            assert low == [], (label, width, scheme)
            if folder := os.environ.get("SHOTS"):
                name = re.sub(r"\W+", "_", f"{label}_{width}_{scheme}")
                tab.screenshot(path=str(Path(folder) / f"{time.time():.0f}_{name}.png"))
    tab.emulate_media(color_scheme=None, reduced_motion=None)
    resize(tab, before["width"], before["height"])
    ids = "[...document.querySelectorAll('[id]')].map(({ id }) => id)"
    assert tab.evaluate(f"{ids}.length - new Set({ids}).size") == 0
    is_home = tab.evaluate("location.hash").strip("#/") == ""
    assert tab.locator(".timeline [aria-current=step]").count() == (0 if is_home else 1)


def shared_page(person, name, folder, patience):
    """From the screen of a training, by the next steps alone, to the file of its page, saved into a folder."""
    tab = person.tab
    press_next(tab, "Share it", patience)
    person.reach(f"#/runs/{quote(name)}/share")
    press_next(tab, "Make the file")
    with tab.expect_download() as download:
        press_next(tab, f"Save {name}.html")
    filled = "(one) => one.querySelector('progress').offsetWidth === one.clientWidth"
    assert tab.locator(".job .progress").first.evaluate(filled)  # what is done does not look half done
    assert download.value.suggested_filename == f"{name}.html"
    saved = folder / f"{name}.html"
    download.value.save_as(saved)  # the browser's own copy has no ending
    return saved


def test_from_dropped_photos_to_a_shared_page_by_next_alone(visitor, library, tmp_path):
    pytest.importorskip("pycolmap")
    files = []
    for index, camera in enumerate(box_orbit(14)):
        data = io.BytesIO()
        Image.fromarray(photograph_box(camera)).save(data, format="PNG")
        files.append([f"box_{index:02d}.png", encoded(data.getvalue())])
    person = visitor()
    tab = person.tab
    said = []
    tab.on("console", lambda message: said.append((message.type, message.text, message.location.get("url"))))
    tab.evaluate(DROP, [files, ".drop"])
    person.reach(f"#/photos/{quote(BY_DAY)}")

    press_next(tab, "Place the photos")
    go(tab, "")
    press_next(tab, "Look at the cameras", 240)
    person.reach(f"#/captures/{quote(BY_DAY)}")
    press_next(tab, "Start training")
    person.reach(f"#/runs/{quote(BY_DAY)}")
    saved = shared_page(person, BY_DAY, tmp_path, 600)

    go(tab, "")
    tab.locator(".project").first.wait_for()
    assert tab.locator(".project").count() == 1
    check_access(tab, "Library")
    press_next(tab, "Share it")
    person.reach(f"#/runs/{quote(BY_DAY)}/share")
    page = tab.context.new_page()
    page.goto(saved.as_uri())
    until_in(page, page, "Boolean(window.viewer?.isWhole)")
    assert said == []
