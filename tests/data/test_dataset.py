"""The steps that all captures share: detection, split, origin, start points, settings, preloading."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.blocks.plan import measured_area
from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.dataset import DataSettings, load_dataset, scene_extent
from gsplat_edu.data.images import ImageStore, PhotoFile
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.points import read_points_ply, write_points_ply
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.visible_cloud import cloud_in_view
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.parts.sky.find import scene_size
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.views import View


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"resolution": 0.5}, "resolution"),
        ({"resolution": float("nan")}, "resolution"),
        ({"resolution": float("inf")}, "resolution"),
        ({"test_every": 1}, "test_every"),
        ({"test_every": -2}, "test_every"),
        ({"background": (0.0, 0.0, 1.5)}, r"background\[2\]"),
        ({"background": (0.0, 0.0)}, "background"),
        ({"image_memory": -1}, "image_memory"),
    ],
)
def test_invalid_settings_are_refused(as_shipped, values, word):
    with pytest.raises(ArgumentError, match=word):
        DataSettings(**values)


@pytest.mark.parametrize("name", ["nothing", "empty", "photos", "photos/images"])
def test_a_folder_without_a_capture_names_what_is_missing(tmp_path, name):
    (tmp_path / "empty").mkdir()
    (tmp_path / "photos" / "images").mkdir(parents=True)
    Image.new("RGB", (4, 4)).save(tmp_path / "photos" / "images" / "a.JPG")
    with pytest.raises(DatasetError) as caught:
        load_dataset(tmp_path / name)
    message = str(caught.value)
    assert str(tmp_path / name) in message and "\n" not in message
    if name == "empty":
        assert "sparse/0" in message and "transforms.json" in message
    if name.startswith("photos"):
        assert "no camera poses" in message and "colmap" in message


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_a_model_is_found_in_each_place(written, tmp_path, place):
    folder = written("colmap")
    model = folder / "model"
    shutil.move(folder / "sparse" / "0", model)
    shutil.rmtree(folder / "sparse")
    (folder / place).mkdir(parents=True, exist_ok=True)
    for file in model.iterdir():
        shutil.move(file, folder / place)
    assert len(load_dataset(folder).train) == 7


def test_the_model_folder_itself_may_be_given(written):
    folder = written("colmap")
    assert len(load_dataset(folder / "sparse" / "0").train) == 7


def test_both_kinds_of_poses(written, small):
    folder = written("colmap")
    write_transforms(folder, small[0][:5])
    dataset = load_dataset(folder)
    assert dataset.layout == "transforms.json" and len(dataset.train) + len(dataset.test) == 5
    assert any("transforms.json and a COLMAP model" in note for note in map(str, dataset.notes))


def test_several_models_are_reported(written):
    folder = written("colmap")
    (folder / "sparse" / "1").mkdir()
    assert any(
        "2 models: 0 (9 photos) is read, 1 (unreadable) not" in note
        for note in map(str, load_dataset(folder).notes)
    )


def test_every_eighth_view_by_name_is_held_out(written, small):
    folder, names = written("colmap"), sorted(view.name for view in small[0])
    dataset = load_dataset(folder)
    assert [v.name for v in dataset.test] == [names[0], names[8]]
    assert [v.name for v in dataset.train] == names[1:8]
    third = load_dataset(folder, DataSettings(test_every=3))
    assert [v.name for v in third.test] == names[::3] and len(third.train) == 6
    everything = load_dataset(folder, DataSettings(test_every=0))
    assert [v.name for v in everything.train] == names and everything.test == ()


def test_one_photo_is_trained_on(tmp_path, small):
    write_transforms(tmp_path, small[0][:1])
    dataset = load_dataset(tmp_path)
    assert len(dataset.train) == 1 and dataset.test == ()
    assert any("one photo" in note for note in map(str, dataset.notes))
    assert any("no points: starting from 100,000 random points" in note for note in map(str, dataset.notes))
    assert np.isfinite(dataset.points).all()
    with pytest.raises(DatasetError, match="for training"):
        load_dataset(tmp_path, DataSettings(test_every=8))


def test_the_split_of_the_capture_is_used(tmp_path, small):
    views = small[0]
    names = [f"images/{view.name}" for view in views]
    write_transforms(tmp_path, views, extra={"train_filenames": names[:4], "test_filenames": names[6:]})
    dataset = load_dataset(tmp_path)
    assert [v.name for v in dataset.train] == names[:4] and [v.name for v in dataset.test] == names[6:]
    assert any("2 of 9 photos are in none" in note for note in map(str, dataset.notes))
    assert len(load_dataset(tmp_path, DataSettings(test_every=0)).train) == 9  # another split is requested
    write_transforms(tmp_path, views, extra={"val_filenames": names[:2]})
    assert [v.name for v in load_dataset(tmp_path).train] == names[2:]
    write_transforms(tmp_path, views, extra={"test_filenames": names})
    with pytest.raises(DatasetError, match="none of its 9 photos for training"):
        load_dataset(tmp_path)


def test_far_coordinates_are_moved_to_the_origin(tmp_path, small):
    """The offset is an integer, so distances at 1e5 keep all but their last bits (1e-11)."""
    views, points, colors = small
    shift = np.array([1e5, -2.5e5, 3e4])
    moved = []
    for v in views:
        c = v.camera
        camera = Camera(c.R, c.eye + shift, c.fx, c.fy, c.cx, c.cy, c.H, c.W)
        moved.append(View(camera, v.image, name=v.name))
    for write in (write_colmap, write_transforms):
        folder = tmp_path / write.__name__
        write(folder, moved, points + shift, colors)
        dataset = load_dataset(folder, DataSettings(test_every=0))
        np.testing.assert_array_equal(
            dataset.origin, np.round(np.mean([v.camera.eye for v in moved], axis=0))
        )
        for view, before in zip(dataset.train, moved, strict=True):
            # COLMAP stores -R e. Numbers near 2.5e5 are rounded by 3e-11, and three products are summed twice.
            np.testing.assert_allclose(view.camera.eye + dataset.origin, before.camera.eye, rtol=0, atol=1e-9)
            assert np.abs(view.camera.eye).max() < 10
        np.testing.assert_allclose(dataset.points + dataset.origin, points + shift, rtol=0, atol=1e-9)
        assert any("coordinates are large" in note for note in map(str, dataset.notes))


def test_points_from_another_file(written, tmp_path, small):
    cloud = Cloud(np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0]]), np.array([[0.2, 0.4, 0.6]] * 2))
    write_points_ply(tmp_path / "p.ply", cloud)
    dataset = load_dataset(written("colmap"), points=tmp_path / "p.ply")
    np.testing.assert_array_equal(dataset.points, [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(dataset.colors, [[0.2, 0.4, 0.6]], atol=1e-12)
    assert any("1 of 2 points are NaN" in note for note in map(str, dataset.notes))
    with pytest.raises(DatasetError, match=r"none\.ply"):
        load_dataset(written("colmap"), points=tmp_path / "none.ply")


def test_random_points_are_the_same_each_time(tmp_path, small):
    write_transforms(tmp_path, small[0])
    dataset, again = load_dataset(tmp_path), load_dataset(tmp_path)
    assert len(dataset.points) == 100_000
    np.testing.assert_array_equal(dataset.points, again.points)
    np.testing.assert_array_equal(dataset.colors, again.colors)
    assert 0 <= dataset.colors.min() < 0.01 and 0.99 < dataset.colors.max() <= 1


def test_parallel_cameras_have_their_points_in_front(tmp_path):
    pixels = np.zeros((4, 4, 3), np.uint8)
    eyes = [(0.0, 0, 0), (2.0, 0, 0)]
    views = [
        View(Camera(np.eye(3), e, 4, 4, 1.5, 1.5, 4, 4), pixels, name=f"{i}.png") for i, e in enumerate(eyes)
    ]
    write_transforms(tmp_path, views)
    points = load_dataset(tmp_path, DataSettings(test_every=0)).points
    assert points[:, 2].min() > 1 and abs(np.median(points[:, 0]) - 1) < 0.1


def test_extent():
    cameras = [Camera(np.eye(3), (x, 0, 0), 4, 4, 1.5, 1.5, 4, 4) for x in (0.0, 1.0, 5.0)]
    assert scene_extent(cameras) == pytest.approx(1.1 * 3.0)
    assert scene_extent(cameras[:1]) == 1.0 and scene_extent([cameras[2]] * 3) == 1.0
    with pytest.raises(ArgumentError, match="cameras"):
        scene_extent([])


@pytest.mark.parametrize(("others", "counts"), [(0, False), (2, False), (3, True)])
def test_the_extent_ignores_a_camera_far_away_unless_it_has_company(others, counts):
    """16 cameras on a circle of radius 1, one 100 units away, and some near that: a drone's photos are no mistake."""
    turns = 2.0 * np.pi * np.arange(16) / 16
    ring = np.stack([np.cos(turns), np.sin(turns), np.zeros(16)], axis=1)
    away = np.array([(100.0, i, 0.0) for i in range(1 + others)])
    eyes = np.concatenate([ring, away])
    used = eyes if counts else ring
    expected = 1.1 * max(np.sqrt(((used - used.mean(axis=0)) ** 2).sum(axis=1)))
    cameras = [Camera(np.eye(3), eye, 4, 4, 1.5, 1.5, 4, 4) for eye in eyes]
    assert scene_extent(cameras) == pytest.approx(expected, rel=1e-12)


