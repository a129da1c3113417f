"""Faults of the pixels, each at three severities: the slightest passes, the others are reported and nothing else is."""

import functools
import io
import math

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from doctor.rooms import (
    WALL,
    camera_at,
    cast,
    placed,
    rays,
    replaced,
    room,
    texture,
    with_camera,
    with_photo,
)
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.parts.exposure.findings import check_exposure, correction_of
from gsplat_edu.scene.views import View
from gsplat_edu.survey.capture import prepare

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


@pytest.mark.parametrize(
    ("length", "degrees", "is_named"), [(2, 35, False), (10, 0, True), (10, 90, True), (20, 35, True)]
)
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


def test_a_dull_photo_is_not_blurred(named):
    """The measure of detail falls with the square of the contrast, but low contrast is not blur."""
    views, points = room("forward", 256)
    spoiled, _ = changed(views, lambda image: 128 + 0.2 * (image - 128))
    assert "blurred" not in named(spoiled, points)


@pytest.mark.parametrize(
    ("stops", "sign", "with_points", "is_named"),
    [
        (0.15, 1, True, False),
        (0.9, -1, True, True),
        (0.9, 1, True, True),
        (1.8, -1, True, True),
        (1.8, 1, False, True),
    ],
)
def test_exposure(named, stops, sign, is_named, with_points):
    views, points = room("forward")
    spoiled, names = changed(views, lambda image: image * 2.0 ** (sign * stops / 2.2))
    found = named(spoiled, points if with_points else None)
    jumps = {text.removeprefix("images/").split(" (")[0]: text for text in found.get("exposure", ())}
    assert set(jumps) == (names if is_named and with_points else set()), "without points, nothing is claimed"
    assert set(found) <= {"exposure"}
    for text in jumps.values():
        # At most a fifth of a small jump is lost, because pixels that are clipped or have no known depth do not
        # count.
        measured = float(text.partition("(")[2].rstrip(")"))
        assert measured == pytest.approx(sign * stops, rel=0.2 if stops < 1 else 0.4)


@pytest.mark.parametrize(
    ("which", "stops", "is_named"),
    [(range(12), 0.1, False), (range(3, 7), 0.9, True), (range(12), 0.9, True), (range(0, 24, 2), 1.5, True)],
    ids=["slight", "four", "half", "every second"],
)
def test_photos_that_are_dark_in_a_row(named, which, stops, is_named):
    """The dark photos agree with one another, but many neighbours differ from them."""
    views, points = room("orbit")
    dark = {i: with_photo(views[i], views[i].image * 2.0 ** (-stops / 2.2)) for i in which}
    assert ("exposure" in named(replaced(views, dark), points)) == is_named


@pytest.mark.parametrize(("stops", "channel", "is_named"), [(0.1, 0, False), (0.7, 2, True), (1.4, 0, True)])
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
        photos.append(View(view.camera, image, name=f"{i:02}.png", **plane))
    found = {name.removeprefix("images/") for name in named(photos, points).get("blurred", ())}
    assert found == ({f"{i:02}.png" for i in SPOILED} if inside else set())


@functools.cache
def before_a_window():
    """Photograph a large ball in a room of which one wall is 2.5 stops brighter, as a window, at one exposure.

    Most photos show the ball and a little of the walls, at the silhouette. Their mean brightness differs by 0.9 stops.
    """
    views, points = [], []
    rng = np.random.default_rng(1)
    for i in range(24):
        camera = camera_at(*placed("orbit", i, 24), 128)
        ends = cast(camera.eye, rays(camera), True, radius=2.2)
        albedo = 0.2 + 0.7 * texture(ends, np.linalg.norm(ends - camera.eye, axis=1) / camera.fx)
        light = albedo**2.2 * np.where(ends[:, 2] > 0.98 * WALL, 1.0, 2.0**-2.5)[:, None]
        image = 255.0 * np.clip(light, 0.0, 1.0) ** (1 / 2.2)
        views.append(
            View(camera, np.round(image).astype(np.uint8).reshape(camera.H, camera.W, 3), name=f"{i:02d}.png")
        )
        points.append(ends[rng.choice(len(ends), 60)])
    return views, np.concatenate(points)


