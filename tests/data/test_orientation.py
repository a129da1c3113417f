"""EXIF orientation: the sizes of a capture's cameras decide whether its photos are rotated."""

import json

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.orientation import QUARTER_TURNS
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.photos.decoding import (
    decode,
    decode_mask,
    image_orientation,
    image_size,
    turned,
    upright_image_size,
    upright_size,
)
from gsplat_edu.survey.capture import prepare
from phone_photos import ORIENTATIONS, as_stored, exif_bytes, quarters, save

EVERYTHING = DataSettings(test_every=0)


def capture(folder, photos, size=(64, 48)):
    """Write a transforms.json; photos: names and EXIF orientations, all upright at a size unless one is given."""
    frames = []
    for name, orientation, *shown in photos:
        W, H = shown[0] if shown else size
        save(folder / "images" / name, quarters(W, H), orientation)
        lens = {"w": W, "h": H, "fl_x": 60.0, "cx": W / 2, "cy": H / 2}
        frames.append({"file_path": f"images/{name}", "transform_matrix": np.eye(4).tolist(), **lens})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return folder


def images(folder, **settings):
    return {
        view.name: view.image for view in load_dataset(folder, DataSettings(test_every=0, **settings)).train
    }


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_pixels_are_read_as_stored_and_turned_on_request(tmp_path, name, orientation):
    """This includes TIFF, which Pillow rotates by itself."""
    path = save(tmp_path / name, quarters(), orientation)
    stored = as_stored(quarters(), orientation)
    assert image_orientation(path) == orientation
    assert image_size(path) == stored.shape[1::-1]
    assert upright_size(image_size(path), orientation) == upright_image_size(path) == (64, 48)
    np.testing.assert_array_equal(decode(path)[0], stored)
    np.testing.assert_array_equal(decode(path, orientation)[0], quarters())
    np.testing.assert_array_equal(turned(stored, orientation), quarters())
    mask = Image.fromarray(as_stored(quarters(), orientation)[..., 0] // 150 * 255)
    mask.save(tmp_path / f"m{name[1:]}", exif=exif_bytes(orientation))
    np.testing.assert_array_equal(decode_mask(tmp_path / f"m{name[1:]}"), stored[..., 0] >= 150)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_poses_of_stored_pixels_are_not_broken(tmp_path, orientation):
    """A camera of COLMAP has the size of the stored pixels."""
    stored = as_stored(quarters(), orientation)
    folder = capture(tmp_path, [("a.png", orientation)])
    contents = json.loads((folder / "transforms.json").read_text())
    contents["frames"][0] |= {"w": stored.shape[1], "h": stored.shape[0]}
    (folder / "transforms.json").write_text(json.dumps(contents))
    np.testing.assert_array_equal(images(folder)["images/a.png"], stored)
    assert not any("EXIF" in note for note in map(str, load_dataset(folder, EVERYTHING).notes))


@pytest.mark.parametrize("orientation", QUARTER_TURNS)
def test_poses_of_upright_pixels_turn_the_photo(tmp_path, orientation):
    """Other programs rotate photos before they estimate poses; then only the upright size fits the camera."""
    folder = capture(tmp_path, [("a.png", orientation), ("b.png", 1)])
    found = images(folder)
    for image in found.values():
        np.testing.assert_array_equal(image, quarters())
    (note,) = [note for note in map(str, load_dataset(folder, EVERYTHING).notes) if "EXIF" in note]
    assert note.startswith("1 of 2 photos are turned by their EXIF orientation") and note.endswith(
        "first images/a.png"
    )
    assert [shot.size for shot in prepare(CaptureReader(folder)).shots] == [(64, 48), (64, 48)]
    np.testing.assert_array_equal(prepare(CaptureReader(folder)).shots[0].stats.thumbnail, quarters())


def test_photos_whose_size_decides_nothing_are_treated_like_the_others(tmp_path):
    """If the program rotated a portrait before estimating its pose, it also rotated a photo taken upside down."""
    upright = quarters()
    folder = capture(tmp_path / "turned", [("a.png", 6), ("b.png", 3), ("c.png", 2), ("d.png", 1)])
    for image in images(folder).values():
        np.testing.assert_array_equal(image, upright)
    folder = capture(tmp_path / "unknown", [("b.png", 3), ("d.png", 1)])
    np.testing.assert_array_equal(images(folder)["images/b.png"], as_stored(upright, 3))
    folder = capture(tmp_path / "both", [("a.png", 6), ("b.png", 3), ("e.png", 8)])
    contents = json.loads((folder / "transforms.json").read_text())
    contents["frames"][2] |= {"w": 48, "h": 64}  # the pose of this one is that of the stored photo
    (folder / "transforms.json").write_text(json.dumps(contents))
    found = images(folder)
    np.testing.assert_array_equal(found["images/a.png"], upright)
    np.testing.assert_array_equal(found["images/b.png"], as_stored(upright, 3))
    np.testing.assert_array_equal(found["images/e.png"], as_stored(upright, 8))


def test_a_photo_that_fits_neither_way_is_refused(tmp_path):
    folder = capture(tmp_path, [("a.png", 6)])
    Image.fromarray(quarters(64, 30)).save(folder / "images" / "a.png", exif=exif_bytes(6))
    with pytest.raises(DatasetError, match="another aspect ratio"):
        load_dataset(folder)
    Image.fromarray(as_stored(quarters(), 6)).save(folder / "images" / "a.png")
    with pytest.raises(DatasetError, match="another aspect ratio"):
        load_dataset(folder)


def test_masks_and_smaller_copies_of_turned_photos(tmp_path):
    folder = capture(tmp_path, [("a.png", 6)])
    for kept in (True, False):  # a program that makes copies may keep EXIF or rotate the photo
        copy = folder / "images_2" / "a.png"
        if kept:
            save(copy, quarters(32, 24), 6)
        else:
            Image.fromarray(quarters(32, 24)).save(copy)
        np.testing.assert_array_equal(images(folder, resolution=2.0)["images/a.png"], quarters(32, 24))
    mask = np.zeros((48, 64), np.uint8)
    mask[:24, 32:] = 255
    Image.fromarray(mask).save(folder / "mask.png")
    contents = json.loads((folder / "transforms.json").read_text())
    contents["frames"][0]["mask_path"] = "mask.png"
    (folder / "transforms.json").write_text(json.dumps(contents))
    photo = load_dataset(folder, EVERYTHING).train[0].read()
    np.testing.assert_array_equal(photo.mask, mask > 0)
    np.testing.assert_array_equal(photo.image, quarters())