def test_sizes_that_follow_the_cameras_ignore_strays():
    """The radius of a sky and the centre of the ground are those without the camera whose pose is wrong."""
    views, points, _ = procedural_capture(size=16, count=12)
    cameras = [view.camera for view in views]
    one = cameras[5]
    wrong = Camera(one.R, np.array([4e4, 0.0, 9e3]), one.fx, one.fy, one.cx, one.cy, one.H, one.W)
    spoiled = [*cameras, wrong]
    assert scene_size(spoiled, points) == scene_size(cameras, points)
    assert measured_area(cameras, points).low == measured_area([*cameras, wrong], points).low
    assert len(cloud_in_view(spoiled).points) and np.abs(cloud_in_view(spoiled).points).max() < 100.0


def test_invalid_poses_name_the_frame(tmp_path, small):
    write_transforms(tmp_path, small[0])
    path = tmp_path / "transforms.json"
    contents = json.loads(path.read_text())
    good = np.array(contents["frames"][4]["transform_matrix"])
    far = good.copy()
    far[0, 3] = 1e15
    bad = {
        "NaN": np.where(np.eye(4)[1] * np.eye(4)[0][:, None] > 0, np.nan, good),
        "absurdly far": far,
        "scaled by 2": good * np.array([2, 2, 2, 1]),
        "mirrors": good * np.array([-1, 1, 1, 1]),
        "not orthonormal": good * np.array([1, 1.1, 1, 1]),
        "last row": good + np.diag([0, 0, 0, 1]),
    }
    for what, matrix in bad.items():
        contents["frames"][4]["transform_matrix"] = matrix.tolist()
        path.write_text(json.dumps(contents))
        dataset = load_dataset(tmp_path, DataSettings(test_every=0))
        assert len(dataset.train) == 8 and "images/view_004.png" not in {view.name for view in dataset.train}
        note = str(dataset.notes[0])
        assert (
            note.startswith("1 of 9 photos has an unusable pose")
            and "images/view_004.png (" in note
            and what in note
        )


