"""Masks are found by the same names in every layout; if none fits, the capture is refused."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.masks import MaskFolder
from gsplat_edu.photos.decoding import decode_mask
from gsplat_edu.sfm.masks import check_some_used, find_masks

EVERYTHING = DataSettings(test_every=0)

COUNTS = np.zeros((18, 24), np.uint8)
COUNTS[3:9, 4:20] = 255


def mask_image(path: Path, pixels=COUNTS) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return path


def masked(capture):
    """Return the names of the views with a mask, and check that the mask is `COUNTS`."""
    found = []
    for view in load_dataset(capture, EVERYTHING).train:
        if (mask := view.read().mask) is not None:
            np.testing.assert_array_equal(mask, COUNTS > 0)
            found.append(Path(view.name).stem)
    return found


@pytest.mark.parametrize("layout", ["colmap", "transforms", "blender"])
@pytest.mark.parametrize("ending", [".png", ".PNG", ".png.png", ".png.TIF", ".bmp", ".webp"])
def test_a_mask_may_have_the_name_of_its_photo_and_any_suffix(written, layout, ending):
    capture = written(layout)
    stems = ["view_003", "view_004"]
    for stem in stems:
        folder = "masks/train" if layout == "blender" else "masks"
        path = mask_image(capture / folder / f"{stem}.png")
        if ending == ".webp":
            Image.fromarray(COUNTS).save(path.with_suffix(ending), lossless=True)
            path.unlink()
        elif ending in (".png.TIF", ".bmp"):
            Image.fromarray(COUNTS).save(path.with_name(stem + ending))
            path.unlink()
        else:
            path.rename(path.with_name(stem + ending))
    notes = [str(note) for note in load_dataset(capture, EVERYTHING).notes]
    assert masked(capture) == stems
    assert any("photos have no mask" in note for note in notes)


@pytest.mark.parametrize("layout", ["colmap", "transforms", "blender"])
def test_a_capture_is_refused_if_no_mask_fits_a_photo(written, layout):
    capture = written(layout)
    mask_image(capture / "masks" / "IMG_0001_mask.png")
    with pytest.raises(DatasetError, match=r"masks: none of its 1 images is named like a photo.*IMG_0001"):
        load_dataset(capture)
    (capture / "masks" / "IMG_0001_mask.png").rename(capture / "masks" / "notes.txt")
    assert masked(capture) == []


def test_two_masks_for_one_photo_are_refused(written):
    capture = written("colmap")
    for name in ("view_004.png", "view_004.jpg"):
        mask_image(capture / "masks" / name)
    with pytest.raises(
        DatasetError, match=r"view_004\.jpg and view_004\.png are both named like masks of the"
    ):
        load_dataset(capture)


def test_a_photo_with_a_capital_suffix_in_a_folder(tmp_path):
    """images/left/A.JPG has the mask masks/left/A.JPG, in a capture and in a folder of photos without poses."""
    photo = mask_image(tmp_path / "images" / "left" / "A.JPG")
    mask = mask_image(tmp_path / "masks" / "left" / "A.JPG")
    assert MaskFolder(tmp_path / "masks", ["left/A.JPG"]).find("left/A.JPG") == mask
    assert find_masks([photo]) == {photo: mask}
    mask.rename(mask.with_name("A.jpg"))
    assert find_masks([photo]) == {photo: mask.with_name("A.jpg")}


def test_photos_that_differ_in_their_suffix_need_masks_of_their_own_names(tmp_path):
    photos = [tmp_path / "a.jpg", tmp_path / "a.png"]
    one = mask_image(tmp_path / "masks" / "a.png")
    assert find_masks(photos) == {}
    other = mask_image(tmp_path / "masks" / "a.jpg")
    assert find_masks(photos) == {photos[0]: other, photos[1]: one}


def test_photos_without_poses_are_refused_if_no_mask_fits(tmp_path):
    photos = [mask_image(tmp_path / "photos" / "a.jpg")]
    check_some_used(photos)
    mask_image(tmp_path / "masks" / "b.jpg")
    with pytest.raises(DatasetError, match=r"masks: none of its 1 images is named like a photo"):
        check_some_used(photos)
    mask_image(tmp_path / "masks" / "a.JPG")
    check_some_used(photos)


def test_the_noise_of_a_jpeg_mask_does_not_count(written):
    """At quality 60, zero pixels become up to some tens of 255; the disc's edge moves by at most a pixel."""
    v, u = np.mgrid[:120, :160]
    radius = np.hypot(u - 80.0, v - 60.0)
    capture = written("colmap")
    path = capture / "masks" / "view_004.jpg"
    path.parent.mkdir()
    Image.fromarray(np.where(radius < 40, 255, 0).astype(np.uint8)).save(path, quality=60)
    with Image.open(path) as stored:
        assert np.count_nonzero(np.asarray(stored)[radius > 42]) > 100, "the file has the noise of JPEG"
    found = decode_mask(path)
    assert not found[radius > 41].any() and found[radius < 39].all()
    Image.fromarray(COUNTS).save(path, quality=60)
    assert any("pixels of at least 128 count" in note for note in map(str, load_dataset(capture).notes))
