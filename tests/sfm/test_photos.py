import os

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.photos.decoding import decode
from gsplat_edu.scene.photo import area_mean
from gsplat_edu.sfm.photos import PhotoFacts, camera_kinds, copy_photos, fingerprint, photo_files
from systems import needs_posix

PIXELS = np.random.default_rng(0).integers(0, 255, (30, 40, 3)).astype(np.uint8)


def photo(path, exif=None, pixels=PIXELS, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **({} if exif is None else {"exif": exif}), **options)
    return path


def facts(tmp_path, exif, **options):
    path = photo(tmp_path / "photos" / "a.jpg", exif, **options)
    (found,), unreadable = copy_photos([path], path.parent, tmp_path / "copies", 1600)
    assert not unreadable
    return found


def test_photos_are_recognised_by_their_contents(tmp_path):
    wanted = [
        photo(tmp_path / "IMG_1.JPG", format="JPEG"),
        photo(tmp_path / "no_ending", format="PNG"),
        photo(tmp_path / "b.webp"),
        photo(tmp_path / "c.tif"),
        photo(tmp_path / "named.png", format="JPEG"),
    ]
    (tmp_path / "torn.jpeg").write_bytes(b"")
    wanted.append(tmp_path / "torn.jpeg")  # listed here, and reported later as undecodable
    photo(tmp_path / "textures" / "atlas.png")  # the texture of a mesh made from these photos
    photo(tmp_path / "masks" / "IMG_1.png")
    photo(tmp_path / "b.mask.png")
    photo(tmp_path / "._IMG_1.JPG", format="JPEG")
    photo(tmp_path / "drawing.gif")
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "walk.mp4").write_bytes(b"\0" * 100)
    assert photo_files(tmp_path) == sorted(wanted)