def test_a_rotation_with_few_digits_is_made_orthonormal(tmp_path, small):
    write_transforms(tmp_path, small[0])
    path = tmp_path / "transforms.json"
    contents = json.loads(path.read_text())
    for frame in contents["frames"]:
        frame["transform_matrix"] = np.round(frame["transform_matrix"], 3).tolist()
    path.write_text(json.dumps(contents))
    for view, truth in zip(load_dataset(tmp_path, DataSettings(test_every=0)).train, small[0], strict=True):
        R = view.camera.R
        np.testing.assert_allclose(R @ R.T, np.eye(3), rtol=0, atol=1e-14)
        # Nine roundings of at most 5e-4 have a norm of at most 1.5e-3. Since the true rotation is as near to the
        # rounded matrix, so is the nearest rotation.
        np.testing.assert_allclose(R, truth.camera.R, rtol=0, atol=2 * 1.5e-3)


def test_preload_keeps_what_fits_and_counts(written):
    folder, seen = written("colmap"), []
    dataset = load_dataset(folder)
    assert len(dataset.images) == 0
    dataset.preload(lambda done, total: seen.append((done, total)))
    assert seen == [(i + 1, 9) for i in range(9)]
    assert len(dataset.images) == 9 and dataset.images.nbytes == 9 * 24 * 18 * 3
    assert dataset.train[0].read() is dataset.train[0].read()


