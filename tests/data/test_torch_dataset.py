"""Views in torch's DataLoader: the same bytes from any number of workers, forked or spawned, whole and cropped."""

import multiprocessing
import pickle
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.base.locks import ThreadLock
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.torch_dataset import ViewDataset
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.projection import Projection
from gsplat_edu.scene.shutter import AT_ONCE, RollingShutter
from gsplat_edu.scene.views import View

WAYS = [way for way in ("fork", "spawn") if way in multiprocessing.get_all_start_methods()]


@pytest.fixture
def dataset(written):
    return load_dataset(written("colmap"), DataSettings(test_every=4))


def contents(batches):
    return [
        (
            batch.names,
            batch.images.numpy().tobytes(),
            batch.masks.numpy().tobytes(),
            [(c.cx, c.cy, c.H, c.W, c.eye.tobytes()) for c in batch.cameras],
        )
        for batch in batches
    ]


def loaded(views, workers=0, way=None, **options):
    context = way if workers else None
    return DataLoader(
        views,
        batch_size=2,
        num_workers=workers,
        multiprocessing_context=context,
        collate_fn=ViewDataset.collate,
        timeout=120 if workers else 0,
        **options,
    )


def test_a_pickled_dataset_has_the_same_photos_and_cameras(dataset):
    dataset.preload()
    again = pickle.loads(pickle.dumps(dataset))
    assert len(dataset.images) == 9 and len(again.images) == 0, "photos do not travel; workers read them"
    assert [view.name for view in again.train] == [view.name for view in dataset.train]
    for view, copy in zip((*dataset.train, *dataset.test), (*again.train, *again.test), strict=True):
        assert np.array_equal(view.image, copy.image) and view.camera.cx == copy.camera.cx
    assert len(again.images) == 9, "the views share one cache, as before"
    assert again.images.nbytes == dataset.images.nbytes


def test_views_in_memory_scaled_and_with_a_region_can_be_pickled(written, small):
    region = (0.0, 0.0, 0.0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0.3, 0.3, 0.3)
    boxed = load_dataset(written("colmap"), DataSettings(region=region)).train[0]
    memory = View(small[0][0].camera, small[0][0].image, name="memory")
    for view in (memory, memory.scaled(2.0), boxed, boxed.scaled(1.5)):
        photo, copy = view.read(), pickle.loads(pickle.dumps(view)).read()
        assert np.array_equal(photo.image, copy.image)
        assert (photo.mask is None) == (copy.mask is None)
        assert photo.mask is None or np.array_equal(photo.mask, copy.mask)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.own_process
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_workers_give_the_bytes_of_none(dataset, way):
    """The parent has read photos before, by several threads: forked workers inherit its locks and OpenCV's threads."""
    dataset.preload()
    views = dataset.torch("train", crop=(12, 16), seed=3)
    expected = contents(loaded(views))
    assert contents(loaded(views, 2, way)) == expected
    assert {image.shape for image, *_ in (views[0], views[-1])} == {(12, 16, 3)}


@pytest.mark.skipif("fork" not in WAYS, reason="needs fork")
@pytest.mark.own_process
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_process_forked_while_photos_are_read_does_not_hang(dataset):
    """Another thread holds every lock of threads at the moment of the fork."""
    held, release = threading.Event(), threading.Event()
    lock = ThreadLock()

    def hold():
        with lock:
            held.set()
            release.wait(60)

    with ThreadPoolExecutor(1) as pool:
        holding = pool.submit(hold)
        held.wait(60)
        child = multiprocessing.get_context("fork").Process(target=lock.__enter__)
        child.start()
        child.join(60)
        code = child.exitcode
        if code is None:
            child.kill()
        release.set()
        holding.result()
    assert code == 0


def test_a_pickled_lock_is_free_and_another_one():
    lock = ThreadLock()
    with lock:
        copy = pickle.loads(pickle.dumps(lock))
        with copy:
            assert copy is not lock


def test_the_tensors_are_the_photo_from_0_to_1(dataset):
    views = dataset.torch("test")
    item, view = views[0], dataset.test[0]
    assert len(views) == len(dataset.test) and item.name == view.name and item.camera is view.camera
    assert item.image.dtype == torch.float32
    assert np.array_equal(np.round(item.image.numpy() * 255), view.image)
    assert item.mask.all() and item.mask.shape == view.image.shape[:2]
    batch = ViewDataset.collate([views[0], views[1]])
    assert batch.images.shape == (2, *view.image.shape) and len(batch.cameras) == 2


