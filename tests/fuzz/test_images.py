"""Damaged photos, headers, EXIF, masks and working copies are decoded or refused in one line."""

import io

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageCms, TiffImagePlugin

import tiers
from damage import damaged_bytes
from gsplat_edu.base.errors import SplatError
from gsplat_edu.photos.decoding import decode, decode_mask, image_header, image_orientation, image_size
from gsplat_edu.sfm.photos import copy_photos, taken_at

pytestmark = pytest.mark.fuzz

IMAGES = tiers.count("GSPLAT_EDU_FUZZ_IMAGES", 60, 4_000)
"""Damaged photos per format."""

SEEDS = range(tiers.SEED, tiers.SEED + IMAGES)

PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def exif():
    """Return EXIF as phones write it: orientation, camera, focal lengths, time and position."""
    tags = Image.Exif()
    tags[ExifTags.Base.Orientation], tags[ExifTags.Base.Make], tags[ExifTags.Base.Model] = 6, "Maker", "One"
    details = tags.get_ifd(ExifTags.IFD.Exif)
    details[ExifTags.Base.FocalLength] = TiffImagePlugin.IFDRational(43, 10)
    details[ExifTags.Base.FocalPlaneXResolution] = TiffImagePlugin.IFDRational(4000, 3)
    details[ExifTags.Base.FocalPlaneResolutionUnit] = 2
    details[ExifTags.Base.ExifImageWidth] = 20
    details[ExifTags.Base.DateTimeOriginal] = "2024:02:12 00:39:19"
    place = tags.get_ifd(ExifTags.IFD.GPSInfo)
    place[ExifTags.GPS.GPSLatitudeRef], place[ExifTags.GPS.GPSLongitudeRef] = "N", "E"
    place[ExifTags.GPS.GPSLatitude] = place[ExifTags.GPS.GPSLongitude] = (47.0, 22.0, 30.5)
    place[ExifTags.GPS.GPSAltitude] = 430.5
    return tags


def photo(kind):
    """Return a photo of 20 x 14 px as a file's bytes."""
    pixels = np.random.default_rng(0).integers(0, 255, (14, 20, 4), dtype=np.uint8)
    image, options = Image.fromarray(pixels[..., :3]), {}
    match kind:
        case "jpg":
            options = {"exif": exif(), "icc_profile": PROFILE, "progressive": True}
        case "png":
            image, options = Image.fromarray(pixels), {"exif": exif(), "icc_profile": PROFILE}
        case "deep.png":
            image = Image.fromarray(pixels[..., 0].astype(np.uint16) * 257)
        case "palette.png":
            image, options = image.quantize(16), {"transparency": 3, "interlace": True}
        case "tif":
            options = {"exif": exif(), "compression": "tiff_lzw"}
        case "webp":
            image, options = Image.fromarray(pixels), {"exif": exif(), "lossless": True}
        case "heic":
            heif = pytest.importorskip("pillow_heif")
            stream = io.BytesIO()
            heif.from_pillow(image.resize((64, 64))).save(stream, exif=exif().tobytes())
            return stream.getvalue()
    stream = io.BytesIO()
    kinds = {"jpg": "jpeg", "tif": "tiff"}
    ending = kind.rpartition(".")[2]
    image.save(stream, format=kinds.get(ending, ending), **options)
    return stream.getvalue()


def read(path, seed):
    """Read a photo in every way that commands do; return whether its pixels can be decoded."""
    decoded = False
    for reader in (image_header, image_size, image_orientation, decode_mask, decode):
        try:
            found = reader(path)
            decoded = reader is decode and found[0].dtype == np.uint8
        except SplatError as error:
            assert str(path) in str(error) and "\n" not in str(error), seed
    taken_at(path)
    return decoded


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.filterwarnings("ignore")  # Pillow warns of invalid EXIF
@pytest.mark.parametrize(
    "kind", ["jpg", "png", "deep.png", "palette.png", "tif", "webp", "bmp", "ppm", "heic"]
)
def test_damaged_photos(tmp_path, kind):
    whole, path, loaded = photo(kind), tmp_path / f"damaged.{kind}", 0
    path.write_bytes(whole)
    assert read(path, "whole")
    for seed in SEEDS:
        path.write_bytes(damaged_bytes(whole, np.random.default_rng(seed)))
        try:
            W, H = image_size(path)
        except SplatError:
            W, H = 0, 0
        if W * H < 1_000_000:  # larger photos are limited by the free memory
            loaded += read(path, seed)
            copied(path, seed)
    assert loaded < IMAGES, "no damage was refused"


def copied(path, seed):
    """Make the working copy that features are extracted from, with the photo's EXIF."""
    found, unreadable = copy_photos([path], path.parent, path.parent / "copies", 64)
    assert len(found) + len(unreadable) == 1, seed
    for one in found:
        (path.parent / "copies" / one.copy).unlink()
        assert one.focal is None or 0 < one.focal < np.inf, seed
        assert one.place is None or np.isfinite(one.place).all(), seed


ODD_VALUES = (
    "",
    "0",
    "x",
    "nan",
    "inf",
    "-1",
    "1e400",
    0,
    1,
    65_535,
    2**32 - 1,
    -1.5,
    0.0,
    (1, 2),
    (0.0, 0.0, 0.0),
)
ODD_VALUES += (float("inf"), float("nan"), b"\0\xff", ("a", "b"), TiffImagePlugin.IFDRational(0, 0))
ODD_VALUES += (TiffImagePlugin.IFDRational(0, 5), TiffImagePlugin.IFDRational(5, 0), (1e300, 2.0, 3.0))


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.filterwarnings("ignore")  # Pillow warns of invalid EXIF
def test_values_of_exif_that_no_camera_writes(tmp_path):
    path, image = tmp_path / "odd.jpg", Image.new("RGB", (20, 14), (90, 80, 70))
    for seed in SEEDS:
        draw, tags = np.random.default_rng(seed), exif()
        for _ in range(int(draw.integers(1, 4))):
            part = (None, ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo)[draw.integers(3)]
            table = tags if part is None else tags.get_ifd(part)
            table[sorted(table)[draw.integers(len(table))]] = ODD_VALUES[draw.integers(len(ODD_VALUES))]
        try:
            image.save(path, exif=tags)
        except Exception:
            continue
        assert read(path, seed), seed
        copied(path, seed)
