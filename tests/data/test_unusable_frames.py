"""Frames whose pose or camera cannot be used are left out and named, in every layout; so is a photo listed twice."""

import json
import os
import shutil
import struct

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.notes import OtherModels, RepeatedPhotos, UnusablePhotos
from gsplat_edu.data.sparse_depth import tracked_points

EVERYTHING = DataSettings(test_every=0)


def bad_image_txt(folder, values):
    """Replace the first pose values of view_004 in images.txt."""
    path = folder / "sparse" / "0" / "images.txt"
    lines = path.read_text().split("\n")
    (at,) = (i for i, line in enumerate(lines) if line.endswith("view_004.png"))
    words = lines[at].split(" ")
    lines[at] = " ".join([words[0], *values, *words[1 + len(values) :]])
    path.write_text("\n".join(lines))


def bad_image_bin(folder, values):
    """Replace the first pose values of view_004 in images.bin: it is the name that ends the entry's head."""
    path = folder / "sparse" / "0" / "images.bin"
    data = bytearray(path.read_bytes())
    start = data.index(b"view_004.png\0") - struct.calcsize("<I7dI") + 4
    data[start : start + 8 * len(values)] = struct.pack(f"<{len(values)}d", *map(float, values))
    path.write_bytes(data)


def bad_frame(folder, change, file="transforms.json"):
    path = folder / file
    contents = json.loads(path.read_text())
    (frame,) = (f for f in contents["frames"] if "view_004" in f["file_path"])
    change(frame)
    path.write_text(json.dumps(contents))


def poisoned(matrix_entry):
    def change(frame):
        frame["transform_matrix"][0][3] = matrix_entry

    return change


def of_cameras(folder, line):
    """Give view_004 its own camera in cameras.txt."""
    cameras, images = folder / "sparse" / "0" / "cameras.txt", folder / "sparse" / "0" / "images.txt"
    cameras.write_text(cameras.read_text() + f"77 {line}\n")
    images.write_text(images.read_text().replace(" 1 view_004", " 77 view_004"))


BREAK = {
    "text, NaN": ("text", lambda f: bad_image_txt(f, ["nan"])),
    "text, NaN of Visual C++": ("text", lambda f: bad_image_txt(f, ["1", "0", "0", "0", "-nan(ind)"])),
    "text, no rotation": ("text", lambda f: bad_image_txt(f, ["0", "0", "0", "0"])),
    "text, far": ("text", lambda f: bad_image_txt(f, ["1", "0", "0", "0", "1e15"])),
    "text, NaN camera": ("text", lambda f: of_cameras(f, "PINHOLE 24 18 nan 30 12 9")),
    "text, camera of Visual C++": ("text", lambda f: of_cameras(f, "PINHOLE 24 18 1.#QNAN -1.#IND 12 9")),
    "text, infinite camera": ("text", lambda f: of_cameras(f, "PINHOLE 24 18 30 30 inf 9")),
    "text, negative focal length": ("text", lambda f: of_cameras(f, "SIMPLE_PINHOLE 24 18 -30 12 9")),
    "text, no size": ("text", lambda f: of_cameras(f, "SIMPLE_PINHOLE 0 18 30 12 9")),
    "text, NaN distortion": ("text", lambda f: of_cameras(f, "SIMPLE_RADIAL 24 18 30 12 9 nan")),
    "binary, NaN": ("colmap", lambda f: bad_image_bin(f, ["nan"])),
    "binary, infinite": ("colmap", lambda f: bad_image_bin(f, ["1", "0", "0", "0", "inf"])),
    "binary, no rotation": ("colmap", lambda f: bad_image_bin(f, ["0", "0", "0", "0"])),
    "transforms, NaN": ("transforms", lambda f: bad_frame(f, poisoned(float("nan")))),
    "transforms, far": ("transforms", lambda f: bad_frame(f, poisoned(-1e13))),
    "transforms, no matrix": ("transforms", lambda f: bad_frame(f, lambda d: d.pop("transform_matrix"))),
    "transforms, NaN camera": ("transforms", lambda f: bad_frame(f, lambda d: d.update(fl_x=float("nan")))),
    "transforms, infinite camera": (
        "transforms",
        lambda f: bad_frame(f, lambda d: d.update(cy=float("-inf"))),
    ),
    "Blender, NaN": ("blender", lambda f: bad_frame(f, poisoned(float("nan")), "transforms_train.json")),
    "Blender, infinite": ("blender", lambda f: bad_frame(f, poisoned(float("inf")), "transforms_train.json")),
}


