"""transforms.json and Blender's files: dialects, missing values, and the source of the points."""

import json
import re
import shutil

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.writers import write_blender, write_colmap, write_transforms

EVERYTHING = DataSettings(test_every=0)
PIXELS = np.full((20, 30, 3), 80, np.uint8)
NOISE = np.random.default_rng(2).integers(0, 256, (20, 30, 3), dtype=np.uint8)


@pytest.fixture
def edited(tmp_path, small):
    """Write the small capture and let `change` edit the contents of transforms.json."""

    def write(change):
        write_transforms(tmp_path, *small)
        path = tmp_path / "transforms.json"
        contents = json.loads(path.read_text())
        change(contents)
        path.write_text(json.dumps(contents))
        return tmp_path

    return write


def camera_of(folder):
    return load_dataset(folder).train[0].camera


def test_intrinsics_of_the_whole_file_and_their_defaults(one_photo):
    """cx and cy default to the centre of the image. Files put the first pixel's centre at (0.5, 0.5), we at (0, 0)."""
    camera = camera_of(one_photo(PIXELS, fl_x=25.0))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (25.0, 25.0, 14.5, 9.5)
    camera = camera_of(one_photo(PIXELS, fl_x=25.0, fl_y=26.0, cx=13.0, cy=11.5))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (25.0, 26.0, 12.5, 11.0)


def test_fields_of_view(one_photo):
    """A field of view of 90 degrees has a focal length of half the size."""
    right, path = np.pi / 2, one_photo(PIXELS, camera_angle_x=np.pi / 2) / "transforms.json"
    contents = json.loads(path.read_text())
    del contents["fl_x"], contents["w"], contents["h"]  # the size then comes from the image
    path.write_text(json.dumps(contents))
    camera = camera_of(path)
    assert camera.fx == pytest.approx(15.0) and camera.fy == pytest.approx(15.0)
    path.write_text(json.dumps({**contents, "camera_angle_y": right}))
    camera = camera_of(path)
    assert camera.fx == pytest.approx(15.0) and camera.fy == pytest.approx(10.0)
    path.write_text(json.dumps({**contents, "fl_x": 40.0}))
    assert camera_of(path).fx == camera_of(path).fy == 40.0
    del contents["camera_angle_x"]
    path.write_text(json.dumps(contents))
    with pytest.raises(DatasetError, match=r"frame images/a\.png: neither it nor the file has fl_x"):
        load_dataset(path)


def test_a_frame_overrides_the_file(edited):
    def change(contents):
        contents["fl_x"], contents["cx"] = 999.0, 1.0
        for frame in contents["frames"][1:]:
            del frame["fl_x"], frame["cx"]

    dataset = load_dataset(edited(change), EVERYTHING)
    assert dataset.train[0].camera.fx == pytest.approx(1.15 * 24) and dataset.train[0].camera.cx == 11.5
    assert {(v.camera.fx, v.camera.cx) for v in dataset.train[1:]} == {(999.0, 0.5)}


def test_axes(one_photo):
    """OpenGL's camera looks along -z with +y up, so the identity looks along -z of a world with +y up."""
    camera = camera_of(one_photo(PIXELS))
    np.testing.assert_array_equal(camera.R, np.diag([1.0, -1.0, -1.0]))
    u, v, z = camera.project(camera.world_to_cam([(0.2, 0.1, -2.0)]))
    assert z[0] == 2.0 and u[0] > camera.cx and v[0] < camera.cy  # right and up are unchanged


