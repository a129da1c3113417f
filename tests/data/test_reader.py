"""All datasets derived from one reader see what the reader has read first."""

from dataclasses import replace

import numpy as np
import pytest

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.dataset import Dataset, load_dataset
from gsplat_edu.data.points import write_points_ply
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.runs.dataset import reader_for
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.train.config import recipe

SETTINGS = (
    DataSettings(),
    DataSettings(resolution=2),
    DataSettings(resolution=33, test_every=3, background=None, image_memory=10_000),
    DataSettings(train_views=("view_001.png", "view_004.png"), test_views=("view_002.png",)),
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    write_colmap(folder, *procedural_capture(48, 9, splats=60))
    return folder


@pytest.mark.parametrize("with_points", [False, True])
def test_a_derived_dataset_equals_that_of_a_new_reader(capture, tmp_path, with_points):
    points = tmp_path / "points.ply" if with_points else None
    if points is not None:
        write_points_ply(points, Cloud(np.eye(3), np.full((3, 3), 0.5)))
    reader = CaptureReader(capture)
    for settings in (*SETTINGS, SETTINGS[0]):
        a = Dataset.of(reader, settings, points=points)
        b = load_dataset(capture, settings, points=points)
        for name in ("path", "layout", "notes", "files", "measured"):
            assert getattr(a, name) == getattr(b, name)
        np.testing.assert_array_equal(a.points, b.points)
        assert len(a.points) == (3 if with_points else 40)
        for one, other in zip((*a.train, *a.test), (*b.train, *b.test), strict=True):
            assert one.name == other.name and (one.image == other.image).all()
            assert one.camera.intrinsics == other.camera.intrinsics
            np.testing.assert_array_equal(one.camera.eye, other.camera.eye)
        assert (len(a.train), a.images.budget) == (len(b.train), b.images.budget)


def test_nothing_is_read_before_it_is_needed(tmp_path):
    reader = CaptureReader(tmp_path / "later")
    with pytest.raises(DatasetError, match="later"):
        Dataset.of(reader)
    write_colmap(tmp_path / "later", *procedural_capture(24, 5, splats=20))
    assert len(Dataset.of(reader).train) == 4


def test_a_photo_that_changes_between_two_datasets_is_noticed(tmp_path):
    write_colmap(tmp_path, *procedural_capture(48, 9, splats=60))
    reader = CaptureReader(tmp_path)
    Dataset.of(reader, DataSettings(resolution=2)).preload()
    photo = tmp_path / "images" / "view_003.png"
    photo.write_bytes(photo.read_bytes() + b" ")
    with pytest.raises(DatasetError, match=r"view_003\.png: has changed since it was first read"):
        Dataset.of(reader).preload()
    Dataset.of(CaptureReader(tmp_path)).preload()


def test_a_reader_of_another_capture_is_refused(capture, tmp_path):
    given = CaptureReader(capture)
    options = RunOptions(capture, tmp_path / "run", recipe(1), DataSettings())
    assert reader_for(options, given) is given
    assert reader_for(options, None).path == capture
    with pytest.raises(ArgumentError, match="reader: reads"):
        reader_for(replace(options, data=tmp_path), given)
