"""Every layout is written and read back; each returns the same cameras and pixels that were written."""

from pathlib import Path

import numpy as np
import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.writers import write_blender, write_colmap, write_transforms
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.views import View

EVERYTHING = DataSettings(test_every=0)


def assert_same_camera(actual, expected, atol=1e-9):
    """Text keeps doubles exactly; 1e-9 allows for the roundings of R -> quaternion -> R and of R'(R e)."""
    for name in ("R", "eye", "fx", "fy", "cx", "cy"):
        np.testing.assert_allclose(
            getattr(actual, name), getattr(expected, name), rtol=0, atol=atol, err_msg=name
        )
    assert (actual.W, actual.H) == (expected.W, expected.H)


def by_stem(views):
    return {Path(view.name).stem: view for view in views}


@pytest.mark.parametrize("layout", ["colmap", "text", "transforms", "blender"])
def test_written_captures_are_read_unchanged(written, small, layout):
    views, points, colors = small
    dataset = load_dataset(written(layout), EVERYTHING)
    found = by_stem(dataset.train)
    assert len(found) == len(views) and dataset.test == ()
    for view in views:
        match = found[Path(view.name).stem]
        assert_same_camera(match.camera, view.camera)
        np.testing.assert_array_equal(match.image, view.image)
        assert match.read().alpha is None and match.read().mask is None
    np.testing.assert_array_equal(dataset.origin, np.zeros(3))
    if layout != "blender":
        np.testing.assert_allclose(dataset.points, points, rtol=0, atol=1e-12)
        np.testing.assert_allclose(dataset.colors, colors, rtol=0, atol=0.5 / 255 + 1e-12)
        assert dataset.notes == ()


def test_the_layouts_agree(written):
    """The formats have different axes and pixel centres, but the cameras read from them are equal."""
    colmap, others = load_dataset(written("colmap"), EVERYTHING), ("text", "transforms", "blender")
    for layout in others:
        other = by_stem(load_dataset(written(layout), EVERYTHING).train)
        for view in colmap.train:
            match = other[Path(view.name).stem]
            assert_same_camera(match.camera, view.camera)
            np.testing.assert_array_equal(match.image, view.image)
    assert load_dataset(written("blender")).layout == "Blender"
    assert load_dataset(written("text")).layout == colmap.layout == "COLMAP"
    assert load_dataset(written("transforms")).layout == "transforms.json"


def test_intrinsics_that_differ_and_are_off_centre(tmp_path):
    """COLMAP and transforms.json can store two image sizes, fx != fy and principal points off the centre."""
    rng = np.random.default_rng(3)
    views = []
    for i, (W, H) in enumerate([(20, 12), (15, 30), (20, 12)]):
        camera = Camera(look_at((i, 0.3, -3), (0, 0, 0)), (i, 0.3, -3), 21.0 + i, 19.5, 8.25, 7.5 + i, H, W)
        views.append(View(camera, rng.integers(0, 256, (H, W, 3), dtype=np.uint8), name=f"{i}.png"))
    write_colmap(tmp_path / "b", views, np.zeros((1, 3)), np.zeros((1, 3)))
    write_colmap(tmp_path / "t", views, np.zeros((1, 3)), np.zeros((1, 3)), binary=False)
    write_transforms(tmp_path / "j", views)
    for folder in "btj":
        dataset = load_dataset(tmp_path / folder, EVERYTHING)
        for view, expected in zip(dataset.train, views, strict=True):
            assert_same_camera(view.camera, expected.camera)
            np.testing.assert_array_equal(view.image, expected.image)
    with pytest.raises(ArgumentError, match="centred principal point"):
        write_blender(tmp_path / "x", views, [])


def test_alpha_and_masks_make_the_round_trip(tmp_path):
    rng = np.random.default_rng(5)
    camera = Camera(np.eye(3), (0, 0, -3), 10, 10, 4.5, 2.5, 6, 10)
    view = View(
        camera,
        rng.integers(0, 256, (6, 10, 3), dtype=np.uint8),
        alpha=rng.integers(0, 256, (6, 10), dtype=np.uint8),
        mask=rng.random((6, 10)) < 0.5,
        name="sub/a.png",
    )
    write_colmap(tmp_path / "c", [view], np.zeros((1, 3)), np.zeros((1, 3)))
    write_transforms(tmp_path / "t", [view])
    for folder in "ct":
        (back,) = load_dataset(tmp_path / folder, DataSettings(background=None)).train
        photo, truth = back.read(), view.read()
        for name in ("image", "alpha", "mask"):
            np.testing.assert_array_equal(getattr(photo, name), getattr(truth, name))
        over = load_dataset(tmp_path / folder, DataSettings(background=(1, 1, 1))).train[0].read()
        np.testing.assert_array_equal(over.image, truth.over((1, 1, 1)))
        assert over.alpha is None


def test_the_procedural_scene_has_no_symmetry(truth):
    """No view is its neighbour's mirror image, so swapped axes cannot pass the other tests."""
    views = truth[0]
    assert len(views) == 24 and views[0].image.shape == (48, 64, 3)
    for view in views:
        image = view.image.astype(float)
        assert image.max() > 150 and image.min() == 0
        for flipped in (image[::-1], image[:, ::-1], image[::-1, ::-1]):
            assert np.abs(image - flipped).mean() > 5
