"""In Chromium, photos that are not placed yet: whether they are enough, sharp, equally bright and near enough."""

import re

import cv2
import numpy as np
import pytest

from gsplat_edu.doctor.files import USUAL
from gsplat_edu.sfm.source import expected_seconds
from studio.pages import go

BLURRED = "photo_04.jpg"


def photographs(folder, count):
    """Write photos of one wall from places side by side; the fifth is out of focus."""
    wall = np.random.default_rng(3).integers(0, 255, (75, 150, 3), dtype=np.uint8)
    wall = cv2.resize(wall, (1500, 750), interpolation=cv2.INTER_NEAREST)
    folder.mkdir(parents=True)
    for i in range(count):
        photo = wall[:600, 20 * i : 20 * i + 800]
        name = f"photo_{i:02d}.jpg"
        cv2.imwrite(str(folder / name), cv2.GaussianBlur(photo, (0, 0), 8) if name == BLURRED else photo)


def test_the_screen_of_photos_says_how_many_are_usual_and_which_are_blurred(visitor, library):
    photographs(library[0].library.root / "photos" / "wall", 14)
    tab = go(visitor().tab, "photos/wall")
    said = tab.get_by_role("status").filter(has_text="are usual")
    said.wait_for()
    assert said.inner_text().startswith(
        f"14 photos; {USUAL[0]} to {USUAL[1]} are usual. Each shares enough with the next one"
    )
    (finding,) = tab.locator(".findings li").all_inner_texts()
    assert re.match(r"1 of 14 photos show less detail .*first photo_04\.jpg", finding, re.DOTALL)
    assert tab.locator(".thumbs .mark:not(:empty)").all_inner_texts() == ["blurred"]


def test_the_next_step_says_roughly_how_long_placing_takes(visitor, library):
    folder = library[0].library.root / "photos" / "timed"
    photographs(folder, 14)
    tab = go(visitor().tab, "photos/timed")
    takes = tab.locator(".next-step .quiet", has_text=re.compile("^takes roughly"))
    takes.wait_for()
    unit = {"s": 1, "min": 60}
    number, named = takes.inner_text().split()[-2:]
    assert int(number) * unit[named] == pytest.approx(
        expected_seconds(folder), abs=max(0.5 * unit[named], 1.0)
    )
    tab.locator("summary", has_text="More").click()
    tab.get_by_label("the same poses to the bit").check()
    takes.wait_for(state="detached")


def test_few_photos_that_are_sharp(visitor, library):
    photographs(library[0].library.root / "photos" / "few", 4)
    tab = go(visitor().tab, "photos/few")
    tab.get_by_role("status").filter(has_text="None is blurred").wait_for()
    (finding,) = tab.locator(".findings li").all_inner_texts()
    assert "4 photos are few: the scene between them is guessed.\n\nTake more photos: at least 12" in finding


def test_a_gap_in_the_order_of_the_photos_is_said(visitor, library):
    folder = library[0].library.root / "photos" / "gap"
    photographs(folder, 14)
    other = cv2.resize(np.random.default_rng(8).integers(0, 255, (75, 100, 3), dtype=np.uint8), (800, 600))
    for i in range(14, 17):
        cv2.imwrite(str(folder / f"photo_{i}.jpg"), np.roll(other, 40 * i, axis=1))
    tab = go(visitor().tab, "photos/gap")
    said = tab.get_by_role("status").filter(has_text="are usual")
    said.wait_for()
    assert "shows once they are placed" not in said.inner_text()
    (finding,) = tab.locator(".findings li", has_text="shares too little").all_inner_texts()
    assert finding.startswith(
        "1 place where a photo shares too little with the next one, first photo_13.jpg with photo_14.jpg."
    )
    assert "\n\nLeave it if other photos show what both show; otherwise take two or three photos" in finding
    weights = (
        "[...document.querySelectorAll('.findings li p')].map((one) => getComputedStyle(one).fontWeight)"
    )
    assert tab.evaluate(weights)[:2] == ["600", "400"], "what was found stands out from the advice"


def test_the_usual_number_is_that_of_the_tour(request):
    tour = (request.config.rootpath / "docs" / "TOUR.md").read_text("utf-8")
    assert f"{USUAL[0]} to {USUAL[1]} photos are a good start" in tour