def test_photos_over_the_memory_budget_are_read_again_unchanged(written):
    folder = written("colmap")
    roomy, tight = load_dataset(folder), load_dataset(folder, DataSettings(image_memory=3 * 24 * 18 * 3 + 5))
    tight.preload()
    assert len(tight.images) == 3 and tight.images.nbytes == 3 * 24 * 18 * 3
    for a, b in zip(roomy.train, tight.train, strict=True):
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(b.image, b.image)
    assert len(tight.images) == 3


def test_photos_that_do_not_fit_in_memory_are_reported(written):
    folder = written("colmap")
    assert not any("memory" in note for note in map(str, load_dataset(folder).notes))
    (note,) = [
        str(note) for note in load_dataset(folder, DataSettings(image_memory=9 * 24 * 18 * 3 - 1)).notes
    ]
    assert "take 0.01112 MiB of memory" in note and "--image-memory" in note and "--resolution" in note
    assert load_dataset(folder, DataSettings(image_memory=9 * 24 * 18 * 3)).notes == ()
    assert load_dataset(folder, DataSettings(image_memory=9 * 12 * 9 * 3, resolution=2.0)).notes == ()


def test_photos_decoded_at_once_are_limited_by_their_size(monkeypatch):
    """At most 64 megapixels are decoded at once: five photos of 12 megapixels, or one of 100."""
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    for W, H, workers in ((4000, 3000, 5), (10_000, 10_000, 1), (100, 100, 64)):
        lens = Lens(W, H, 1000.0, 1000.0, 0.0, 0.0)
        source = PhotoFile(Path("a.jpg"), None, lens, 20, 10, None)
        assert ImageStore(0, [source]).workers == workers
        assert ImageStore(0, [source] * 3).needed == 3 * 20 * 10 * 3
    assert ImageStore(0, []).workers == 64


@pytest.mark.parametrize(
    ("name", "mask", "background", "planes"),
    [
        ("a.png", None, (0.0, 0.0, 0.0), 3),
        ("a.png", None, None, 4),
        ("a.JPG", None, None, 3),
        ("a.png", Path("m.png"), None, 6),
        ("a.jpg", Path("m.png"), None, 5),
    ],
)
def test_memory_for_photos_includes_alpha_that_is_kept(name, mask, background, planes):
    """A random background changes at every step, so alpha is kept, which a JPEG does not have. A reduced mask has two
    planes: cells that count entirely, and cells that are excluded entirely."""
    source = PhotoFile(Path(name), mask, Lens(40, 20, 30.0, 30.0, 0.0, 0.0), 20, 10, background)
    assert ImageStore(0, [source] * 3).needed == 3 * 20 * 10 * planes


