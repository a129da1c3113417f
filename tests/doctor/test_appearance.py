"""Faults of the pixels, each at three severities: the slightest passes, the others are reported and nothing else is."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from doctor.rooms import replaced, room, with_camera, with_photo
from gsplat_edu.scene.views import View

SPOILED = (4, 13)
"""Views that faults are planted in."""


def motion_blurred(image, length, degrees):
    """Blur by motion while the shutter is open: the mean along a line of `length` px."""
    a, offsets = np.radians(degrees), np.linspace(-length / 2, length / 2, 4 * length + 1)
    v, u = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    moved = [
        cv2.remap(
            image.astype(np.float32),
            u + np.float32(t * np.cos(a)),
            v + np.float32(t * np.sin(a)),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )
        for t in offsets
    ]
    return np.mean(moved, axis=0)


def changed(views, change):
    """Change the photos of the views SPOILED; return all views and the names of the changed ones."""
    spoiled = {i: with_photo(views[i], change(views[i].image.astype(np.float64))) for i in SPOILED}
    return replaced(views, spoiled), {views[i].name for i in SPOILED}


@pytest.mark.parametrize("degrees", [0, 90, 35])
@pytest.mark.parametrize(("length", "is_named"), [(2, False), (10, True), (20, True)])
def test_motion_blur(named, length, degrees, is_named):
    views, points = room("forward", 256)
    spoiled, names = changed(views, lambda image: motion_blurred(image, length, degrees))
    found = named(spoiled, points)
    assert set(found.get("blurred", ())) == (names if is_named else set())
    assert set(found) <= {"blurred"}


@pytest.mark.parametrize(("sigma", "is_named"), [(0.4, False), (2.0, True), (4.0, True)])
def test_a_photo_out_of_focus(named, sigma, is_named):
    views, points = room("orbit", 256)
    spoiled, names = changed(views, lambda image: cv2.GaussianBlur(image, (0, 0), sigma))
    assert set(named(spoiled, points).get("blurred", ())) == (names if is_named else set())


@pytest.mark.parametrize("contrast", [0.5, 0.2])
def test_a_dull_photo_is_not_blurred(named, contrast):
    """The measure of detail falls with the square of the contrast, but low contrast is not blur."""
    views, points = room("forward", 256)
    spoiled, _ = changed(views, lambda image: 128 + contrast * (image - 128))
    assert "blurred" not in named(spoiled, points)


@pytest.mark.parametrize("with_points", [True, False])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("stops", "is_named"), [(0.15, False), (0.9, True), (1.8, True)])
def test_exposure(named, stops, sign, is_named, with_points):
    views, points = room("forward")
    spoiled, names = changed(views, lambda image: image * 2.0 ** (sign * stops / 2.2))
    found = named(spoiled, points if with_points else None)
    jumps = {text.removeprefix("images/").split(" (")[0]: text for text in found.get("exposure", ())}
    assert set(jumps) == (names if is_named else set())
    assert set(found) <= {"exposure"}
    for text in jumps.values():
        # At most a fifth of a small jump is lost, because pixels that are clipped or have no known depth do not
        # count.
        measured = float(text.partition("(")[2].rstrip(")"))
        assert measured == pytest.approx(sign * stops, rel=0.2 if stops < 1 else 0.4)


@pytest.mark.parametrize(
    "which", [range(3, 7), range(12), range(0, 24, 2)], ids=["four", "half", "every second"]
)
@pytest.mark.parametrize(("stops", "is_named"), [(0.1, False), (0.9, True), (1.5, True)])
def test_photos_that_are_dark_in_a_row(named, which, stops, is_named):
    """The dark photos agree with one another, but many neighbours differ from them."""
    views, points = room("orbit")
    dark = {i: with_photo(views[i], views[i].image * 2.0 ** (-stops / 2.2)) for i in which}
    assert ("exposure" in named(replaced(views, dark), points)) == is_named


@pytest.mark.parametrize(("stops", "is_named"), [(0.1, False), (0.7, True), (1.4, True)])
@pytest.mark.parametrize("channel", [0, 2])
def test_white_balance(named, channel, stops, is_named):
    views, points = room("orbit", 160)
    gains = np.ones(3)
    gains[channel] = 2.0 ** (-stops / 2.2)
    spoiled, names = changed(views, lambda image: image * gains)
    found = named(spoiled, points)
    assert set(found.get("white balance", ())) == (names if is_named else set())


def reencoded(image, quality):
    buffer = io.BytesIO()
    Image.fromarray(image.astype(np.uint8)).save(buffer, "JPEG", quality=quality)
    return np.array(Image.open(buffer))


DUPLICATES = {
    "moved by 8 px": (lambda image: np.roll(image, 8, axis=1), False),
    "written again": (lambda image: reencoded(image, 85), True),
    "the same": (lambda image: image, True),
}


@pytest.mark.parametrize("how", DUPLICATES)
def test_duplicated_photos(named, how):
    """Photo 9 is replaced by photo 8, once with photo 9's pose and once with photo 8's."""
    views, points = room("orbit", 160)
    change, is_named = DUPLICATES[how]
    copy = with_photo(views[9], change(views[8].image))
    expected = (f"{views[8].name} and {views[9].name}",) if is_named else ()
    assert named(replaced(views, {9: copy}), points).get("same photo", ()) == expected
    at_one_place = with_camera(copy, R=views[8].camera.R, eye=views[8].camera.eye)
    found = named(replaced(views, {9: at_one_place}), points)
    assert found.get("duplicates", ()) == expected and "same photo" not in found


@pytest.mark.parametrize(("distance", "is_named"), [(0.05, False), (1e-5, True), (0.0, True)])
def test_two_photos_with_one_pose(named, distance, is_named):
    views, points = room("orbit", 160)
    copy = with_camera(views[9], R=views[8].camera.R, eye=views[8].camera.eye + distance)
    expected = (f"{views[8].name} and {views[9].name}",) if is_named else ()
    assert named(replaced(views, {9: copy}), points).get("same pose", ()) == expected


@pytest.mark.parametrize("kind", ["alpha", "mask"])
@pytest.mark.parametrize("inside", [True, False])
def test_blur_is_judged_inside_a_cut_out(named, inside, kind):
    """Inside, blur is found although the edges of the cut-out stay sharp; outside, it does not matter."""
    views, points = room("forward", 256)
    H, W = views[0].image.shape[:2]
    y, x = np.mgrid[:H, :W]
    disc = np.hypot(x - W / 2, y - H / 2) < 0.42 * H
    plane = {"alpha": np.where(disc, 255, 0).astype(np.uint8)} if kind == "alpha" else {"mask": disc}
    photos = []
    for i, view in enumerate(views):
        image = view.image.astype(np.uint8)
        soft = cv2.GaussianBlur(image, (0, 0), 4.0)
        if i in SPOILED:
            image = np.where(disc[..., None] == inside, soft, image)
        photos.append(View(view.camera, image, name=view.name, **plane))
    found = {name.removeprefix("images/") for name in named(photos, points).get("blurred", ())}
    assert found == ({views[i].name for i in SPOILED} if inside else set())
