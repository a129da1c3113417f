"""HEIC, 16-bit colour and colour profiles, as phones and cameras write them, become 8-bit sRGB."""

import builtins
import io
import json
import sys
import zlib

import numpy as np
import pytest
from PIL import Image, ImageCms, PngImagePlugin

import phone_photos
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.budget.costs import Facts
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.photos.colors import make_profile
from gsplat_edu.photos.decoding import decode, decode_mask, image_header, image_orientation, image_size
from gsplat_edu.photos.image_files import is_image
from gsplat_edu.survey.capture import prepare
from phone_photos import ORIENTATIONS, P3, as_stored, p3_as_srgb, p3_range, quarters, save

pytest.importorskip("pillow_heif")

RNG = np.random.default_rng(5)
NOISE = RNG.integers(0, 256, (12, 16, 3), dtype=np.uint8)
DEEP = RNG.integers(0, 65536, (70, 16, 4)).astype(np.uint16)  # more rows than one block of rounding
ROUNDED = np.rint(DEEP / 257.0).astype(np.uint8)

CODEC = 1
"""Largest error of the HEIC codec in flat areas at quality 100 without subsampling, because YCbCr has 8 bits."""


def srgb_profile():
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


# HEIC


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_a_turned_heic_in_p3_becomes_upright_srgb(tmp_path, orientation):
    """The container rotates the photo. EXIF has the same rotation, which must not be applied again."""
    path = save(tmp_path / "a.heic", quarters(), orientation, icc_profile=make_profile(P3))
    assert image_size(path) == (64, 48) and image_orientation(path) == 1
    rgb, alpha = decode(path)
    low, high = p3_range(quarters(), CODEC)
    assert alpha is None and rgb.shape == (48, 64, 3)
    assert np.all(rgb >= np.floor(low) - 1) and np.all(rgb <= np.ceil(high) + 1), (
        "LittleCMS rounds by one step more"
    )
    assert np.abs(rgb.astype(int) - quarters()).max() > 10, (
        "without conversion, the colours would be less saturated"
    )


def test_exif_alone_does_not_turn_a_heic(tmp_path):
    path = save(tmp_path / "a.heic", quarters(), 1)
    data, plain = path.read_bytes(), phone_photos.exif_bytes(1)
    assert data.count(plain) == 1
    path.write_bytes(data.replace(plain, phone_photos.exif_bytes(6)))
    assert image_size(path) == (64, 48) and image_orientation(path) == 1
    np.testing.assert_allclose(decode(path)[0].astype(int), quarters(), atol=CODEC)


@pytest.mark.parametrize("number", [1, 2, 12])
def test_a_heic_without_a_profile_declares_colours_by_number(tmp_path, number):
    path = save(tmp_path / "a.heic", quarters(), color_primaries=number, transfer_characteristics=13)
    low, high = p3_range(quarters(), CODEC) if number == 12 else (quarters() - CODEC, quarters() + CODEC)
    rgb = decode(path)[0]
    assert np.all(rgb >= np.floor(low) - 1) and np.all(rgb <= np.ceil(high) + 1)
    assert image_header(path).problem == ""


@pytest.mark.parametrize(
    ("numbers", "problem"),
    [((9, 18), "its brightness is coded as HLG"), ((11, 13), "its primaries, number 11 of ITU-T H.273")],
)
def test_colours_that_are_not_converted_are_named(tmp_path, numbers, problem):
    path = save(
        tmp_path / "a.heic", quarters(), color_primaries=numbers[0], transfer_characteristics=numbers[1]
    )
    assert image_header(path).problem.startswith(problem)
    assert decode(path)[0].shape == (48, 64, 3)


def test_a_heic_with_alpha_keeps_it(tmp_path):
    alpha = np.full((48, 64, 1), 255, np.uint8)
    alpha[:24] = 0
    rgb, found = decode(save(tmp_path / "a.heic", np.dstack([quarters(), alpha])))
    np.testing.assert_allclose(found.astype(int), alpha[..., 0], atol=CODEC)
    assert rgb.shape == (48, 64, 3)


