"""Structure from motion with photos of phones: HEIC, rotated, mirrored and in Display P3."""

import sys

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.images import PhotoFile, load_photo
from gsplat_edu.data.lens import Lens
from gsplat_edu.photos.colors import make_profile
from gsplat_edu.sfm.photos import copy_photos
from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from lab.captures.textured_box import box_orbit, photograph_box
from phone_photos import ORIENTATIONS, P3, as_stored, p3_as_srgb, quarters, save
from sfm.textured_box import LIMIT, cameras_of, check

pytest.importorskip("pillow_heif")

LOSS = 6
"""Largest JPEG error of working copies in flat quarters, away from their edges."""


def inside(pixels):
    """Return the quarters without the pixels within 12 of an edge between them."""
    H, W = pixels.shape[:2]
    keep = np.ones((H, W), bool)
    keep[H // 2 - 12 : H // 2 + 12] = keep[:, W // 2 - 12 : W // 2 + 12] = False
    return pixels[keep].astype(int)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif", "a.heic"])
def test_every_photo_becomes_upright_and_keeps_the_lens_of_the_sensor(tmp_path, name, orientation):
    """Features are extracted from the sensor's picture, unmirrored if necessary; quarter turns make it upright."""
    upright = quarters(128, 96)
    path = save(tmp_path / "photos" / name, upright, orientation)
    (photo,), unreadable = copy_photos([path], path.parent, tmp_path / "copies", 1600)
    assert unreadable == []
    assert as_stored(upright, orientation).shape[1::-1] == (photo.W, photo.H), "a HEIC has turns as well"
    with Image.open(tmp_path / "copies" / photo.copy) as file:
        copy = np.asarray(file)
    assert copy.shape == (photo.H, photo.W, 3)
    np.testing.assert_allclose(inside(np.rot90(copy, -photo.turns)), inside(upright), atol=LOSS)
    lens = Lens(photo.W, photo.H, 100.0, 100.0, photo.W / 2, photo.H / 2)
    read = load_photo(PhotoFile(path, None, lens, photo.W, photo.H, None, photo.sensor))
    np.testing.assert_allclose(inside(np.rot90(read.image, -photo.turns)), inside(upright), atol=LOSS)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize(("name", "kind"), [("a.jpg", "upright"), ("a.jpg", "stored"), ("a.heic", "upright")])
def test_masks_have_the_orientation_of_the_working_copies(tmp_path, name, orientation, kind):
    """A mask is upright or stored like its photo. That of a HEIC is upright, because every program shows a HEIC
    upright."""
    # where the size does not decide (half turns, mirrored photos), the mask of a second photo in portrait does
    source = tmp_path / "photos"
    files = [
        save(source / name, quarters(128, 96), orientation),
        save(source / "b.jpg", quarters(96, 128), 8),
    ]
    (source / "masks").mkdir()
    for path, size, taken in zip(files, ((128, 96), (96, 128)), (orientation, 8), strict=True):
        mask = np.repeat(np.where(quarters(*size)[..., :1] == quarters()[0, 0, 0], 255, 0), 3, axis=2)
        mask = as_stored(mask.astype(np.uint8), taken) if kind == "stored" else mask.astype(np.uint8)
        Image.fromarray(mask[..., 0]).save(source / "masks" / f"{path.name}.png")
    found, _ = copy_photos(files, source, tmp_path / "copies", 1600)
    for photo in found:
        with (
            Image.open(tmp_path / "copies" / photo.copy) as copy,
            Image.open(tmp_path / "masks" / f"{photo.copy}.png") as mask,
        ):
            shown = np.rot90(np.asarray(copy), -photo.turns)
            counts = np.rot90(np.asarray(mask), -photo.turns)
        H, W = counts.shape
        assert counts[: H // 2, : W // 2].all() and np.count_nonzero(counts) == H * W // 4, (
            "the mask excludes the first quarter"
        )
        assert shown.shape[:2] == counts.shape
        with Image.open(photo.mask) as kept:
            np.testing.assert_array_equal(np.rot90(np.asarray(kept), -photo.turns) > 0, counts > 0)


@pytest.mark.slow
def test_photos_of_a_phone_become_an_upright_capture_in_srgb(colmap, tmp_path):
    """One camera took HEICs in Display P3 of all orientations, and a mirrored JPEG."""
    truth, written = {}, {}
    landscape, portrait = box_orbit(14), box_orbit(14, size=(240, 320))
    for i in range(14):
        orientation = (1, 6, 3, 8)[i % 4]
        camera = portrait[i] if i % 2 else landscape[i]
        name = f"IMG_{i:02d}.HEIC"
        if i in (4, 8):
            name, orientation = f"IMG_{i:02d}.jpg", 2
        profile = {"icc_profile": make_profile(P3)} if name.endswith("HEIC") else {"quality": 95}
        save(tmp_path / "photos" / name, photograph_box(camera), orientation, **profile)
        output = name.replace("HEIC", "jpg")
        truth[output] = camera
        seen = photograph_box(camera)
        written[output] = p3_as_srgb(seen) if name.endswith("HEIC") else seen
    said = []
    out = reconstruct(
        SfmOptions(tmp_path / "photos", tmp_path / "capture", max_features=LIMIT, threads=1), said.append
    )
    assert "14 from one camera" in said[0], "portraits share the camera of the landscapes"
    found = cameras_of(out)
    assert set(found) == set(truth)
    check(found, truth)
    for view in load_dataset(out, DataSettings(test_every=0)).train:
        image, expected = view.read().image.astype(float), written[view.name]
        assert image.shape == expected.shape
        blurred = [
            np.asarray(Image.fromarray(np.uint8(np.rint(p))).resize((8, 8), 4)) for p in (image, expected)
        ]
        # Means of 1/64 of a photo change little: undistortion moves less than a pixel, and the codecs keep means.
        assert np.abs(blurred[0].astype(int) - blurred[1]).max() < 12, view.name


def test_sfm_without_pillow_heif_stops_with_the_command_that_installs_it(
    colmap, tmp_path, capsys, monkeypatch
):
    for i in range(3):
        save(tmp_path / "photos" / f"{i}.heic", quarters())
    monkeypatch.setitem(sys.modules, "pillow_heif", None)  # pillow-heif is not installed
    assert main(["sfm", str(tmp_path / "photos"), str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert (
        '0.heic: cannot be decoded; HEIC needs pillow-heif: pip install -c constraints.txt ".[heic]"' in line
    )


def test_a_broken_profile_is_reported_once(tmp_path):
    path = save(tmp_path / "photos" / "a.jpg", quarters(), icc_profile=b"not a profile")
    (photo,), _ = copy_photos([path], path.parent, tmp_path / "copies", 1600)
    assert photo.problem == "its colour profile is damaged"
