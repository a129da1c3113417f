"""Undistortion agrees with the lens formulas of OpenCV's documentation, which this file implements again."""

import numpy as np
import pytest

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.lens import BAND, Lens, bands, lens_of, undistortion
from gsplat_edu.data.lens_formulas import PERSPECTIVE

# the first pixel's centre is (0.5, 0.5), as in files
W, H, FX, FY, CX, CY = (
    160,
    120,
    140.0,
    133.0,
    83.0,
    57.0,
)


def perspective(x, y, **given):
    k1, k2, p1, p2, k3, k4, k5, k6 = (given.get(name, 0.0) for name in PERSPECTIVE)
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def fisheye(x, y, k1=0.0, k2=0.0, k3=0.0, k4=0.0):
    r = np.hypot(x, y)
    t = np.arctan(r)
    scale = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8) / r
    return x * scale, y * scale


def whole(lens):
    """Return the maps of all rows, computed in bands as they are for photos."""
    parts = [undistortion(lens, band) for band in bands(lens.H)]
    return [np.concatenate(planes) for planes in zip(*parts, strict=True)]


def dots(distort, coefficients):
    """Draw a soft dot per colour channel at the pixel of a ray; return the photo and the three rays."""
    rays = np.array([[-0.31, -0.22], [0.27, 0.19], [0.05, -0.24]])
    y, x = np.mgrid[:H, :W]
    photo = np.zeros((H, W, 3))
    for channel, ray in enumerate(rays):
        u, v = distort(*ray, **coefficients)
        u, v = FX * u + CX - 0.5, FY * v + CY - 0.5
        photo[..., channel] = 250 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 2.5**2))
    return np.round(photo).astype(np.uint8), rays


def centres(image):
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    weights = image.astype(float) / image.sum(axis=(0, 1))
    return np.stack(
        [(weights * x[..., None]).sum(axis=(0, 1)), (weights * y[..., None]).sum(axis=(0, 1))], axis=1
    )