@pytest.mark.parametrize("how", BREAK)
def test_one_unusable_frame_is_left_out_and_named(written, how):
    layout, damage = BREAK[how]
    folder = written(layout)
    whole = load_dataset(folder, EVERYTHING)
    names = {view.name for view in whole.train}
    damage(folder)
    dataset = load_dataset(folder, EVERYTHING)
    (note,) = (note for note in dataset.notes if isinstance(note, UnusablePhotos))
    ((name, reason),) = note.problems
    assert "view_004" in name and reason and str(folder) not in reason
    assert {view.name for view in dataset.train} == names - {name} and note.total == len(names) == 9
    assert name in str(note)


@pytest.mark.parametrize(
    "how", ["text, NaN", "text, NaN camera", "binary, NaN", "transforms, NaN", "Blender, NaN"]
)
def test_commands_work_on_such_a_capture(written, how, capsys):
    layout, damage = BREAK[how]
    folder = written(layout)
    damage(folder)
    for command in (["info", str(folder)], ["doctor", str(folder)]):
        assert main(command) == 0
        assert "view_004" in capsys.readouterr().out
    assert main(["leave-out", str(folder), "view_003.png"]) == 0
    assert "1 of 8 photos are left out" in capsys.readouterr().out
    names = [view.name for view in load_dataset(folder, EVERYTHING).train]
    assert len(names) == 7 and not any("view_003" in name or "view_004" in name for name in names)


@pytest.mark.parametrize("layout", ["text", "transforms", "blender"])
def test_a_capture_without_usable_frames_is_an_error_of_one_line(written, layout, capsys):
    folder = written(layout)
    if layout == "text":
        path = folder / "sparse" / "0" / "cameras.txt"
        path.write_text("1 PINHOLE 24 18 nan nan nan nan\n")
    else:
        for path in folder.glob("transforms*.json"):
            contents = json.loads(path.read_text())
            for frame in contents["frames"]:
                poisoned(float("nan"))(frame)
            path.write_text(json.dumps(contents))
    with pytest.raises(
        DatasetError, match="none of the other . photos has a usable pose and camera either"
    ) as caught:
        load_dataset(folder)
    assert "\n" not in str(caught.value)
    assert main(["info", str(folder)]) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_an_unused_camera_of_nan_is_ignored(written):
    for layout in ("text", "colmap"):
        folder = written(layout)
        model = folder / "sparse" / "0"
        if layout == "text":
            path = model / "cameras.txt"
            path.write_text(path.read_text() + "9 PINHOLE 165 124 -nan(ind) -nan(ind) -nan(ind) -nan(ind)\n")
        else:
            data = (model / "cameras.bin").read_bytes()
            (count,) = struct.unpack("<Q", data[:8])
            unused = struct.pack("<IiQQ4d", 9, 1, 165, 124, *[float("nan")] * 4)
            (model / "cameras.bin").write_bytes(struct.pack("<Q", count + 1) + data[8:] + unused)
        dataset = load_dataset(folder, EVERYTHING)
        assert len(dataset.train) == 9 and dataset.notes == ()


def doubled(folder, change, file="transforms.json", into=None):
    """List view_002 a second time, changed."""
    contents = json.loads((folder / file).read_text())
    (frame,) = (f for f in contents["frames"] if "view_002" in f["file_path"])
    second = json.loads(json.dumps(frame))
    change(second)
    path = folder / (into or file)
    contents = json.loads(path.read_text())
    contents["frames"].append(second)
    path.write_text(json.dumps(contents))


@pytest.mark.parametrize(
    "spelled", ["images/view_002.png", "./images/../images/view_002.png", "images/view_002"]
)
def test_a_photo_listed_twice_is_used_once(written, spelled):
    folder = written("transforms")
    doubled(folder, lambda frame: frame.update(file_path=spelled))
    dataset = load_dataset(folder, DataSettings(test_every=2))
    photos = [os.path.normpath(source.path) for _, source in dataset.files]
    assert len(photos) == len(set(photos)) == 9 == len(dataset.train) + len(dataset.test)
    (note,) = (note for note in dataset.notes if isinstance(note, RepeatedPhotos))
    assert (
        str(note)
        == "1 of 9 photos is listed more than once: only its first entry counts (images/view_002.png)"
    )


def test_a_photo_with_two_poses_is_left_out(written):
    folder = written("transforms")

    def moved(frame):
        frame["transform_matrix"][2][3] += 0.25

    doubled(folder, moved)
    dataset = load_dataset(folder, EVERYTHING)
    assert len(dataset.train) == 8
    (note,) = (note for note in dataset.notes if isinstance(note, UnusablePhotos))
    assert note.problems == (("images/view_002.png", "is listed 2 times, with different poses or cameras"),)