@pytest.mark.parametrize("ending", [".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".Jpeg", ".webp", ".TIF"])
def test_names_without_an_ending(one_photo, ending):
    folder = one_photo(PIXELS)
    Image.fromarray(PIXELS).save(folder / "images" / f"b{ending}")
    path = folder / "transforms.json"
    path.write_text(path.read_text().replace("images/a.png", "./images/b"))
    (view,) = load_dataset(folder).train
    assert view.name == "images/b" and view.image.shape == (20, 30, 3)


def test_a_syntax_error_has_a_place(tmp_path):
    (tmp_path / "transforms.json").write_text('{\n "frames": [\n  {"file_path": }\n ]\n}')
    with pytest.raises(DatasetError, match=r"transforms\.json, line 3 column 17: is not JSON"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("content", [b"[]", b"{}", b'{"frames": 3}', b"\xff\xfe\x00", b"[" * 100_000, b""])
def test_an_invalid_transforms_json_is_refused(tmp_path, content):
    (tmp_path / "transforms.json").write_bytes(content)
    with pytest.raises(DatasetError, match=r"transforms\.json") as caught:
        load_dataset(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("transform_matrix", None, r"view_004\.png \(has no transform_matrix"),
        ("transform_matrix", [[1, 2], [3, 4]], r"view_004\.png \(transform_matrix is not a 3x4 or 4x4"),
        ("transform_matrix", [[1], [3, 4]], r"view_004\.png \(transform_matrix is not a 3x4 or 4x4"),
        ("transform_matrix", "x", r"view_004\.png \(transform_matrix is not a 3x4 or 4x4"),
        ("fl_x", -3.0, r"view_004\.png \(focal length fx is -3"),
        ("fl_x", "abc", r"view_004\.png \(fl_x is abc"),
        ("fl_x", float("nan"), r"view_004\.png \(fl_x is nan"),
        ("cy", float("inf"), r"view_004\.png \(cy is inf"),
        ("w", 0, r"view_004\.png \(w is 0"),
        ("h", 17.5, r"view_004\.png \(h is 17.5"),
        ("k1", [1], r"view_004\.png \(k1 is "),
    ],
)
def test_a_frame_with_invalid_values_is_left_out_and_named(edited, key, value, message):
    def change(contents):
        contents["frames"][4][key] = value
        if value is None:
            del contents["frames"][4][key]

    dataset = load_dataset(edited(change), DataSettings(test_every=0))
    assert len(dataset.train) == 8 and "images/view_004.png" not in {view.name for view in dataset.train}
    note = str(dataset.notes[0])
    assert note.startswith("1 of 9 photos has an unusable pose or camera and is left out: images/")
    assert re.search(message, note)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("file_path", None, "frame 4: has no file_path"),
        ("file_path", 7, "frame 4: has no file_path"),
        ("camera_model", "EQUIRECTANGULAR", r"view_004\.png: camera_model 'EQUIRECTANGULAR' is not"),
        ("camera_model", ["x"], r"view_004\.png: camera_model"),
        ("mask_path", "no.png", r"view_004\.png: its mask .*no\.png does not exist"),
    ],
)
def test_invalid_values_name_the_frame_and_the_key(edited, key, value, message):
    def change(contents):
        contents["frames"][4][key] = value
        if value is None:
            del contents["frames"][4][key]

    with pytest.raises(DatasetError, match=message):
        load_dataset(edited(change))


def test_a_split_that_is_not_a_list_is_refused(edited):
    with pytest.raises(DatasetError, match="test_filenames is not a list"):
        load_dataset(edited(lambda contents: contents.update(test_filenames=3)))


def test_missing_photos(edited):
    folder = edited(lambda contents: None)
    for i in (0, 3, 8):
        (folder / "images" / f"view_00{i}.png").unlink()
    dataset = load_dataset(folder, EVERYTHING)
    assert len(dataset.train) == 6
    assert tuple(map(str, dataset.notes)) == (
        "3 of 9 photos have no file: skipped, first images/view_000.png",
    )
    shutil.rmtree(folder / "images")
    with pytest.raises(DatasetError, match=r"none of its 9 photos has a file, first images/view_000\.png"):
        load_dataset(folder)
    (folder / "transforms.json").write_text('{"frames": []}')
    with pytest.raises(DatasetError, match="lists no frames"):
        load_dataset(folder)


def test_the_file_may_be_given_instead_of_its_folder(edited):
    folder = edited(lambda contents: None)
    (folder / "transforms.json").rename(folder / "other.json")
    assert len(load_dataset(folder / "other.json", EVERYTHING).train) == 9