@pytest.mark.parametrize("resolution", [None, 2.0])
def test_ready_made_sizes_are_used_if_there_are_no_full_photos(written, resolution):
    """Only images_2 and images_4 exist. The sizes of the files decide, so no photo is halved twice."""
    for layout in ("colmap", "transforms"):
        folder = written(layout)
        for factor in (2, 4):
            (folder / f"images_{factor}").mkdir()
            for file in (folder / "images").iterdir():
                pixels = np.full((18 // factor, 24 // factor, 3), 10 * factor, np.uint8)
                Image.fromarray(pixels).save(folder / f"images_{factor}" / file.name)
        shutil.rmtree(folder / "images")
        dataset = load_dataset(folder, DataSettings(resolution=resolution, test_every=0))
        assert len(dataset.train) == 9 and any(
            "intrinsics rescaled" in note for note in map(str, dataset.notes)
        )
        for view in dataset.train:
            assert view.image.shape == (9, 12, 3) and (view.image == 20).all()
            assert view.camera.fx == pytest.approx(1.15 * 12)
        four = load_dataset(folder, DataSettings(resolution=4.0, test_every=0))
        assert four.train[0].image.shape == (4, 6, 3) and (four.train[0].image == 40).all()


@pytest.mark.parametrize("name", ["x" * 300, "x" * 300 + ".json", "a\0b"])
def test_impossible_file_names_are_refused(tmp_path, name):
    with pytest.raises(DatasetError, match="is neither a folder nor"):
        load_dataset(tmp_path / name)
    with pytest.raises(DatasetError, match="give a point cloud"):
        read_points_ply(tmp_path / name)


def test_a_photo_whose_name_is_too_long_is_missing(written):
    folder = written("text")
    path = folder / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace("view_003.png", "x" * 300))
    assert any("1 of 9 photos have no file" in note for note in map(str, load_dataset(folder).notes))


@pytest.mark.parametrize("place", ["images", "sparse"])
def test_a_folder_that_cannot_be_read_is_named(written, place, monkeypatch):
    folder, listed = written("colmap"), Path.iterdir
    if place == "images":
        shutil.rmtree(folder / "sparse")

    def iterdir(self):
        if self.name == place:
            raise PermissionError(13, "Permission denied")
        return listed(self)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    with pytest.raises(DatasetError, match=rf"{place}: cannot be read \(Permission denied\)"):
        load_dataset(folder)


def test_preload_names_the_corrupt_photo(written, as_shipped):
    folder = written("colmap")
    file = folder / "images" / "view_005.png"
    file.write_bytes(file.read_bytes()[:-60])
    dataset = load_dataset(folder)  # the headers are intact
    with pytest.raises(DatasetError, match=r"view_005\.png: cannot be decoded"):
        dataset.preload()


def test_a_camera_with_uneven_pixels_is_reported(tmp_path):
    camera = Camera(look_at((0, 0, -3), (0, 0, 0)), (0, 0, -3), 40, 20, 3.5, 3.5, 8, 8)
    write_transforms(tmp_path, [View(camera, np.zeros((8, 8, 3), np.uint8), name="a.png")])
    assert any("calibration may be wrong" in note for note in map(str, load_dataset(tmp_path).notes))


def test_views_with_one_centre_are_held_out_together(tmp_path, small):
    """Four panoramas have three faces each, whose names are not ordered by place; their centres agree to float
    precision."""
    views, points, colors = small
    places = [3, 0, 0, 1, 2, 3, 0, 1, 3]
    moved = [
        View(
            Camera.posed(view.camera.R, views[place].camera.eye, view.camera.intrinsics),
            view.image,
            name=view.name,
        )
        for view, place in zip(views, places, strict=True)
    ]
    write_colmap(tmp_path, moved, points, colors)
    dataset = load_dataset(tmp_path, DataSettings(test_every=2))
    held = {int(view.name[5:8]) for view in dataset.test}
    # Ordered by names, the places are 3, 0, 1, 2; every second one is held out, 3 and 1.
    assert held == {0, 3, 5, 7, 8}
    said = "9 photos have 4 centres, like the faces of panoramas: those with one centre are held out together"
    assert said in map(str, dataset.notes)


def test_a_single_panorama_is_split_by_faces(tmp_path, small):
    """All views have one centre, so holding them out together would leave nothing to train on."""
    views, points, colors = small
    moved = [
        View(
            Camera.posed(view.camera.R, views[0].camera.eye, view.camera.intrinsics),
            view.image,
            name=view.name,
        )
        for view in views
    ]
    write_colmap(tmp_path, moved, points, colors)
    dataset = load_dataset(tmp_path)
    assert len(dataset.test) == 2 and len(dataset.train) == 7
    assert not any("centres" in note for note in map(str, dataset.notes))