@pytest.mark.parametrize("orientation", [1, 6])
def test_a_copy_of_a_large_jpeg_shows_what_the_whole_photo_does(tmp_path, orientation):
    """It is decoded at half its size."""
    v, u = np.mgrid[:480, :640]
    wave = 127.5 * (1 + np.sin(u / 23 + v / 31) * np.cos(u / 41 - v / 13))
    pixels = np.stack([wave, 0.5 * wave, 0.25 * wave], axis=2).astype(np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = photo(tmp_path / "photos" / "a.jpg", exif, pixels, quality=95)
    copy_photos([path], path.parent, tmp_path / "copies", 200)
    (copy,) = (tmp_path / "copies").iterdir()
    wanted = area_mean(decode(path)[0], 200, 150).astype(float)
    found = np.asarray(Image.open(copy)).astype(float)
    assert found.shape == wanted.shape
    assert np.abs(found - wanted).mean() < 1.5


def test_photos_must_be_in_one_folder(tmp_path):
    wanted = [photo(tmp_path / "session" / "jpeg" / name) for name in ("a.jpg", "b.jpg")]
    for other in ("images_4/a.png", ".hidden/d.png", "__MACOSX/e.png", "out/images/f.png", "masks/a.png"):
        photo(tmp_path / other)
    photo(tmp_path / "session" / "atlas" / "texture.png")
    assert photo_files(tmp_path, (tmp_path / "out").resolve()) == wanted, "a single image is not a capture"
    others = [photo(tmp_path / "day 2" / name) for name in ("a.jpg", "b.jpg", "c.jpg")]
    said = r"its photos are in 2 folders: day 2 \(3\), session/jpeg \(2\); give one of them"
    with pytest.raises(DatasetError, match=said):
        photo_files(tmp_path, (tmp_path / "out").resolve())
    assert photo_files(tmp_path / "day 2") == others
    images = [photo(tmp_path / "images" / name) for name in ("a.jpg", "b.jpg")]
    assert photo_files(tmp_path, (tmp_path / "out").resolve()) == images
    assert photo_files(tmp_path / "masks", None) == [tmp_path / "masks" / "a.png"]


def test_copies_are_small_rgb_jpegs_with_plain_names(tmp_path):
    source = tmp_path / "photos"
    files = [
        photo(source / "ä b.png", pixels=np.dstack([PIXELS, np.zeros((30, 40), np.uint8)])),
        photo(source / "gray16.png", pixels=(PIXELS[..., 0].astype(np.uint16) * 257)),
        photo(source / "photo.webp", lossless=True),
    ]
    progress = []
    found, unreadable = copy_photos(
        files, source, tmp_path / "copies", 20, lambda *count: progress.append(count)
    )
    assert unreadable == [] and progress == [(1, 3), (2, 3), (3, 3)]
    assert [f.name for f in found] == ["ä b.png", "gray16.png", "photo.webp"]
    assert [f.copy for f in found] == ["000000.jpg", "000001.jpg", "000002.jpg"]
    for fact in found:
        with Image.open(tmp_path / "copies" / fact.copy) as copy:
            assert (copy.format, copy.mode, copy.size) == ("JPEG", "RGB", (20, 15)) and fact.copy_size(
                20
            ) == (20, 15)
            assert (fact.W, fact.H) == (40, 30)
    with Image.open(tmp_path / "copies" / "000000.jpg") as copy:
        assert abs(np.asarray(copy).astype(int) - 128).max() <= 2, "transparent pixels become gray"


def test_existing_copies_are_kept(tmp_path):
    files = [photo(tmp_path / "photos" / name) for name in ("a.png", "b.png")]
    copy_photos(files, tmp_path / "photos", tmp_path / "copies", 40)
    kept = tmp_path / "copies" / "000001.jpg"
    (tmp_path / "copies" / "000000.jpg").unlink()
    before = kept.stat().st_mtime_ns
    copy_photos(files, tmp_path / "photos", tmp_path / "copies", 40)
    assert kept.stat().st_mtime_ns == before and (tmp_path / "copies" / "000000.jpg").is_file()


def test_undecodable_photos_are_named_with_a_reason(tmp_path):
    source = tmp_path / "photos"
    good = photo(source / "good.png")
    torn = photo(source / "torn.png", pixels=np.tile(PIXELS, (20, 20, 1)))
    torn.write_bytes(torn.read_bytes()[:2000])
    for name in ("empty.jpg", "phone.HEIC"):
        (source / name).write_bytes(b"")
    files = [source / "empty.jpg", good, source / "phone.HEIC", torn]
    found, unreadable = copy_photos(files, source, tmp_path / "copies", 1600)
    assert [(f.name, f.copy) for f in found] == [("good.png", "000001.jpg")]
    assert unreadable[:2] == [
        "empty.jpg (not a JPEG, PNG, WebP, TIFF, BMP, PPM or HEIC image)",
        "phone.HEIC (not a JPEG, PNG, WebP, TIFF, BMP, PPM or HEIC image)",
    ]
    assert unreadable[2].startswith("torn.png") and len(unreadable) == 3
    assert all("\n" not in reason for reason in unreadable)


def test_the_focal_length_comes_from_exif(tmp_path):
    exif = Image.Exif()
    assert facts(tmp_path, exif).focal is None
    details = exif.get_ifd(0x8769)
    details[0xA405] = 26  # 35 mm equivalent: the diagonal of the film is 43.27 mm
    np.testing.assert_allclose(facts(tmp_path, exif).focal, 26 / 43.2666 * 50, rtol=1e-4)

    details[0xA405] = 0  # unknown; instead 5 mm, at 50 px per cm
    details[0x920A], details[0xA20E], details[0xA210] = 5.0, 50.0, 3
    np.testing.assert_allclose(facts(tmp_path, exif).focal, 25.0, rtol=1e-4)
    details[0xA002] = 80  # the photo was reduced to half its size later
    np.testing.assert_allclose(facts(tmp_path, exif).focal, 12.5, rtol=1e-4)

    details[0xA20E] = "0"
    assert facts(tmp_path, exif).focal is None, "a resolution written as text does not count"

    details[0x920A], details[0xA20E] = 500.0, 50.0
    assert facts(tmp_path, exif).focal is None, "more than twenty times the width is implausible"


def test_photos_with_equal_lens_and_zoom_share_a_camera(tmp_path):
    cameras = []
    for model, zoom, pixels in (
        ("Phone", 26, PIXELS),
        ("Phone", 26, PIXELS + 1),
        ("Phone", 52, PIXELS),
        ("Other", 26, PIXELS),
        ("Phone", 26, PIXELS[:20]),
    ):
        exif = Image.Exif()
        exif[0x0110] = model
        exif.get_ifd(0x8769)[0xA405] = zoom
        cameras.append(facts(tmp_path, exif, pixels=pixels).camera)
        (tmp_path / "copies" / "000000.jpg").unlink()
    assert cameras[0] == cameras[1] and len(set(cameras)) == 4


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, 1), (8, 3), (2, 0), (99, 0)])
def test_quarter_turns_come_from_the_exif_orientation(tmp_path, orientation, turns):
    exif = Image.Exif()
    exif[0x0112] = orientation
    assert facts(tmp_path, exif).turns == turns


