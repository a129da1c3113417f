"""The choices of `--appearance auto` and `--sky auto`, and their reasons."""

import numpy as np
import pytest

from doctor.rooms import replaced, room, with_photo
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.writers import write_blender, write_colmap
from gsplat_edu.doctor.remedies import remedies_for
from gsplat_edu.parts.transients.findings import transients_for
from gsplat_edu.scene.views import View
from gsplat_edu.survey.capture import Undecided
from lab.captures.outdoors import outdoor_capture


def written(folder, views, points):
    write_colmap(folder, views, points, np.full((len(points), 3), 0.5))
    return folder


def chosen_for(path, *names):
    return remedies_for(Undecided(CaptureReader(path), DataSettings()), names)


def appearance_for(path):
    return chosen_for(path, "appearance")["appearance"]


def brighter(view, stops):
    return with_photo(view, view.image * 2.0 ** (stops / 2.2))


def test_photos_of_equal_exposure_are_not_corrected(tmp_path):
    remedy = appearance_for(written(tmp_path, *room("orbit", 160)))
    assert (remedy.value, remedy.reason) == ("none", "")


def test_wandering_exposures_are_corrected(tmp_path):
    views, points = room("orbit", 160)
    rng = np.random.default_rng(2)
    spoiled = {
        i: brighter(view, s)
        for i, (view, s) in enumerate(zip(views, rng.uniform(-0.7, 0.7, len(views)), strict=True))
    }
    remedy = appearance_for(written(tmp_path, replaced(views, spoiled), points))
    assert remedy.value == "exposure"
    assert "photos differ in brightness or tint from neighbours that see the same" in remedy.reason


def test_a_single_dark_photo_is_not_corrected(tmp_path):
    views, points = room("orbit", 160)
    remedy = appearance_for(written(tmp_path, replaced(views, {4: brighter(views[4], -0.7)}), points))
    assert remedy.value == "none"


def test_transparent_photos_are_not_corrected(tmp_path):
    views, _ = room("orbit", 64)
    rng = np.random.default_rng(2)
    uneven = []
    for view in views:
        alpha = np.full(view.image.shape[:2], 255, np.uint8)
        alpha[0] = 0
        image = brighter(view, rng.uniform(-0.7, 0.7)).image
        uneven.append(View(view.camera, image, alpha=alpha, name=view.name.removesuffix(".png")))
    write_blender(tmp_path, uneven, uneven[:1])
    assert appearance_for(tmp_path).value == "none"


def test_one_photo_alone_cannot_be_compared(tmp_path):
    views, points = room("orbit", 64)
    assert appearance_for(written(tmp_path, views[:1], points)).value == "none"


@pytest.mark.parametrize(("count", "value"), [(5, "none"), (11, "none"), (12, "mask"), (300, "mask")])
def test_transients_are_masked_if_there_are_enough_photos(count, value):
    remedy = transients_for(count)
    assert remedy.value == value and f"{count} training photos" in remedy.reason


def test_a_sky_gets_a_shell_and_its_colours_on_a_dome_do_not(tmp_path):
    for name, dome in (("sky", np.inf), ("dome", 10.0)):
        made = outdoor_capture(96, 72, 16, points=800, dome=dome)
        remedies = chosen_for(written(tmp_path / name, made.views, made.points), "appearance", "sky")
        assert remedies["appearance"].value == "none"
        assert remedies["sky"].value == {"sky": "shell", "dome": "none"}[name]
        assert ("lie at infinity" in remedies["sky"].reason) == (name == "sky")


def test_the_reason_says_that_a_sky_is_plain_white(tmp_path):
    made = outdoor_capture(96, 72, 16, points=800, clouds=0.0)
    remedy = chosen_for(written(tmp_path, made.views, made.points), "sky")["sky"]
    assert remedy.value == "shell" and remedy.reason.endswith("are one white above the horizon")