def test_the_format_is_recognised_by_content_not_by_name(tmp_path):
    heic = save(tmp_path / "a.heic", quarters()).rename(tmp_path / "a.jpg")
    jpeg = save(tmp_path / "b.jpg", quarters(), quality=95).rename(tmp_path / "b.heic")
    for path in (heic, jpeg):
        assert np.abs(decode(path)[0].astype(int) - quarters()).mean() < 2 and image_size(path) == (64, 48)
        assert decode(path, smaller=1024)[0].shape == (48, 64, 3)


@pytest.mark.parametrize("share", [0.05, 0.3, 0.7, 0.95])
def test_a_heic_cut_short_is_named_in_one_line(tmp_path, share):
    path = save(tmp_path / "a.heic", RNG.integers(0, 256, (64, 64, 3), dtype=np.uint8))
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(DatasetError, match=r"a\.heic: cannot be decoded") as caught:
        decode(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("seed", range(12))
def test_a_damaged_heic_is_read_or_named(tmp_path, seed):
    rng = np.random.default_rng(seed)
    path = save(tmp_path / "a.heic", rng.integers(0, 256, (64, 64, 3), dtype=np.uint8))
    data = np.frombuffer(path.read_bytes(), np.uint8).copy()
    places = rng.integers(12, len(data) if seed % 2 else 600, 6)
    data[places] = rng.integers(0, 256, 6)
    path.write_bytes(data.tobytes())
    for read in (decode, decode_mask, image_header, image_orientation):
        try:
            read(path)
        except DatasetError as error:
            assert "a.heic" in str(error) and "\n" not in str(error)


def test_without_pillow_heif_the_command_that_installs_it_is_named(tmp_path, monkeypatch):
    path = save(tmp_path / "a.heic", quarters())

    def no_heif(name, *more, really=builtins.__import__):
        if name.partition(".")[0] == "pillow_heif":
            raise ImportError(name)
        return really(name, *more)

    monkeypatch.setattr(builtins, "__import__", no_heif)
    monkeypatch.delitem(sys.modules, "pillow_heif")
    said = r'a\.heic: cannot be decoded; HEIC needs pillow-heif: pip install -c constraints\.txt "\.\[heic\]"'
    for read in (decode, decode_mask, image_size, image_header, image_orientation):
        with pytest.raises(DatasetError, match=said):
            read(path)
    assert is_image(path), "a file of HEIC content is recognised without pillow-heif"
    assert decode(save(tmp_path / "a.png", quarters()))[0].shape == (48, 64, 3)


def test_reading_a_heic_changes_nothing_in_pillow(tmp_path):
    decode(save(tmp_path / "a.heic", quarters()))
    assert "HEIF" not in Image.OPEN


# 16 bits


def png16(path, values, color, transparent=None):
    """Write a PNG with 16 bits; color: 0 gray, 2 RGB, 4 gray and alpha, 6 RGBA. Pillow cannot write them."""
    H, W = values.shape[:2]
    with path.open("wb") as file:
        file.write(PngImagePlugin._MAGIC)
        PngImagePlugin.putchunk(file, b"IHDR", W.to_bytes(4), H.to_bytes(4), bytes((16, color, 0, 0, 0)))
        if transparent is not None:
            PngImagePlugin.putchunk(file, b"tRNS", np.asarray(transparent, ">u2").tobytes())
        rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
        PngImagePlugin.putchunk(file, b"IDAT", zlib.compress(rows))
        PngImagePlugin.putchunk(file, b"IEND")
    return path


def tiff16(path, values, order, extra=()):
    """Write an uncompressed TIFF with 16 bits by its specification; order: "<" or ">"; extra: ExtraSamples."""
    H, W = values.shape[:2]
    channels = 1 if values.ndim == 2 else values.shape[2]

    def packed(numbers, size):
        return np.array(numbers, f"{order}u{size}").tobytes()

    data = packed(values, 2)
    tags = [(256, 4, [W]), (257, 4, [H]), (258, 3, [16] * channels), (259, 3, [1])]
    tags += [(262, 3, [1 if channels == 1 else 2]), (273, 4, [0]), (277, 3, [channels]), (278, 4, [H])]
    tags += [(279, 4, [len(data)])] + ([(338, 3, list(extra))] if extra else [])
    # BitsPerSample does not fit into its entry, so it stands before the pixels
    depths = 8 + 2 + 12 * len(tags) + 4
    tags[5] = (273, 4, [depths + 2 * channels])
    table = packed([len(tags)], 2)
    for tag, kind, numbers in tags:
        content = packed(numbers, 2 if kind == 3 else 4)
        content = packed([depths], 4) if len(content) > 4 else content.ljust(4, b"\0")
        table += packed([tag, kind], 2) + packed([len(numbers)], 4) + content
    head = (b"II" if order == "<" else b"MM") + packed([42], 2) + packed([8], 4)
    path.write_bytes(head + table + bytes(4) + packed([16] * channels, 2) + data)
    return path


def test_a_png_with_16_bits_is_rounded(tmp_path):
    rgb, alpha = decode(png16(tmp_path / "a.png", DEEP[..., :3], 2))
    np.testing.assert_array_equal(rgb, ROUNDED[..., :3])
    assert alpha is None
    assert np.any(DEEP[..., :3] >> 8 != ROUNDED[..., :3]), "discarding the lower byte gives other values"
    rgb, alpha = decode(png16(tmp_path / "a.png", DEEP, 6))
    np.testing.assert_array_equal(rgb, ROUNDED[..., :3])
    np.testing.assert_array_equal(alpha, ROUNDED[..., 3])
    rgb, alpha = decode(png16(tmp_path / "a.png", DEEP[..., 0], 0))
    np.testing.assert_array_equal(rgb, np.repeat(ROUNDED[..., :1], 3, axis=2))
    assert alpha is None
    rgb, alpha = decode(png16(tmp_path / "a.png", DEEP[..., :2], 4))
    np.testing.assert_array_equal(rgb, np.repeat(ROUNDED[..., :1], 3, axis=2))
    np.testing.assert_array_equal(alpha, ROUNDED[..., 1])


def test_every_value_of_16_bits_is_rounded_to_the_nearest(tmp_path):
    values = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    expected = np.rint(values / 257.0).astype(np.uint8)
    rgb, _ = decode(png16(tmp_path / "a.png", np.dstack([values, values[::-1], values.T]), 2))
    np.testing.assert_array_equal(rgb, np.dstack([expected, expected[::-1], expected.T]))


def test_a_transparent_colour_of_16_bits_is_compared_with_all_of_them(tmp_path):
    values = np.full((4, 5, 3), 0x1234, np.uint16)
    values[0, 0] = 0x1235  # another colour of the same upper byte
    _, alpha = decode(png16(tmp_path / "a.png", values, 2, transparent=(0x1234,) * 3))
    assert alpha[0, 0] == 255 and np.count_nonzero(alpha) == 1
    _, alpha = decode(png16(tmp_path / "a.png", values[..., 0], 0, transparent=(0x1234,)))
    assert alpha[0, 0] == 255 and np.count_nonzero(alpha) == 1


@pytest.mark.parametrize("order", "<>")
def test_a_tiff_with_16_bits_is_rounded(tmp_path, order):
    rgb, alpha = decode(tiff16(tmp_path / "a.tif", DEEP[..., :3], order))
    np.testing.assert_array_equal(rgb, ROUNDED[..., :3])
    assert alpha is None
    rgb, alpha = decode(tiff16(tmp_path / "a.tif", DEEP, order, extra=(2,)))
    np.testing.assert_array_equal(rgb, ROUNDED[..., :3])
    np.testing.assert_array_equal(alpha, ROUNDED[..., 3])
    rgb, alpha = decode(tiff16(tmp_path / "a.tif", DEEP, order, extra=(0,)))
    np.testing.assert_array_equal(rgb, ROUNDED[..., :3])
    assert alpha is None, "the fourth value is unspecified"
    rgb, _ = decode(tiff16(tmp_path / "a.tif", DEEP[..., 0], order))
    np.testing.assert_array_equal(rgb, np.repeat(ROUNDED[..., :1], 3, axis=2))


def test_premultiplied_colours_are_divided_by_alpha(tmp_path):
    alpha = np.maximum(DEEP[..., 3], 3000)
    colors = DEEP[..., :3] / 65535.0
    stored = np.dstack([np.rint(colors * alpha[..., None]), alpha]).astype(np.uint16)
    rgb, found = decode(tiff16(tmp_path / "a.tif", stored, "<", extra=(1,)))
    np.testing.assert_array_equal(found, np.rint(alpha / 257.0))
    # Half a step of 16 bits divided by an alpha of at least 3000 is 255 / 6000 of a step of 8 bits.
    np.testing.assert_allclose(rgb, 255.0 * colors, atol=0.5 + 255 / 6000)


def test_a_compressed_tiff_with_16_bits_is_rounded(tmp_path):
    cv2 = pytest.importorskip("cv2")
    path = tmp_path / "a.tif"
    for values in (DEEP[..., :3], DEEP):
        assert cv2.imwrite(str(path), values[..., [2, 1, 0, 3][: values.shape[2]]])
        with Image.open(path) as file:
            assert file.tile[0].codec_name == "libtiff"
        np.testing.assert_array_equal(decode(path)[0], ROUNDED[..., :3])


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_a_deep_file_cut_short_is_named(tmp_path, share):
    for path in (
        png16(tmp_path / "a.png", np.tile(DEEP[..., :3], (4, 9, 1)), 2),
        tiff16(tmp_path / "a.tif", DEEP, "<", extra=(2,)),
    ):
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
        with pytest.raises(DatasetError, match=rf"{path.name}: cannot be decoded"):
            decode(path)


# Colours


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif", "a.webp"])
def test_without_a_profile_or_with_srgb_no_bit_changes(tmp_path, name):
    """Trainings on existing captures keep their bits, also if the profile is a version of sRGB that differs by
    rounding."""
    pixels = RNG.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    rough = make_profile(((0.6405, 0.33), (0.30, 0.60), (0.15, 0.06)))
    for profile in (None, srgb_profile(), make_profile(((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))), rough):
        path = tmp_path / name
        Image.fromarray(pixels).save(path, **({} if profile is None else {"icc_profile": profile}))
        with Image.open(path) as file:
            assert file.info.get("icc_profile") == profile
            expected = np.array(file.convert("RGB"))
        np.testing.assert_array_equal(decode(path)[0], expected)
        assert image_header(path).problem == ""


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.jpg"])
def test_display_p3_becomes_srgb(tmp_path, name):
    """Colours agree within LittleCMS's rounding, one step; outside sRGB's gamut, values are clipped."""
    steps = np.arange(0, 256, 15, dtype=np.uint8)
    colors = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 18, 3)
    path = tmp_path / name
    pixels = np.kron(colors, np.ones((8, 8, 1), np.uint8)) if name == "a.jpg" else colors
    options = {"quality": 100, "subsampling": 0} if name == "a.jpg" else {}
    Image.fromarray(pixels).save(path, icc_profile=make_profile(P3), **options)
    with Image.open(path) as file:
        stored = np.array(file)
    rgb, alpha = decode(path)
    assert alpha is None
    np.testing.assert_allclose(rgb, p3_as_srgb(stored), rtol=0, atol=1.5)
    small = decode(path, smaller=16)[0]
    assert np.abs(small.mean(axis=(0, 1)) - p3_as_srgb(stored).mean(axis=(0, 1))).max() < 3