def test_a_ply_is_in_the_frame_of_the_poses(edited, small):
    """The poses and the PLY already include applied_transform, so the PLY is not moved again."""
    transform = [[0, 1, 0, 3.0], [1, 0, 0, -2.0], [0, 0, -1, 0.5]]
    dataset = load_dataset(edited(lambda contents: contents.update(applied_transform=transform)))
    np.testing.assert_array_equal(dataset.points, small[1])
    folder = edited(lambda contents: contents.update(ply_file_path="lost.ply"))
    with pytest.raises(DatasetError, match=r"lost\.ply"):
        load_dataset(folder)


def test_colmaps_points_are_moved_by_applied_transform(tmp_path, small):
    views, points, colors = small
    write_colmap(tmp_path, views, points, colors)
    write_transforms(tmp_path, views)
    # the file does not say how the two frames are related
    assert len(load_dataset(tmp_path).points) == 100_000
    transform = np.array([[0, 1, 0, 3.0], [0, 0, 1, -2.0], [1, 0, 0, 0.5]])  # not symmetric
    write_transforms(tmp_path, views, extra={"applied_transform": transform.tolist()})
    dataset = load_dataset(tmp_path)
    expected = np.stack([points[:, 1] + 3, points[:, 2] - 2, points[:, 0] + 0.5], axis=1)
    np.testing.assert_allclose(dataset.points, expected, rtol=0, atol=1e-12)
    write_transforms(tmp_path, views, extra={"applied_transform": [[1, 2]]})
    with pytest.raises(DatasetError, match="applied_transform"):
        load_dataset(tmp_path)


def test_distortion_keys(one_photo):
    """is_fisheye and camera_model are equivalent, and PINHOLE without coefficients has no distortion."""
    assert camera_of(one_photo(PIXELS, camera_model="PINHOLE")).fx == 30
    fisheye = camera_of(one_photo(PIXELS, camera_model="OPENCV_FISHEYE", k1=0.05))
    assert fisheye.fx == camera_of(one_photo(PIXELS, is_fisheye=True, k1=0.05)).fx != 30
    assert any("distortion" in note for note in map(str, load_dataset(one_photo(PIXELS, k1=0.05)).notes))


def test_blenders_splits(tmp_path, small):
    """The files define the training and test views. Without a test file, val is used; an explicit split overrides
    both."""
    views = small[0]
    write_blender(tmp_path, views[3:], views[:3])
    dataset = load_dataset(tmp_path)
    assert [v.name for v in dataset.train] == [f"train/view_00{i}" for i in range(3, 9)]
    assert [v.name for v in dataset.test] == [f"test/view_00{i}" for i in range(3)]
    assert np.abs(dataset.points).max() <= 1.3 and 50_000 < len(dataset.points) <= 100_000
    (tmp_path / "transforms_test.json").rename(tmp_path / "transforms_val.json")
    assert len(load_dataset(tmp_path).test) == 3
    (tmp_path / "transforms_val.json").unlink()
    assert len(load_dataset(tmp_path).test) == 0 and len(load_dataset(tmp_path).train) == 6
    assert len(load_dataset(tmp_path, DataSettings(test_every=3)).test) == 2
    shutil.rmtree(tmp_path / "train")
    with pytest.raises(DatasetError, match=r"transforms_train\.json: none of its 6 photos"):
        load_dataset(tmp_path)


def merged_camera(one_photo, whole, frame):
    path = one_photo(PIXELS) / "transforms.json"
    contents = json.loads(path.read_text())
    del contents["fl_x"]
    contents.update(whole)
    contents["frames"][0].update(frame)
    path.write_text(json.dumps(contents))
    camera = camera_of(path)
    return camera.fx, camera.fy


