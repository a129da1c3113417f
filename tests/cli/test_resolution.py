"""`--resolution auto`: photos are reduced to what the planned Gaussians resolve, if they are much larger."""

import json

import pytest

from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.doctor.before import examine
from gsplat_edu.survey.capture import prepare
from gsplat_edu.train import capacity
from gsplat_edu.train.capacity import PIXELS_PER_GAUSSIAN, advised_side, resolvable_pixels, wanted_gaussians
from gsplat_edu.train.config import recipe


@pytest.mark.parametrize("views", [18, 85, 300])
def test_the_plan_has_enough_gaussians_for_the_chosen_size(views):
    pixels = resolvable_pixels(views)
    planned = wanted_gaussians(recipe(3_000, strategy="fast", max_gaussians=9), 9, pixels, views)
    assert planned * PIXELS_PER_GAUSSIAN == pytest.approx(pixels, rel=1e-4)


def test_only_photos_much_larger_than_resolvable_are_reduced():
    """The photos of `snowmiku97` and `fox` keep their size, 13 megapixels do not; fewer photos resolve fewer pixels."""
    assert advised_side([(990, 742)] * 97, 85) is None
    assert advised_side([(1080, 1920)] * 50, 44) is None
    side = advised_side([(4160, 3120)] * 85, 85)
    assert 1_500 < side < 2_000 and side % 10 == 0
    assert advised_side([(4160, 3120)] * 18, 16) < side < advised_side([(4160, 3120)] * 200, 175)


def test_train_chooses_a_size_and_doctor_advises_the_option(tmp_path, capsys, monkeypatch):
    views, points, colors = procedural_capture(128, 6, splats=60)
    write_colmap(tmp_path / "capture", views, points, colors)
    words = ["train", str(tmp_path / "capture"), "--iterations", "2", "--resolution", "auto", "--out"]
    stored = lambda run: json.loads((tmp_path / run / "config.json").read_text())["data"]["resolution"]  # noqa: E731
    assert main([*words, str(tmp_path / "whole")]) == 0
    assert "--resolution auto: photos of up to 128x96 keep their size" in capsys.readouterr().out
    assert stored("whole") is None
    monkeypatch.setattr(capacity, "PIXELS_PER_GAUSSIAN", 0.1)  # small photos now count as large ones
    assert main([*words, str(tmp_path / "small")]) == 0
    side = int(stored("small"))
    assert 40 <= side < 100
    assert f"--resolution {side}: the planned Gaussians do not resolve more" in capsys.readouterr().out
    assert main([*words, str(tmp_path / "small"), "--resume"]) == 0
    survey = prepare(CaptureReader(tmp_path / "capture"))
    (found,) = [one for one in examine(survey).findings if one.name == "resolution"]
    assert "--resolution auto" in found.advice
    assert "--resolution auto --out" in examine(survey).otherwise[0].text, "the advised command"
    given = examine(survey, ("--resolution", "2")).otherwise[0].text
    assert "--resolution 2 --out" in given and "auto" not in given
    assert main([*words, str(tmp_path / "blocks"), "--blocks", "2"]) == 2
    assert "--resolution auto: is for trainings in one piece" in capsys.readouterr().err
