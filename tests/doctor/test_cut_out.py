"""`--outside-masks auto` tells masks that cut out an object from masks that hide something in front of a scene."""

import json

import numpy as np
import pytest

from gsplat_edu.cli.main import main
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.parts.empty_outside.findings import outside_masks_for, shape_of
from gsplat_edu.scene.views import View
from masked_object import masked_object

H, W, N = 72, 96, 10
V, U = np.mgrid[:H, :W]


def objects(i):
    """Cut out a blob that moves and grows."""
    return np.hypot(U - 40 - i, 1.3 * (V - 36)) < 18 + i


def person(i):
    """Cut out a person who stands on the lower edge of the photo."""
    return (abs(U - 40 - i) < 12) & (V > 15)


def passer_by(i):
    return ~((abs(U - 8 * i) < 8) & (V > 20))


def tripod(i):
    return 54 - i % 2 > V


def sky(i):
    return 30 + i < V


def lens(i):
    """Hide the dark rim of a fisheye, equal in every photo."""
    return np.hypot(U - 48, V - 36) < 35


def confetti(i):
    return np.random.default_rng(i).random((H, W)) < 0.3


def test_every_side_of_the_border_counts():
    band = np.zeros((40, 40), dtype=bool)
    band[:5] = True  # one side, and four more pixels of each of two others
    for turns in range(4):
        assert shape_of(np.rot90(band, turns)).border == pytest.approx(48 / 156)


@pytest.mark.parametrize(
    ("mask", "choice"),
    [
        (objects, "empty"),
        (person, "empty"),
        (passer_by, "ignore"),
        (tripod, "ignore"),
        (sky, "ignore"),
        (lens, "ignore"),
        (confetti, "ignore"),
    ],
)
def test_the_shape_of_the_masks_decides(mask, choice):
    found = outside_masks_for([mask(i) for i in range(N)], N)
    assert found.value == choice and found.reason


def test_masks_of_too_few_photos_do_not_cut_out_an_object():
    masks = [objects(i) for i in range(N)]
    assert outside_masks_for(masks, N + 1).value == "empty"
    assert outside_masks_for(masks, N + 3).value == "ignore"
    assert outside_masks_for([], N).reason == ""


@pytest.mark.parametrize("cut_out", [True, False])
def test_train_and_doctor_say_what_happens_outside(tmp_path, capsys, cut_out):
    views, points, colors = masked_object(32, 12)
    if not cut_out:
        hidden = [np.ones(view.image.shape[:2], bool) for view in views]
        for i, mask in enumerate(hidden):
            mask[10:20, 2 + i : 6 + i] = False
        views = [View(v.camera, v.image, mask=m, name=v.name) for v, m in zip(views, hidden, strict=True)]
    write_colmap(tmp_path / "capture", views, points, colors)
    choice = "empty" if cut_out else "ignore"
    words = ["train", str(tmp_path / "capture"), "--out", str(tmp_path / "run"), "--iterations", "3"]
    assert main(words) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"--outside-masks {choice}: {12 if cut_out else 0} of 12 masks cut out an object" in said
    assert json.loads((tmp_path / "run" / "config.json").read_text())["train"]["outside_masks"] == choice
    assert main(["doctor", str(tmp_path / "capture")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"(--outside-masks {choice}, which auto chooses" in said
    assert main([*words[:-1], "5", "--resume"]) == 0
    assert main([*words, "--resume", "--outside-masks", "empty" if choice == "ignore" else "ignore"]) == 2
    assert main([*words[:3], str(tmp_path / "other"), "--iterations", "3", "--outside-masks", "nothing"]) == 2
    assert "--outside-masks" in capsys.readouterr().err
