"""The formulas of all lens models agree with COLMAP's code, and photos taken through them are undistorted."""

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.data.colmap import MODELS, SPHERE, read_cameras
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.lens import (
    CROPPED_ANGLE,
    MAX_ANGLE,
    OPENCV,
    Lens,
    bands,
    opencv_rectangle,
    ray_rectangle,
    undistortion,
)
from gsplat_edu.data.lens_formulas import FORMULAS

W, H = 160, 120

COEFFICIENTS = {
    "SIMPLE_PINHOLE": [],
    "PINHOLE": [],
    "SIMPLE_RADIAL": [0.1],
    "RADIAL": [-0.2, 0.05],
    "OPENCV": [-0.2, 0.05, 0.01, -0.02],
    "OPENCV_FISHEYE": [0.05, -0.02, 0.01, -0.002],
    "FULL_OPENCV": [0.1, 0.02, 0.01, -0.02, 0.01, 0.05, 0.02, 0.01],
    "FOV": [0.9],
    "SIMPLE_RADIAL_FISHEYE": [0.03],
    "RADIAL_FISHEYE": [0.03, -0.01],
    "THIN_PRISM_FISHEYE": [0.05, -0.02, 0.003, -0.004, 0.01, -0.002, 0.002, -0.003],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        *(0.05, -0.02, 0.01, -0.002, 0.001, -0.0005),
        *(0.003, -0.004, 0.002, -0.001, 0.003, 0.0005),
    ],
    "SIMPLE_DIVISION": [-0.15],
    "DIVISION": [-0.15],
    "SIMPLE_FISHEYE": [],
    "FISHEYE": [],
    "EUCM": [0.6, 1.1],
}
"""Plausible coefficients of every supported model, all of them different."""