@pytest.mark.parametrize(
    ("whole", "frame", "focal"),
    [
        ({"fl_x": 99.0, "fl_y": 98.0}, {"camera_angle_x": np.pi / 2}, (15.0, 15.0)),
        ({"camera_angle_x": 1.0, "camera_angle_y": 1.0}, {"fl_x": 40.0}, (40.0, 40.0)),
        ({"fl_x": 99.0, "fl_y": 98.0}, {"fl_x": 40.0}, (40.0, 40.0)),
        ({"fl_x": 99.0, "fl_y": 98.0}, {"fl_y": 40.0}, (99.0, 40.0)),
        ({"fl_x": 99.0, "fl_y": 98.0}, {"camera_angle_y": np.pi / 2}, (99.0, 10.0)),
        ({"fl_x": 99.0}, {"fl_x": None}, (99.0, 99.0)),
        ({"fl_x": 99.0, "camera_angle_y": np.pi / 2}, {}, (99.0, 10.0)),
    ],
)
def test_a_frames_own_focal_length_wins_in_any_form(one_photo, whole, frame, focal):
    assert merged_camera(one_photo, whole, frame) == pytest.approx(focal)


@pytest.mark.parametrize(
    ("model", "terms"), [("SIMPLE_RADIAL", {"k1": 0.05}), ("RADIAL", {"k1": 0.05, "k2": 0.01})]
)
def test_radial_models_are_opencvs_with_fewer_terms(one_photo, model, terms):
    radial = load_dataset(one_photo(NOISE, camera_model=model, **terms)).train[0]
    image, camera = radial.image, radial.camera
    opencv = load_dataset(one_photo(NOISE, camera_model="OPENCV", p1=0.0, **terms)).train[0]
    assert camera.fx == opencv.camera.fx != 30
    np.testing.assert_array_equal(image, opencv.image)


NULLS = ("camera_model", "cx", "cy", "k1", "fl_y", "is_fisheye", "train_filenames", "test_filenames")
NULLS += ("val_filenames", "ply_file_path", "applied_transform", "applied_scale", "mask_path")


def test_null_counts_as_missing(one_photo):
    camera = camera_of(one_photo(PIXELS))
    path = one_photo(PIXELS, **dict.fromkeys(NULLS)) / "transforms.json"
    contents = json.loads(path.read_text())
    contents["frames"][0].update(dict.fromkeys((*NULLS, "w", "h")))
    path.write_text(json.dumps(contents))
    found = camera_of(path)
    assert (found.fx, found.fy, found.cx, found.cy) == (camera.fx, camera.fy, camera.cx, camera.cy)


def test_val_is_not_trained_on(tmp_path, small):
    views = small[0]
    names = [f"images/{view.name}" for view in views]
    write_transforms(tmp_path, views, extra={"val_filenames": names[:2], "test_filenames": names[6:]})
    dataset = load_dataset(tmp_path)
    assert [v.name for v in dataset.train] == names[2:6] and [v.name for v in dataset.test] == names[6:]
    assert any(
        "2 of 9 photos are in none of the capture's training and test lists" in n
        for n in map(str, dataset.notes)
    )


def test_blenders_val_is_left_out_and_reported(tmp_path, small):
    write_blender(tmp_path, small[0][3:], small[0][:3])
    assert not any("val" in note for note in map(str, load_dataset(tmp_path).notes))
    shutil.copy(tmp_path / "transforms_test.json", tmp_path / "transforms_val.json")
    dataset = load_dataset(tmp_path)
    assert len(dataset.train) == 6 and len(dataset.test) == 3
    assert any(
        note.startswith("transforms_val.json: its photos are ignored") for note in map(str, dataset.notes)
    )


@pytest.mark.parametrize(
    ("extra", "why"),
    [
        ({}, "does not give applied_transform"),
        ({"applied_transform": np.eye(4).tolist(), "applied_scale": 0.5}, "has poses scaled by 0.5"),
    ],
)
def test_a_note_says_why_colmaps_points_are_not_used(tmp_path, small, extra, why):
    views, points, colors = small
    write_colmap(tmp_path, views, points, colors)
    write_transforms(tmp_path, views, extra=extra)
    dataset = load_dataset(tmp_path)
    assert len(dataset.points) == 100_000
    (note,) = [note for note in map(str, dataset.notes) if "random points" in note]
    assert "points of the COLMAP model in" in note and why in note and "has no points" not in note
    write_transforms(tmp_path, views, extra={"applied_transform": np.eye(4).tolist(), "applied_scale": 1.0})
    np.testing.assert_array_equal(load_dataset(tmp_path).points, points)