@pytest.mark.parametrize("resolution", [None, 2.0])
@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("OPENCV", {"k1": -0.25, "k2": 0.06, "p1": 0.004, "p2": -0.003}),
        ("OPENCV", {"k1": 0.2, "k2": 0.05, "k3": 0.02}),
        ("OPENCV", {"k1": 0.4, "k4": 0.15, "k5": 0.02, "k6": 0.01}),
        ("OPENCV_FISHEYE", {}),
        ("OPENCV_FISHEYE", {"k1": 0.05, "k2": -0.02, "k3": 0.01, "k4": -0.002}),
    ],
)
def test_rays_lie_where_the_pinhole_puts_them(one_photo, model, coefficients, resolution):
    """Dots drawn through the distorting lens are found at u = fx x + cx of the view's camera.

    Rounding to 8 bits, bilinear maps and the dots' own bending move a centre by a few hundredths of a pixel. The bound
    of 0.15 px catches a half-pixel error of convention, even at half size, where it is a quarter of a pixel.
    """
    photo, rays = dots(fisheye if "FISHEYE" in model else perspective, coefficients)
    folder = one_photo(photo, camera_model=model, fl_x=FX, fl_y=FY, cx=CX, cy=CY, **coefficients)
    view = load_dataset(folder, DataSettings(resolution=resolution)).train[0]
    camera = view.camera
    expected = np.stack([camera.fx * rays[:, 0] + camera.cx, camera.fy * rays[:, 1] + camera.cy], axis=1)
    np.testing.assert_allclose(centres(view.image), expected, rtol=0, atol=0.15)
    assert ((W, H) if resolution is None else (W // 2, H // 2)) == (camera.W, camera.H)
    moved = np.hypot(*(centres(photo) - (expected if resolution is None else 2 * expected + 0.5)).T)
    assert moved.max() > 1.0  # without undistortion, the test would fail


@pytest.mark.parametrize(
    ("values", "is_fisheye", "some_outside"),
    [
        ({"k1": -0.25, "p1": 0.02}, False, False),
        ({"k1": 0.3, "p1": 0.02}, False, False),
        ({"k1": 1.0}, True, True),  # the corners of the undistorted image lie outside the photo
    ],
)
def test_only_pixels_that_lie_inside_the_photo_are_valid(values, is_fisheye, some_outside):
    """A pixel is valid if and only if its formula gives a place inside the photo. The float32 maps are accurate to
    1e-4 px."""
    lens = lens_of(
        {"fx": FX, "fy": FY, "cx": CX, "cy": CY, **values}, W, H, "fisheye" if is_fisheye else "perspective"
    )
    (columns, rows, valid), pinhole = whole(lens), lens.undistorted()
    y, x = np.mgrid[:H, :W]
    distort = fisheye if is_fisheye else perspective
    u, v = distort((x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy, **values)
    u, v = FX * u + CX - 0.5, FY * v + CY - 0.5
    np.testing.assert_allclose(columns, u, rtol=0, atol=1e-4)
    np.testing.assert_allclose(rows, v, rtol=0, atol=1e-4)
    inside = (u > -0.5) & (u < W - 0.5) & (v > -0.5) & (v < H - 0.5)
    clear = np.minimum.reduce([abs(u + 0.5), abs(u - W + 0.5), abs(v + 0.5), abs(v - H + 0.5)]) > 1e-3
    np.testing.assert_array_equal(valid[clear], inside[clear])
    assert some_outside == bool((~inside).any())


def test_pixels_beyond_a_fold_of_the_image_are_invalid():
    """With k1 = -0.6, r (1 + k1 r²) has its maximum at r² = 1 / 1.8, beyond which the image repeats in reverse.
    Slopes are differences between neighbours, so both answers are accepted within 5 % of that radius.
    """
    lens = Lens(64, 48, 40.0, 40.0, 31.5, 23.5, (-0.6,))
    pinhole, (_, _, valid) = lens.undistorted(), whole(lens)
    y, x = np.mgrid[:48, :64]
    radius = np.hypot((x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy) * np.sqrt(1.8)
    assert (radius > 1.05).sum() > 200 and not valid[radius > 1.05].any()
    assert valid[radius < 0.95].all()


def test_pinholes_have_no_maps(one_photo):
    photo = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    view = load_dataset(one_photo(photo, k1=0.0, k2=0.0, p1=0.0)).train[0]
    np.testing.assert_array_equal(view.image, photo)
    assert view.read().mask is None


@pytest.mark.parametrize(
    ("lens", "check"),
    [
        (Lens(64, 48, 40.0, 40.0, 31.5, 23.5, (-1e9,)), "leaves no pixel"),
        (Lens(64, 48, 40.0, 40.0, 31.5, 23.5, (1e300, 1e300)), "focal length would change"),
        (Lens(640, 480, 100.0, 100.0, 319.5, 239.5, (1e-9,)), "73 degrees to the side"),
        (Lens(640, 480, 560.0, 560.0, 319.5, 239.5, (9.0,)), "focal length would change"),
        # one pixel has no slope and no fold
        (
            Lens(1, 9, 40.0, 40.0, 0.0, 4.0, (0.1,)),
            "no rectangle",
        ),
        (Lens(1, 9, 40.0, 40.0, 0.0, 4.0, (0.1,), "fisheye"), "no rectangle"),
        (Lens(64, 48, 20.0, 20.0, 31.5, 23.5, (1e300,), "fisheye"), "no rectangle"),
        (Lens(32767, 48, 20000.0, 20000.0, 16383.0, 23.5, (0.1,)), "32767x48 px cannot be undistorted"),
    ],
)
def test_a_lens_that_no_pinhole_can_represent_is_refused(lens, check):
    with pytest.raises(DatasetError, match=check) as caught:
        lens.undistorted()
        undistortion(lens, slice(0, lens.H))
    assert "image_undistorter" in str(caught.value)


@pytest.mark.parametrize(
    "coefficients", [(-0.25,), (0.3,), (-0.1, 0.02, 0.01, -0.008), (-0.02, 0.0, 0.0, 0.01)]
)
def test_pixels_keep_their_shape_and_stay_inside(coefficients):
    """OpenCV's new camera matrix scales the axes separately to fill the image, so pixels would differ by up to 20 %."""
    lens = Lens(640, 480, 560.0, 550.0, 325.0, 230.0, coefficients)
    pinhole = lens.undistorted()
    assert pinhole.fx / pinhole.fy == pytest.approx(lens.fx / lens.fy, rel=1e-12)
    columns, rows, valid = whole(lens)
    assert valid.all()
    # The view is as wide as possible, so it touches an edge of the photo. OpenCV samples the rim at few points, so it
    # may miss by a pixel or two.
    room = (columns.min(), 639 - columns.max(), rows.min(), 479 - rows.max())
    assert -0.5 <= min(room) < 2.0


def test_bands_give_the_same_maps_as_the_whole():
    lens = Lens(90, 2 * BAND + 7, 200.0, 210.0, 45.0, 130.0, (-0.1, 0.0, 0.002, 0.001))
    assert [(band.start, band.stop) for band in bands(lens.H)] == [
        (0, BAND),
        (BAND, 2 * BAND),
        (2 * BAND, 2 * BAND + 7),
    ]
    for parts, at_once in zip(whole(lens), undistortion(lens, slice(0, lens.H)), strict=True):
        np.testing.assert_allclose(parts, at_once, rtol=0, atol=1e-4)


def test_the_statues_strong_distortion_gives_a_sane_camera():
    """k = -0.684 comes from real photos. The camera is checked at the calibrated size and at a quarter of it."""
    lens = lens_of({"fx": 2395.65, "fy": 2395.65, "cx": 400, "cy": 600, "k1": -0.684122}, 800, 1200)
    for one in (lens, lens.scaled(200, 300)):
        pinhole = one.undistorted()
        assert 0.9 < pinhole.fx / one.fx <= 1.1 and 0.9 < pinhole.fy / one.fy <= 1.1
        assert whole(one)[2].mean() > 0.98


def test_sizes_scale_about_the_corner():
    """The centre of the image stays the centre, and the principal point keeps its relative position."""
    lens = lens_of({"fx": 100, "fy": 90, "cx": 20, "cy": 15}, 40, 30)
    half = lens.scaled(20, 15)
    assert (half.fx, half.fy, half.cx, half.cy) == (50, 45, 9.5, 7.0)
    uneven = lens.scaled(10, 15)
    assert (uneven.fx, uneven.fy, uneven.cx, uneven.cy) == (25, 45, 4.5, 7.0)