def test_a_photo_of_two_parts_of_a_blender_scene_is_only_trained_on(written):
    folder = written("blender")
    contents = json.loads((folder / "transforms_train.json").read_text())
    first = contents["frames"][0]
    path = folder / "transforms_test.json"
    tested = json.loads(path.read_text())
    before = len(tested["frames"])
    path.write_text(json.dumps({**tested, "frames": [*tested["frames"], first]}))
    dataset = load_dataset(folder)
    assert len(dataset.test) == before and len(dataset.train) == len(contents["frames"])
    assert not {view.name for view in dataset.test} & {view.name for view in dataset.train}


def smaller(model, target, count):
    """Write the first images of a model in text as another model."""
    shutil.copytree(model, target)
    lines = [line for line in (model / "images.txt").read_text().split("\n") if "view_" in line]
    (target / "images.txt").write_text("".join(f"{line}\n\n" for line in lines[:count]))


@pytest.mark.parametrize("layout", ["text", "binary"])
def test_the_model_with_the_most_photos_is_read(written, layout):
    folder = written("text")
    sparse = folder / "sparse"
    (sparse / "0").rename(sparse / "4")
    for number, count in ((0, 3), (2, 1)):
        smaller(sparse / "4", sparse / str(number), count)
    if layout == "binary":
        shutil.copytree(written("colmap") / "sparse" / "0", sparse / "4", dirs_exist_ok=True)
    for given in (folder, sparse):
        dataset = load_dataset(given, EVERYTHING)
        assert len(dataset.train) == 9
        (note,) = (note for note in dataset.notes if isinstance(note, OtherModels))
        assert str(note) == f"{sparse} holds 3 models: 4 (9 photos) is read, 0 (3 photos), 2 (1 photo) not"
    assert len(load_dataset(sparse / "0", EVERYTHING).train) == 3, "a model that is named is read"
    assert tracked_points(folder, least_views=1) is not None


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_transforms_with_a_byte_order_mark(written, ending):
    folder = written("transforms")
    poses = [view.camera.R for view in load_dataset(folder, EVERYTHING).train]
    path = folder / "transforms.json"
    text = json.dumps(json.loads(path.read_text()), indent=1).replace("\n", ending)
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    np.testing.assert_array_equal([view.camera.R for view in load_dataset(folder, EVERYTHING).train], poses)


@pytest.mark.parametrize(
    ("name", "photos"), [("nan_frame", 23), ("nan_unused_camera", 24), ("two_models", 24)]
)
def test_the_captures_that_fell(real, name, photos):
    assert len(load_dataset(real(f"fell/{name}"), EVERYTHING).train) == photos


def cropped(folder, name="view_004.png"):
    path = folder / "images" / name
    with Image.open(path) as image:
        image.crop((0, 0, image.width // 2, image.height)).save(path)


UNFIT = {
    "cropped": (cropped, "another aspect ratio"),
    "lens": (
        lambda folder: of_cameras(folder, "SIMPLE_RADIAL 24 18 30 12 9 50"),
        "focal length would change",
    ),
}


@pytest.mark.parametrize("how", UNFIT)
def test_a_photo_that_does_not_fit_its_camera_is_left_out_and_named(written, how):
    damage, said = UNFIT[how]
    folder = written("text")
    whole = load_dataset(folder)
    damage(folder)
    dataset = load_dataset(folder)
    (note,) = (note for note in dataset.notes if isinstance(note, UnusablePhotos))
    ((name, reason),) = note.problems
    assert name == "view_004.png" and said in reason and note.total == 9
    for part in ("train", "test"):  # the split of the others does not change
        names = [view.name for view in getattr(whole, part)]
        assert [view.name for view in getattr(dataset, part)] == [each for each in names if each != name]


def test_unusable_poses_and_unfit_photos_are_one_note(written):
    folder = written("text")
    bad_image_txt(folder, ["nan"])
    cropped(folder, "view_002.png")
    (note,) = (note for note in load_dataset(folder).notes if isinstance(note, UnusablePhotos))
    assert [name for name, _ in note.problems] == ["view_004.png", "view_002.png"] and note.total == 9


def test_a_capture_of_unfit_photos_only_is_one_line(written, capsys):
    folder = written("text")
    for path in (folder / "images").iterdir():
        cropped(folder, path.name)
    assert main(["train", str(folder), "--out", str(folder / "run"), "--iterations", "1"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "another aspect ratio" in line and not (folder / "run").exists()


@pytest.mark.parametrize("name", ["view_004.png", "images/view_004.png"])
def test_leave_out_says_that_an_unusable_photo_is_left_out_already(written, name, capsys):
    folder = written("text")
    bad_image_txt(folder, ["nan"])
    assert main(["leave-out", str(folder), name]) == 2
    said = capsys.readouterr().err
    assert f"{name} is left out already" in said and "nan" in said.lower() and "has no photo" not in said
    assert main(["leave-out", str(folder), "view_999.png"]) == 2
    assert "has no photo" in capsys.readouterr().err
