"""A picture of four flat quarters in all orientations, formats and colour spaces of phones."""

import numpy as np
from PIL import Image, ImageOps

QUARTERS = ((190, 60, 50), (60, 170, 70), (50, 70, 180), (150, 150, 150))
"""Values of the four quarters; as Display P3, they are colours within sRGB's gamut."""

ORIENTATIONS = range(1, 9)
"""EXIF orientations."""

P3 = ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060))
"""Primaries of Display P3, xy."""

P3_TO_SRGB = np.array(
    [[1.2249401, -0.2249404, 0.0], [-0.0420569, 1.0420571, 0.0], [-0.0196376, -0.0786361, 1.0982735]]
)
"""Matrix from linear Display P3 to linear sRGB (CSS Color 4, through XYZ at D65)."""


def quarters(W=64, H=48):
    """Return the picture, upright."""
    pixels = np.empty((H, W, 3), np.uint8)
    for i, color in enumerate(QUARTERS):
        pixels[i // 2 * H // 2 :, i % 2 * W // 2 :] = color
    return pixels


def as_stored(upright, orientation):
    """Return the stored pixels, which Pillow rotates by an EXIF orientation to the picture."""
    back = {6: 8, 8: 6}.get(orientation, orientation)
    image = Image.fromarray(upright)
    image.getexif()[0x0112] = back
    return np.asarray(ImageOps.exif_transpose(image))


def exif_bytes(orientation):
    """Return EXIF data with only an orientation."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    return exif.tobytes()


def save(path, upright, orientation=1, **options):
    """Write a picture like a camera, as the sensor's pixels and an orientation."""
    pixels, exif = as_stored(upright, orientation), exif_bytes(orientation)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() != ".heic":
        Image.fromarray(pixels).save(path, exif=exif, **options)
        return path
    import pillow_heif  # imported here, so that other tests do not need it

    H, W = pixels.shape[:2]
    heif = {"quality": 100, "chroma": 444, "exif": exif} | options
    mode = "RGB" if pixels.shape[2] == 3 else "RGBA"
    with path.open("wb") as file:
        pillow_heif.encode(mode, (W, H), np.ascontiguousarray(pixels).tobytes(), file, **heif)
    return path


def p3_as_srgb(values):
    """Convert Display P3 values to sRGB, 0 to 255, not rounded."""
    v = np.asarray(values, np.float64) / 255.0
    light = np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    light = np.clip(light @ P3_TO_SRGB.T, 0.0, 1.0)
    return 255.0 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def p3_range(values, error):
    """Return the smallest and largest sRGB values of Display P3 values that are off by up to `error`."""
    steps = np.stack(np.meshgrid(*[(-error, 0, error)] * 3), axis=-1).reshape(-1, 3)
    found = np.stack([p3_as_srgb(np.clip(values.astype(int) + step, 0, 255)) for step in steps])
    return found.min(axis=0), found.max(axis=0)