def test_any_rgb_profile_is_converted_and_alpha_is_not(tmp_path):
    """The profile has sRGB's primaries with red and green exchanged, so the conversion exchanges the values."""
    profile = make_profile(((0.30, 0.60), (0.64, 0.33), (0.15, 0.06)))
    alpha = RNG.integers(0, 255, (12, 16), dtype=np.uint8)
    path = tmp_path / "a.png"
    Image.fromarray(np.dstack([NOISE, alpha])).save(path, icc_profile=profile)
    rgb, found = decode(path)
    np.testing.assert_allclose(rgb.astype(int), NOISE[..., [1, 0, 2]], atol=1)
    np.testing.assert_array_equal(found, alpha)
    Image.fromarray(NOISE[..., 0]).save(path, icc_profile=profile)
    np.testing.assert_allclose(decode(path)[0].astype(int), np.repeat(NOISE[..., :1], 3, axis=2), atol=1)


def broken_profiles():
    good = make_profile(P3)
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    damaged = "its colour profile is damaged"
    return [
        (b"not a profile", damaged),
        (good[:200], damaged),
        (good[:128] + bytes(len(good) - 128), damaged),
        (good[:16] + b"R\x1bB " + good[20:], damaged),  # a name with an escape code for the terminal
        (lab, "its colour profile is for Lab, not for RGB"),
    ]