def test_a_transparent_photo_lies_over_the_background():
    camera = Camera.looking_at((0, 0, -3), (0, 0, 0), 10, 10, 2, 2)
    alpha, mask = np.array([[0, 255], [255, 255]], np.uint8), np.array([[True, False], [True, True]])
    view = View(camera, np.zeros((2, 2, 3), np.uint8), alpha=alpha, mask=mask)
    image, _, counts, _ = ViewDataset([view], background=(1, 0.2, 0))[0]
    assert torch.equal(image[0, 0], torch.tensor([255, 51, 0]) / 255.0) and not image[1].any()
    assert np.array_equal(counts.numpy(), mask)


def test_a_crop_shows_what_the_photo_shows(dataset):
    view = dataset.train[0]
    part = dataset.torch("train", crop=(6, 10), corner=(5, 7))[0]
    assert np.array_equal(np.round(part.image.numpy() * 255), view.image[5:11, 7:17])
    whole, crop = view.camera, part.camera
    assert (crop.H, crop.W, crop.cx, crop.cy) == (6, 10, whole.cx - 7, whole.cy - 5)
    assert np.allclose(crop.rays(), whole.rays()[5:11, 7:17], atol=1e-12)


def test_random_corners_follow_the_seed_and_the_epoch(dataset):
    def corners(views):
        return [(view.camera.cx, view.camera.cy) for view in views]

    first = dataset.torch(crop=(6, 10))
    assert corners(first) == corners(dataset.torch(crop=(6, 10)))
    assert corners(first) != corners(dataset.torch(crop=(6, 10), seed=1))
    before = corners(first)
    first.set_epoch(1)
    assert corners(first) != before
    assert repr(first) == f"ViewDataset({len(first)} views, crops of 10x6 px)"


@pytest.mark.skipif("fork" not in WAYS, reason="needs fork")
@pytest.mark.own_process
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_workers_that_live_on_see_the_next_epoch(dataset):
    views = dataset.torch(crop=(6, 10))
    loader = loaded(views, 1, "fork", persistent_workers=True)
    first = contents(loader)
    views.set_epoch(5)
    assert contents(loader) == contents(loaded(views)) != first


def test_mistakes_are_named(as_shipped, dataset):
    for options, message in (
        ({"split": "val"}, "split"),
        ({"crop": (12, 200)}, r"^crop: 200x12 px at row 0, column 0 is not within the image of 24x18 px$"),
        ({"crop": (0, 8)}, r"crop\[0\]"),
        ({"corner": (0, 0)}, "corner: is that of a crop"),
        ({"crop": (4, 4), "corner": (-1, 0)}, r"corner\[0\]"),
        ({"seed": -1}, "seed"),
    ):
        with pytest.raises(ArgumentError, match=message):
            dataset.torch(**options)
    with pytest.raises(ShapeError, match="crop"):
        dataset.torch(crop=(4, 4, 4))
    views = dataset.torch()
    with pytest.raises(IndexError):
        views[len(views)]
    small = ViewDataset([dataset.train[0].scaled(2.0)])
    with pytest.raises(ArgumentError, match=r"^batch: its photos differ in size; give crop"):
        ViewDataset.collate([views[0], small[0]])


def test_cameras_that_have_no_part_are_refused():
    camera = Camera.looking_at((0, 0, -3), (0, 0, 0), 10, 10, 8, 8)
    rolling = RollingShutter((0, 0.01, 0), (0, 0, 0), "down")
    blurred = RollingShutter((0, 0.01, 0), (0, 0, 0), AT_ONCE, 0.5)
    for whole in (Camera.panorama(np.eye(3), (0, 0, 0), 8, 16), camera.through(shutter=rolling)):
        with pytest.raises(ArgumentError, match="crop: a panorama, or a photo with a rolling shutter"):
            whole.cropped(0, 0, 4, 4)
        assert whole.cropped(0, 0, whole.H, whole.W).readout == whole.readout
    fisheye = camera.through(Projection("fisheye"), blurred).cropped(1, 2, 4, 4)
    assert fisheye.projection.kind == "fisheye" and fisheye.exposure == 0.5 and fisheye.cx == camera.cx - 2