@pytest.mark.parametrize("with_points", [True, False])
def test_photos_that_show_other_things_at_one_exposure_are_not_named(named, with_points):
    views, points = before_a_window()
    means = np.log2([view.image.mean() for view in views])
    assert 2.2 * np.ptp(means) > 0.8, "the photos as such differ by 0.9 stops"
    assert not {"exposure", "white balance"} & set(named(views, points if with_points else None))


def to_linear(srgb):
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb(linear):
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("factor", [2.0, 0.5])
def test_a_photo_of_twice_or_half_the_light_is_a_stop_off(named, factor):
    views, points = before_a_window()
    other = to_srgb(np.minimum(factor * to_linear(views[5].image / 255.0), 1.0))
    found = named(replaced(views, {5: with_photo(views[5], 255.0 * other)}), points)
    (label,) = found["exposure"]
    assert "05.png" in label
    assert float(label.partition("(")[2].rstrip(")")) == pytest.approx(math.log2(factor), abs=0.2)


def exposed(times):
    """Return a function that writes exposure times, with ISO 100 and f/2, into the photos of a folder."""

    def spoil(folder):
        for path, time in zip(sorted((folder / "images").iterdir()), times, strict=True):
            exif = Image.Exif()
            exif[ExifTags.IFD.Exif] = {33434: time, 33437: 2.0, 34855: 100}
            with Image.open(path) as image:
                image.load()
                image.save(path, exif=exif)

    return spoil


@pytest.mark.parametrize("with_points", [True, False])
@pytest.mark.parametrize(("recorded", "shown", "is_named"), [(1, 1, True), (0, 1, False), (1, 0, False)])
def test_exif_decides_on_exposure_unless_the_points_contradict(named, recorded, shown, is_named, with_points):
    """Photo 6 has twice the exposure by its EXIF, by its pixels, or by both."""
    views, points = room("forward", 96, ending="png")
    views = replaced(views, {6: with_photo(views[6], views[6].image * 2.0 ** (shown / 2.2))})
    times = [1 / 50 if recorded and i == 6 else 1 / 100 for i in range(len(views))]
    found = named(views, points if with_points else None, exposed(times)).get("exposure", ())
    names = [label.removeprefix("images/") for label in found]
    told = is_named or (recorded and not with_points)  # without points nothing contradicts EXIF
    assert names == (["view_006.png (+1.0)"] if told else [])


def test_advice_on_exposure_is_what_a_training_chooses(tmp_path):
    """Photos of which many differ are corrected, unless they have alpha; a single one is not."""
    plain, points = room("orbit", 96, ending="png")
    alpha = np.full(plain[0].image.shape[:2], 255, np.uint8)
    alpha[0] = 0
    rng = np.random.default_rng(2)
    many = {i: float(stops) for i, stops in enumerate(rng.uniform(-0.9, 0.9, len(plain)))}
    for name, stops, plane in (("many", many, None), ("one", {4: -1.2}, None), ("clear", many, alpha)):
        views = [
            View(
                view.camera,
                with_photo(view, view.image * 2.0 ** (stops.get(i, 0.0) / 2.2)).image,
                alpha=plane,
                name=view.name,
            )
            for i, view in enumerate(plain)
        ]
        write_colmap(tmp_path / name, views, points, np.full((len(points), 3), 0.5))
        survey = prepare(CaptureReader(tmp_path / name), sharpness=False)
        choice = correction_of(survey).value
        (found,) = (finding for finding in check_exposure(survey) if finding.name == "exposure")
        assert choice == ("exposure" if name == "many" else "none")
        assert found.options == ((("appearance", choice),) if choice != "none" else ())
        assert ("--appearance" in found.advice) == (choice != "none")
        assert ("remove it" in found.advice) == (choice == "none")