def test_the_place_comes_from_exif_gps(tmp_path):
    exif = Image.Exif()
    gps = exif.get_ifd(0x8825)
    gps[1], gps[2], gps[3], gps[4], gps[6] = "S", (33.0, 51.0, 36.0), "E", (151.0, 12.0, 0.0), 25.0
    np.testing.assert_allclose(facts(tmp_path, exif).place, (-33.86, 151.2, 25.0))
    gps[2] = (0.0, 0.0, 0.0)
    gps[4] = (0.0, 0.0, 0.0)
    assert facts(tmp_path, exif).place is None, "zeros mean that the device had no position"


def test_the_fingerprint_depends_on_names_and_contents(tmp_path):
    a, b = photo(tmp_path / "a.png"), photo(tmp_path / "b.png")
    first = fingerprint([a, b], tmp_path)
    assert fingerprint([a, b], tmp_path) == first
    assert fingerprint([a], tmp_path) != first
    photo(b, pixels=PIXELS[::-1])
    assert fingerprint([a, b], tmp_path) != first
    photo(b)
    assert fingerprint([a, b], tmp_path) == first, "the modification time does not matter"
    b.rename(tmp_path / "c.png")
    assert fingerprint([a, tmp_path / "c.png"], tmp_path) != first
    with pytest.raises(DatasetError, match=r"b\.png: cannot be read"):
        fingerprint([a, b], tmp_path)


def test_the_fingerprint_depends_on_the_end_of_a_large_file(tmp_path):
    video = tmp_path / "a.mp4"
    data = bytearray(3 * 65536)
    video.write_bytes(data)
    first = fingerprint([video], tmp_path)
    data[-1] = 1
    video.write_bytes(data)
    assert fingerprint([video], tmp_path) != first


def test_own_captures_and_runs_are_not_searched_for_photos(tmp_path):
    wanted = photo(tmp_path / "a.png")
    for made in ("capture/images/b.png", "run/test/c.png", "run/test/d.png"):
        photo(tmp_path / made)
    for note in ("capture/sfm/stages.json", "run/config.json", "run/cameras.json"):
        (tmp_path / note).parent.mkdir(exist_ok=True)
        (tmp_path / note).write_text("{}")
    assert photo_files(tmp_path) == [wanted]
    assert photo_files(tmp_path / "capture") == [tmp_path / "capture" / "images" / "b.png"], (
        "a folder given explicitly is searched"
    )


@needs_posix
def test_broken_links_and_pipes_are_not_photos(tmp_path, monkeypatch):
    wanted, asked = photo(tmp_path / "a.png"), []
    (tmp_path / "z.jpg").symlink_to(tmp_path / "gone.jpg")
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.setattr("gsplat_edu.sfm.photos.is_photo", lambda path: asked.append(path) or True)
    assert photo_files(tmp_path) == asked == [wanted], "opening a pipe would block for ever"


def test_a_rotated_camera_counts_once():
    """Photos are compared after the rotation by EXIF; without EXIF, by their sides and the kind of camera."""

    def kinds(*cameras):
        return camera_kinds([PhotoFacts("a", "b", 4, 3, 0, None, camera) for camera in cameras])

    assert kinds("4000x3000 Phone 5.4 26", "4000x3000 Phone 5.4 26") == "one camera"
    assert kinds("4000x3000 Phone 5.4 26", "3000x4000 Phone 5.4 26").startswith(
        "one camera, some photos upright"
    )
    assert kinds("4000x3000 Phone 5.4 26", "3000x4000 Phone 2.2 13") == "2 kinds of camera or zoom"
    assert kinds("4000x3000", "3000x4000") == "2 kinds of camera or zoom", (
        "without EXIF, they may be two cameras"
    )
