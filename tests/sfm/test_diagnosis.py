"""The cause of missing poses follows from measured numbers, and photos with little texture are searched again."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from gsplat_edu.cli.main import main
from gsplat_edu.sfm.diagnosis import FEW_FEATURES, Evidence, diagnosis, evidence, texture
from lab.captures.textured_box import box_orbit, photograph_box
from sfm.databases import write_database, write_photos

GOOD = Evidence(16, 16, 900, 120, 100, 60, 0.1, 0.2, 1.0)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"features": 73},
            "73 features a photo, 100 of 120 pairs match with 60 inliers (medians): the subject has",
        ),
        ({"features": 73, "blank": 0.8}, "80 % of a photo is blank"),
        ({"features": 73, "blank": 0.8, "edge": 4.0}, "the photos are blurred (edges are 4.0 px wide)"),
        ({"features": 73, "flat": 0.9}, "little texture"),
        ({"matching": 5}, "overlap too little"),
        ({"connected": 4}, "overlap too little"),
        ({"flat": 0.7}, "70 % of them without parallax: photos from one spot"),
        ({}, "things that move, repeat or mirror"),
    ],
)
def test_the_cause_is_the_first_that_the_numbers_name(change, says):
    said = diagnosis(replace(GOOD, **change))
    assert says in said and "\n" not in said
    assert ("one spot" in said) == (change == {"flat": 0.7})


def test_the_numbers_come_from_the_database_and_the_photos(tmp_path):
    write_database(tmp_path / "database.db", [10, 20, 90], [(14, 3), (30, 4), (50, 3)])
    write_photos(tmp_path / "photos", 3)
    photos = sorted((tmp_path / "photos").iterdir())
    found = evidence(tmp_path, photos, 3)
    assert (found.photos, found.connected, found.features, found.tried) == (3, 3, 20, 3)
    assert (found.matching, found.inliers, found.flat) == (2, 40, 0.5), "14 matches connect no pair"
    assert found.blank == 1.0 and found.edge == 0.0


@pytest.mark.parametrize("sigma", [1.5, 3.0, 5.0])
def test_the_width_of_edges_is_that_of_the_blur(sigma):
    """Edges between halves of 32 px, blurred by a Gaussian; finite differences widen an edge by less than 10 %."""
    grey = np.tile(np.repeat([60.0, 180.0], 32), (128, 4)).astype(np.float32)
    grey = cv2.GaussianBlur(grey, (0, 0), sigma)
    blank, edge = texture(grey)
    assert edge == pytest.approx(sigma, rel=0.2) and blank < 1.0


def faint(camera):
    """Return a photo of the box with 6 % of its contrast: at most some 16 grey values."""
    return np.round(128 + 0.06 * (photograph_box(camera).astype(np.float32) - 128)).astype(np.uint8)


@pytest.mark.usefixtures("colmap")
def test_faint_photos_are_searched_again_and_few_poses_are_no_success(tmp_path, capsys):
    """Nine photos show the box, ten others have nothing in common: those of the box get poses and are kept."""
    (tmp_path / "photos").mkdir()
    rng = np.random.default_rng(0)
    noise = [cv2.GaussianBlur(rng.normal(0.0, 1.0, (240, 320, 3)), (0, 0), 2.0) for _ in range(10)]
    others = [np.round(128 + 60 * values).astype(np.uint8) for values in noise]
    for i, photo in enumerate([faint(camera) for camera in box_orbit(28)[:4] + box_orbit(6)[1:]] + others):
        Image.fromarray(photo).save(tmp_path / "photos" / f"{i:02}.png")
    words = ["sfm", str(tmp_path / "photos"), str(tmp_path / "out"), "--threads", "1"]
    assert main(words) == 2
    printed = capsys.readouterr()
    said = printed.out.replace("\n", " ")
    assert f"9 of 19 photos have fewer than {FEW_FEATURES} features; searching them again" in said
    stages = json.loads((tmp_path / "out" / "sfm" / "stages.json").read_text())["stages"]
    copies = [f"{i:06}.jpg" for i in range(9)]
    assert stages["features"]["facts"]["few"] == copies
    before, after = (
        int(stages[name]["facts"]["summary"].split(" in ")[0].replace(",", ""))
        for name in ("features", "more features")
    )
    assert after - before > 9 * FEW_FEATURES, "those of the other photos are kept"
    assert set(stages["mapping"]["facts"]["names"]) <= set(copies)
    count = len(stages["mapping"]["facts"]["names"])
    assert f"only {count} of 19 photos have a pose; " in printed.err and printed.err.count("\n") == 1
    assert "one spot" not in printed.err and (tmp_path / "out" / "sparse" / "0").is_dir()
    assert main(words) == 2, "a repeated command says the same"
    again = capsys.readouterr()
    assert again.err == printed.err and again.out.count("(done before)") == 6