@pytest.mark.parametrize(("profile", "problem"), broken_profiles())
def test_a_broken_profile_is_noted_once_and_the_pixels_taken_as_srgb(one_photo, profile, problem):
    folder = one_photo(NOISE)
    Image.fromarray(NOISE).save(folder / "images" / "a.png", icc_profile=profile)
    dataset = load_dataset(folder)
    (note,) = [note for note in map(str, dataset.notes) if "sRGB" in note]
    assert note == f"1 of 1 photos are taken as sRGB, first images/a.png: {problem}"
    np.testing.assert_array_equal(dataset.train[0].image, NOISE)
    assert [str(note) for note in prepare(CaptureReader(folder)).notes] == [note]


def test_a_capture_with_heic_photos_loads(one_photo):
    folder = one_photo(quarters())
    (folder / "images" / "a.png").unlink()
    save(folder / "images" / "a.heic", quarters(), 6, icc_profile=make_profile(P3))
    (folder / "transforms.json").write_text(
        (folder / "transforms.json").read_text().replace("images/a.png", "images/a.heic")
    )
    image = load_dataset(folder, DataSettings(resolution=2.0)).train[0].image
    expected = p3_as_srgb(quarters()[::2, ::2])
    np.testing.assert_allclose(image, expected, atol=3)
    (shot,) = prepare(CaptureReader(folder)).shots
    assert shot.size == (64, 48) and np.abs(shot.stats.thumbnail - p3_as_srgb(quarters())).max() < 3


