"""Masks beside photos are found, used for feature detection, and carried into the capture."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.photos.decoding import decode_mask
from gsplat_edu.sfm.masks import find_masks, unused_folders, upright_masks
from gsplat_edu.sfm.photos import copy_photos
from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from lab.captures.textured_box import box_orbit, photograph_box

HIDDEN = np.s_[:, :120]
"""The part of photos 320 px wide that masks exclude; without masks, it has features."""


def image(path, pixels=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.zeros((30, 40), np.uint8) if pixels is None else pixels).save(path)
    return path


@pytest.mark.parametrize(
    "name",
    [
        "photos/masks/a.jpg.png",
        "photos/masks/a.png",
        "photos/a.jpg.mask.png",
        "photos/a.mask.png",
        "masks/a.png",
    ],
)
def test_masks_are_found_in_every_usual_place(tmp_path, name):
    photos = [image(tmp_path / "photos" / photo) for photo in ("a.jpg", "b.jpg")]
    mask = image(tmp_path / name)
    assert find_masks(photos) == {photos[0]: mask}


def test_an_ambiguous_mask_is_not_used(tmp_path):
    photos = [image(tmp_path / name) for name in ("a.jpg", "a.png")]
    image(tmp_path / "masks" / "a.png")
    assert find_masks(photos) == {}
    whole = image(tmp_path / "masks" / "a.png.png")
    assert find_masks(photos) == {photos[1]: whole}


def test_a_mask_of_another_size_is_refused(tmp_path):
    photo = image(tmp_path / "a.png")
    mask = image(tmp_path / "masks" / "a.png", np.zeros((15, 20), np.uint8))
    with pytest.raises(DatasetError, match=r"the mask is 20x15 but its photo 40x30; make them the same size"):
        upright_masks({photo: mask}, {photo: (40, 30, 1)})
    with pytest.raises(DatasetError, match=r"but its photo 40x30 \(30x40 upright\); make them the same size"):
        upright_masks({photo: mask}, {photo: (40, 30, 6)})
    with pytest.raises(DatasetError, match=r"masks.a\.png: the mask is 20x15"):
        copy_photos([photo], tmp_path, tmp_path / "copies", 1600)


ORIENTATIONS = {1: 6, 2: 3, 3: 8}
"""EXIF orientation of a photo, by the number of clockwise quarter turns that make it upright."""

CORNER = np.zeros((30, 40), np.uint8)
CORNER[:10, :25] = 200  # different after every rotation


def turned_photo(path, turns, pixels):
    exif = Image.Exif()
    exif[0x0112] = ORIENTATIONS[turns]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, exif=exif)
    return path


def masks_of(tmp_path, photos):
    """Return the masks of the capture, and those that COLMAP reads."""
    facts, unreadable = copy_photos(photos, tmp_path, tmp_path / "work" / "photos", 1600)
    assert not unreadable
    read = [decode_mask(tmp_path / "work" / "masks" / f"{photo.copy}.png") for photo in facts]
    return [decode_mask(Path(photo.mask)) for photo in facts], read


@pytest.mark.parametrize("turns", [1, 3])
@pytest.mark.parametrize("upright", [False, True])
def test_a_mask_may_be_oriented_as_stored_or_upright(tmp_path, turns, upright):
    photo = turned_photo(tmp_path / "a.jpg", turns, np.zeros((30, 40), np.uint8))
    image(tmp_path / "masks" / "a.png", np.rot90(CORNER, -turns) if upright else CORNER)
    (carried,), (read,) = masks_of(tmp_path, [photo])
    assert np.array_equal(carried, CORNER > 0) and np.array_equal(read, CORNER > 0)


@pytest.mark.parametrize("upright", [False, True])
def test_other_masks_decide_the_orientation_of_a_square_mask(tmp_path, upright):
    square = np.ascontiguousarray(CORNER[:, :30])
    photos = [
        turned_photo(tmp_path / "a.jpg", 1, np.zeros((30, 40), np.uint8)),
        turned_photo(tmp_path / "b.jpg", 2, np.zeros((30, 40), np.uint8)),
        turned_photo(tmp_path / "c.jpg", 3, np.zeros((30, 30), np.uint8)),
    ]
    stored = [CORNER, CORNER, square]
    for photo, turns, mask in zip(photos, (1, 2, 3), stored, strict=True):
        image(photo.with_name(f"{photo.stem}.mask.png"), np.rot90(mask, -turns) if upright else mask)
    carried, read = masks_of(tmp_path, photos)
    for found, seen, mask in zip(carried, read, stored, strict=True):
        assert np.array_equal(found, mask > 0) and np.array_equal(seen, mask > 0)


def test_unrelated_masks_are_not_used(tmp_path):
    photos = [image(tmp_path / "photos" / f"{i}.png") for i in range(3)]
    image(tmp_path / "masks" / "house.png", np.zeros((15, 20), np.uint8))
    assert find_masks(photos) == {} and unused_folders(photos, {}) == [tmp_path / "masks"]
    ours = image(tmp_path / "photos" / "masks" / "1.png")
    assert unused_folders(photos, find_masks(photos)) == [tmp_path / "masks"]
    assert find_masks(photos) == {photos[1]: ours}
    inside = [image(tmp_path / "two" / "masks" / name) for name in ("a.png", "b.png")]
    assert find_masks(inside) == {}, "photos in a folder named masks are not taken for their own masks"


def test_a_mask_that_cannot_be_decoded_is_named(tmp_path):
    """The message names the mask, because the photo is intact."""
    photo = image(tmp_path / "a.png")
    mask = image(
        tmp_path / "masks" / "a.png", np.random.default_rng(0).integers(0, 255, (30, 40)).astype(np.uint8)
    )
    mask.write_bytes(mask.read_bytes()[:200])
    facts, (reason,) = copy_photos([photo], tmp_path, tmp_path / "copies", 1600)
    assert not facts and reason.startswith(f"a.png: its mask {mask}: cannot be decoded")


@pytest.mark.slow
@pytest.mark.usefixtures("colmap")
def test_masks_and_alpha_are_used_and_carried_into_the_capture(tmp_path):
    """Some photos have a mask, some are transparent at the same place, and one has neither."""
    source, out = tmp_path / "photos", tmp_path / "capture"
    counts = np.full((240, 320), 255, np.uint8)
    counts[HIDDEN] = 0
    image(tmp_path / "masks" / "house.png")  # a mask of no photo
    for i, camera in enumerate(box_orbit(8, turn=2.5)):
        pixels = photograph_box(camera)
        if i == 7:
            image(source / "7.png", pixels)
        elif i % 2:
            image(source / f"{i}.png", np.dstack([pixels, counts]))
        elif i == 2:  # a photo stored on its side with an upright mask
            turned_photo(source / "2.png", 1, np.ascontiguousarray(np.rot90(pixels)))
            image(source / "masks" / "2.png", counts)
        else:
            image(source / f"{i}.png", pixels)
            image(source / "masks" / f"{i}.png", counts)
    said = []
    reconstruct(SfmOptions(source, out), said.append)
    notes = "\n".join(said)
    assert "; 0 with a focal length in EXIF; 4 of them have a mask" in notes
    assert (
        notes.count(f"{tmp_path / 'masks'}: not used, because none of its images is named like a photo") == 1
    )
    with closing(sqlite3.connect(out / "sfm" / "database.db")) as reader:
        *rows, last = reader.execute("SELECT rows, cols, data FROM keypoints ORDER BY image_id").fetchall()
    assert len(rows) == 7
    assert np.frombuffer(last[2], np.float32).reshape(last[:2])[:, 0].min() < 100, "it has no mask"
    for i, (count, columns, data) in enumerate(rows):
        places = np.frombuffer(data, np.float32).reshape(count, columns)[:, :2]
        u = 320 - places[:, 1] if i == 2 else places[:, 0]  # in the upright photo
        assert count > 50 and u.min() > 119

    views = load_dataset(out, DataSettings(test_every=0, background=None)).train
    assert len(views) >= 6
    for view in views:
        if view.name == "7.png":
            continue
        photo = view.read()
        seen = photo.mask if int(view.name[0]) % 2 == 0 else photo.alpha > 127
        # The estimated lens shifts the edge by a few pixels, but the edge stays sharp.
        assert not seen[40:-40, :110].any() and seen[40:-40, 130:-20].all(), view.name