NEW = ("FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "EUCM")
"""Models that OpenCV does not have."""


def parameters(model):
    """Return the numbers of a camera of 160x120 px, in COLMAP's order and convention."""
    known = {"f": 90.0, "fx": 90.0, "fy": 94.0, "cx": 83.0, "cy": 57.0}
    names = dict(MODELS)[model].split()
    head = [known[name] for name in names if name in known]
    assert len(head) + len(COEFFICIENTS[model]) == len(names)
    return head + COEFFICIENTS[model]


def lens_of_model(model, folder: Path, suffix="bin"):
    """Read a camera back from cameras.bin or cameras.txt."""
    values, path = parameters(model), folder / f"cameras.{suffix}"
    if suffix == "txt":
        path.write_text(f"1 {model} {W} {H} {' '.join(map(repr, values))}\n")
    else:
        number = [name for name, _ in MODELS].index(model)
        path.write_bytes(struct.pack(f"<QIiQQ{len(values)}d", 1, 1, number, W, H, *values))
    return read_cameras(path)[1]


def pixels(lens, x, y):
    """Apply a lens's formula: pixel positions, centres at integers."""
    formula = FORMULAS[lens.model]
    coefficients = np.zeros(len(formula.names))
    coefficients[: len(lens.coefficients)] = lens.coefficients
    a, b = formula.image(x, y, coefficients)
    return np.stack([lens.fx * a + lens.cx, lens.fy * b + lens.cy], axis=-1)


def whole(lens):
    parts = [undistortion(lens, band) for band in bands(lens.H)]
    return [np.concatenate(planes) for planes in zip(*parts, strict=True)]


def test_every_model_is_tested():
    assert {*COEFFICIENTS, SPHERE} == {name for name, _ in MODELS}


def test_the_installed_colmap_has_no_model_that_is_unknown_here():
    pycolmap = pytest.importorskip("pycolmap")
    theirs = {name: int(number) for name, number in pycolmap.CameraModelId.__members__.items()}
    ours = {name: number for number, (name, _) in enumerate(MODELS)}
    assert {name: number for name, number in theirs.items() if number >= 0} == ours


@pytest.mark.parametrize("suffix", ["bin", "txt"])
@pytest.mark.parametrize("model", COEFFICIENTS)
def test_rays_meet_the_image_where_colmap_says(tmp_path, model, suffix):
    """COLMAP puts the first pixel's centre at (0.5, 0.5). The rays are up to 60 degrees off the optical axis."""
    pycolmap = pytest.importorskip("pycolmap")
    camera = pycolmap.Camera(model=model, width=W, height=H, params=parameters(model))
    x, y = np.random.default_rng(0).uniform(-1.2, 1.2, (2, 500))
    x[0] = y[0] = 0.0
    expected = camera.img_from_cam(np.stack([x, y, np.ones(500)], axis=1))
    found = pixels(lens_of_model(model, tmp_path, suffix), x, y)
    np.testing.assert_allclose(found, expected - 0.5, rtol=0, atol=1e-10)


@pytest.mark.parametrize("omega", [1e-12, 0.3, -0.9, 1.5])
def test_the_field_of_view_model_near_its_limits(omega):
    pycolmap = pytest.importorskip("pycolmap")
    camera = pycolmap.Camera(model="FOV", width=W, height=H, params=[90, 90, 80, 60, omega])
    rays = np.array([[0.0, 0.0], [1e-10, 0.0], [1e-7, -1e-7], [0.3, 0.4], [-3.0, 2.0]])
    expected = camera.img_from_cam(np.column_stack([rays, np.ones(5)]))
    found = pixels(Lens(W, H, 90.0, 90.0, 79.5, 59.5, (omega,), "field of view"), *rays.T)
    np.testing.assert_allclose(found, expected - 0.5, rtol=0, atol=1e-6)


def test_rays_beyond_a_models_radius_have_no_image():
    """The division model with k = 0.2 ends at r = 1 / sqrt(0.8) = 1.118, and EUCM with beta < 0 at beta r² = -1."""
    x, y = np.array([1.11, 1.12]), np.zeros(2)
    a, b = FORMULAS["division"].image(x, y, np.array([0.2]))
    assert np.isfinite([a[0], b[0]]).all() and np.isnan(a[1])
    a, _ = FORMULAS["enhanced unified"].image(x, y, np.array([0.5, -0.8]))
    assert np.isfinite(a[0]) and np.isnan(a[1])
    a, _ = FORMULAS["enhanced unified"].image(
        x, y, np.array([-9.0, 1.0])
    )  # its denominator is negative everywhere
    assert np.isnan(a).all()


@pytest.mark.parametrize("model", NEW)
def test_the_pinhole_is_as_wide_as_the_photo_allows(tmp_path, model):
    """Every pixel is valid, and one of the two axes touches the rectangle of directions."""
    lens = lens_of_model(model, tmp_path)
    pinhole, (columns, rows, valid) = lens.undistorted(), whole(lens)
    assert valid.mean() > 0.995
    assert pinhole.fx / pinhole.fy == pytest.approx(lens.fx / lens.fy, rel=1e-12)
    room = (columns.min(), W - 1 - columns.max(), rows.min(), H - 1 - rows.max())
    assert min(room) < 1.0


@pytest.mark.parametrize("model", OPENCV)
def test_the_formulas_of_opencvs_models_give_opencvs_maps(model):
    coefficients = (-0.1, 0.03, 0.004, -0.003)
    lens = Lens(W, H, 90.0, 94.0, 82.5, 56.5, coefficients, model)
    pinhole = lens.undistorted()
    y, x = np.mgrid[:H, :W]
    found = pixels(lens, (x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy)
    np.testing.assert_allclose(found, np.stack(whole(lens)[:2], axis=-1), rtol=0, atol=1e-4)


def test_our_rectangle_of_directions_is_opencvs():
    """OpenCV examines nine points of each edge of a perspective lens."""
    lens = Lens(W, H, 90.0, 94.0, 82.5, 56.5, (-0.2, 0.05, 0.01, -0.02))
    ours, theirs = ray_rectangle(lens, MAX_ANGLE), opencv_rectangle(lens)
    np.testing.assert_allclose(ours, theirs, rtol=0.01)


@pytest.mark.parametrize("model", [name for name in COEFFICIENTS if "PINHOLE" not in name])
def test_rays_of_pixels_are_the_formulas_inverse(tmp_path, model):
    lens = lens_of_model(model, tmp_path)
    columns, rows = np.random.default_rng(1).uniform(0, (W - 1, H - 1), (50, 2)).T
    found = pixels(lens, *lens.rays(columns, rows))
    np.testing.assert_allclose(found, np.stack([columns, rows], axis=-1), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "lens",
    [
        Lens(640, 480, 205.0, 205.0, 319.5, 239.5, (), "fisheye"),  # 180 degrees
        Lens(640, 480, 150.0, 150.0, 319.5, 239.5, (), "fisheye"),  # 245 degrees
        Lens(640, 480, 150.0, 150.0, 319.5, 239.5, (0.01, 0.0, 0.001), "thin prism fisheye"),
        Lens(640, 480, 100.0, 100.0, 319.5, 239.5, (0.6, 1.1), "enhanced unified"),
    ],
)
def test_photos_wider_than_a_pinhole_are_cropped(lens):
    """The pinhole sees 60 degrees to each side. Every pixel shows a part of the photo, and none is from behind the
    camera."""
    pinhole, (columns, rows, valid) = lens.undistorted(), whole(lens)
    half = max(
        (pinhole.cx + 0.5) / pinhole.fx, (pinhole.cy + 0.5) / pinhole.fy
    )  # both centres are in the middle
    assert math.atan(half) == pytest.approx(CROPPED_ANGLE, abs=0.02)
    assert valid.all() and lens.cropped
    assert (np.diff(columns, axis=1) > 0).all() and (
        np.diff(rows, axis=0) > 0
    ).all()  # no wrapping and no mirroring


def test_a_photo_is_cropped_to_the_radius_of_its_model():
    """The photo shows a circle of rays of radius 1 / sqrt(3.6) = 0.527, and all pixels of the pinhole are inside it."""
    lens = Lens(640, 480, 300.0, 300.0, 319.5, 239.5, (0.9,), "division")
    pinhole, (_, _, valid) = lens.undistorted(), whole(lens)
    y, x = np.mgrid[:480, :640]
    radius = np.hypot((x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy)
    assert not valid[radius > 0.53].any() and valid[radius < 0.5].all()


def test_cropping_is_reported(one_photo):
    photo = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    values = {"camera_model": "OPENCV_FISHEYE", "fl_x": 20.5, "fl_y": 20.5}
    (note,) = [note for note in map(str, load_dataset(one_photo(photo, **values)).notes) if "cropped" in note]
    assert note == "1 of 1 photos see more than 140 degrees and are cropped to 120, first images/a.png"
    notes = [
        str(note) for note in load_dataset(one_photo(photo, **values | {"fl_x": 40.0, "fl_y": 40.0})).notes
    ]
    assert not [note for note in notes if "cropped" in note]


@pytest.mark.parametrize("resolution", [None, 2.0])
@pytest.mark.parametrize("model", NEW)
def test_dots_alpha_and_masks_lie_where_the_pinhole_puts_them(tmp_path, model, resolution):
    """A dot per colour channel, one in alpha and one in the mask are found at u = fx x + cx of the view's camera.
    Another convention of pixel centres would be off by 0.5 px, at half the size by 0.25 px. A mask takes the nearest
    pixel, which is at most 0.71 px away.
    """
    lens = lens_of_model(model, tmp_path)
    rays = np.array([[-0.31, -0.22], [0.27, 0.19], [0.05, -0.24], [-0.1, 0.2], [0.3, -0.1]])
    at = pixels(lens, *rays.T)
    y, x = np.mgrid[:H, :W]
    distance = np.hypot(x[..., None] - at[:, 0], y[..., None] - at[:, 1])
    soft = np.round(250 * np.exp(-(distance**2) / (2 * 2.5**2))).astype(np.uint8)
    photo = np.concatenate([soft[..., :3], 255 - soft[..., 3:4]], axis=2)
    model_folder = tmp_path / "sparse" / "0"
    for folder in (model_folder, tmp_path / "images", tmp_path / "masks"):
        folder.mkdir(parents=True)
    Image.fromarray(photo).save(tmp_path / "images" / "a.png")
    Image.fromarray(np.where(distance[..., 4] < 8, 0, 255).astype(np.uint8)).save(
        tmp_path / "masks" / "a.png"
    )
    line = f"1 {model} {W} {H} {' '.join(map(repr, parameters(model)))}\n"
    (model_folder / "cameras.txt").write_text(line)
    (model_folder / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    (view,) = load_dataset(tmp_path, DataSettings(resolution=resolution, test_every=0, background=None)).train
    seen, camera = view.read(), view.camera
    rows, columns = np.mgrid[: camera.H, : camera.W]
    planes = [*np.moveaxis(np.asarray(seen.image), 2, 0), 255.0 - seen.alpha]
    inside = np.hypot(columns - camera.W / 2, rows - camera.H / 2) < 0.45 * camera.W
    for i, (plane, ray) in enumerate(zip(planes, rays, strict=False)):
        weight = np.where(inside & (plane > 5), plane, 0.0)
        found = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        expected = np.array([camera.fx * ray[0] + camera.cx, camera.fy * ray[1] + camera.cy])
        np.testing.assert_allclose(found, expected, rtol=0, atol=0.15, err_msg=f"channel {i}")
    if resolution is None:
        there = pixels(lens, (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy)
        away = np.hypot(there[..., 0] - at[4, 0], there[..., 1] - at[4, 1])
        assert not seen.mask[away < 8 - 0.75].any() and seen.mask[(away > 8 + 0.75) & inside].all()