def test_the_forecast_knows_that_these_photos_take_more_memory_to_decode(one_photo):
    """Decoding takes 14.3 bytes per pixel for HEIC and up to 21 for 16 bits, as measured; 10 are planned for others."""
    folder = one_photo(quarters())
    path = folder / "images" / "a.png"
    plain = Facts.of(load_dataset(folder)).decoding
    png16(path, np.zeros((48, 64, 3), np.uint16), 2)
    deep = Facts.of(load_dataset(folder)).decoding
    save(folder / "a.heic", quarters()).replace(path)
    heic = Facts.of(load_dataset(folder)).decoding
    assert (plain, heic) == (10, 16) and deep >= 21
    told = json.loads((folder / "transforms.json").read_text())
    save(folder / "images" / "b.png", quarters())
    told["frames"].append(told["frames"][0] | {"file_path": "images/b.png"})
    (folder / "transforms.json").write_text(json.dumps(told))
    assert Facts.of(load_dataset(folder)).decoding == heic, "of both photos, the larger"


def test_profiles_are_read_from_bytes_as_pillow_gives_them():
    """LittleCMS reads white, primaries and curve of the written profile as they were meant."""
    profile = ImageCms.ImageCmsProfile(io.BytesIO(make_profile(P3))).profile
    assert profile.xcolor_space.strip() == "RGB" and profile.connection_space.strip() == "XYZ"
    np.testing.assert_allclose(profile.media_white_point[0], (0.9642, 1.0, 0.8249), atol=1e-4)
    # the columns that Apple publishes for Display P3, adapted to D50
    np.testing.assert_allclose(profile.red_colorant[0], (0.51512, 0.24120, -0.00105), atol=2e-4)
    np.testing.assert_allclose(profile.green_colorant[0], (0.29198, 0.69225, 0.04189), atol=2e-4)
    np.testing.assert_allclose(profile.blue_colorant[0], (0.15710, 0.06657, 0.78407), atol=2e-4)


def test_upright_photos_are_rotated_back_as_pillow_rotates_them():
    assert as_stored(quarters(), 6).shape == (64, 48, 3)
    np.testing.assert_array_equal(as_stored(as_stored(quarters(), 6), 8), quarters())
