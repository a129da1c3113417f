"""The page's reader of captures, in node, says what Python's says about the same files."""

import json
import shutil
import subprocess
import zipfile
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from gsplat_edu.data.colmap_files import MODELS
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap, write_transforms

W, H = 24, 18
SCRIPT = Path(__file__).with_name("read_capture.js")

WRITERS = {
    "colmap": write_colmap,
    "text": lambda folder, views, points, colors: write_colmap(folder, views, points, colors, binary=False),
    "transforms": write_transforms,
}


@pytest.fixture(scope="module")
def small():
    return procedural_capture(W, 17, splats=60)


@pytest.fixture
def written(tmp_path, small):
    def write(layout):
        WRITERS[layout](tmp_path / "capture", *small)
        return tmp_path / "capture"

    return write


def read(place):
    """Return what the page's reader says of a folder or a zip file."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    command = [node, "--no-warnings", str(SCRIPT), str(place), str(W), str(H)]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def refused(place):
    found = read(place)
    assert list(found) == ["error"], found
    assert found["error"].endswith(".") and "\n" not in found["error"]
    return found["error"]


def check_agrees(found, folder, pinhole_error=1e-9):
    """Compare with Python's dataset: names, split, poses and points, and pinholes up to an error in px.

    Both compute in float64, so poses differ by rounding: entries of R by some 1e-16, centres by the same relative to
    their size, below 10.
    """
    dataset = load_dataset(folder, DataSettings(lens="undistort"))
    for part, views in (("train", dataset.train), ("test", dataset.test)):
        mine = [view for view in found["views"] if view["part"] == part]
        assert [view["name"].split("/")[-1] for view in mine] == [view.name.split("/")[-1] for view in views]
        for one, view in zip(mine, views, strict=True):
            camera, pinhole = view.camera, one["pinhole"]
            np.testing.assert_allclose(np.reshape(one["R"], (3, 3)), camera.R, rtol=0, atol=1e-14)
            np.testing.assert_allclose(one["eye"], camera.eye, rtol=0, atol=1e-13)
            assert (pinhole["W"], pinhole["H"]) == (camera.W, camera.H)
            for name in ("fx", "fy", "cx", "cy"):
                assert abs(pinhole[name] - getattr(camera, name)) <= pinhole_error, name
    return dataset


@pytest.mark.parametrize("layout", WRITERS)
def test_poses_split_and_points_are_those_of_python(written, layout):
    folder = written(layout)
    found = read(folder)
    dataset = check_agrees(found, folder)
    assert len(dataset.test) == 3
    assert found["layout"] == dataset.layout and found["notes"] == []
    np.testing.assert_array_equal(np.reshape(found["cloud"]["points"], (-1, 3)), dataset.points)
    np.testing.assert_allclose(
        np.reshape(found["cloud"]["colors"], (-1, 3)), dataset.colors, rtol=0, atol=1e-15
    )


DISTORTED = {
    "SIMPLE_RADIAL": "1 SIMPLE_RADIAL 24 18 26 12 9 -0.05",
    "RADIAL": "1 RADIAL 24 18 26 12 9 0.06 -0.02",
    "OPENCV": "1 OPENCV 24 18 26 25 12.4 8.7 -0.05 0.01 0.002 -0.001",
    "FULL_OPENCV": "1 FULL_OPENCV 24 18 26 25 12.4 8.7 -0.03 0.01 0 0 0.001 0.01 0 0",
}


@pytest.mark.parametrize("model", DISTORTED)
def test_distorted_photos_get_the_pinhole_of_python(written, model):
    """OpenCV inverts the lens by five steps of a fixed point, whose error shrinks by |k1 r²| < 0.02 each: below 1e-8.

    It follows nine points of each edge, we 65. Only tangential terms put the innermost ray between two of the nine. It
    then differs by at most the bend p r² of the edge, 0.002 * 0.35, times the square of the distance to one of them
    relative to the half edge, (1/8)²: 1e-5 of 26 px.
    """
    folder = written("text")
    (folder / "sparse/0/cameras.txt").write_text(DISTORTED[model] + "\n")
    images = folder / "sparse/0/images.txt"
    lines = [line.split() for line in images.read_text().splitlines() if line.endswith(".png")]
    images.write_text("".join(" ".join([*words[:8], "1", words[9]]) + "\n\n" for words in lines))
    check_agrees(read(folder), folder, pinhole_error=1e-3)


@pytest.mark.parametrize("number", [5, 7, 10, 17])
def test_other_lenses_are_refused_by_name(written, number):
    folder = written("text")
    model, names = MODELS[number]
    values = " ".join(
        "20" if name in ("f", "fx", "fy", "cx", "cy", "w", "h") else "0" for name in names.split()
    )
    (folder / "sparse/0/cameras.txt").write_text(
        "".join(f"{i} {model} 24 18 {values}\n" for i in range(1, 18))
    )
    assert model in refused(folder) and "image_undistorter" in refused(folder)


SPELLED = {
    "without its suffix": lambda name: name.removesuffix(".png"),
    "base name only": lambda name: name.rpartition("/")[2],
    "another folder": lambda name: f"somewhere/{name.rpartition('/')[2]}",
    "another case": lambda name: name.upper(),
    "a leading dot and a backslash": lambda name: f".\\{name}".replace("/", "\\"),
}


@pytest.mark.parametrize("how", SPELLED)
def test_photos_are_found_by_path_name_stem_and_case(written, how):
    folder = written("transforms")
    path = folder / "transforms.json"
    contents = json.loads(path.read_text())
    for frame in contents["frames"]:
        frame["file_path"] = SPELLED[how](frame["file_path"])
    path.write_text(json.dumps(contents))
    photos = {view["path"]: view["size"] for view in read(folder)["views"]}
    assert photos == {f"dropped/images/{p.name}": p.stat().st_size for p in (folder / "images").iterdir()}


def test_intrinsics_may_be_of_the_file_of_frames_and_angles(written):
    """A frame's focal length in x replaces both of the file's; without sizes, those of the photos count."""
    folder = written("transforms")
    path = folder / "transforms.json"
    contents = json.loads(path.read_text())
    for i, frame in enumerate(contents["frames"]):
        for key in ("w", "h", "cx", "cy", "fl_x", "fl_y"):
            frame.pop(key, None)
        if i % 3 == 0:
            frame["fl_x"] = 30.0 + i
        if i % 3 == 1:
            frame.update(fl_y=21.0, k1=None)
    contents.update(camera_angle_x=0.8, camera_angle_y=0.7, cx=11.0)
    path.write_text(json.dumps(contents))
    check_agrees(read(folder), folder)


@pytest.mark.parametrize("lists", [("test",), ("train", "test"), ("train", "val"), ("train", "val", "test")])
def test_the_lists_of_a_file_decide_its_split(written, lists):
    folder = written("transforms")
    path = folder / "transforms.json"
    contents = json.loads(path.read_text())
    names = [frame["file_path"] for frame in contents["frames"]]
    chosen = {"train": names[:9], "val": names[9:12], "test": names[12:14]}
    contents.update({f"{part}_filenames": chosen[part] for part in lists})
    path.write_text(json.dumps(contents))
    check_agrees(read(folder), folder)


def test_of_several_models_the_largest_counts(written):
    folder = written("colmap")
    images = (folder / "sparse/0/images.bin").read_bytes()
    shutil.copytree(folder / "sparse/0", folder / "sparse/1")
    (folder / "sparse/0/images.bin").write_bytes(bytes(8))
    assert images[:8] == (17).to_bytes(8, "little")
    assert len(read(folder)["views"]) == 17


def test_missing_photos_and_masks_are_noted(written):
    folder = written("colmap")
    first = min((folder / "images").iterdir())
    first.unlink()
    (folder / "masks").mkdir(exist_ok=True)
    shutil.copy(next((folder / "images").iterdir()), folder / "masks" / f"{first.name}.png")
    found = read(folder)
    assert found["notes"] == [f"1 of 17 photos are missing, first {first.name}.", "Masks are not used here."]
    assert len(found["views"]) == 16


@pytest.mark.parametrize("layout", ["colmap", "text"])
@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
def test_truncated_models_are_refused(written, layout, file):
    """A binary file loses its last byte, a text file ends in the middle of its last entry."""
    folder = written(layout)
    (path,) = (folder / "sparse/0").glob(f"{file}.*")
    data = path.read_bytes().rstrip(b"\n" if layout == "text" else b"")
    last = data.rindex(b"\n" if layout == "text" else data[-1:])
    path.write_bytes(data[: last + 12] if layout == "text" else data[:last])
    assert f"{file}." in refused(folder)


def test_what_is_no_capture_is_refused_with_what_to_do(written, tmp_path):
    folder = written("colmap")
    shutil.rmtree(folder / "sparse")
    assert "gsplat-edu sfm" in refused(folder)
    (tmp_path / "empty").mkdir()
    assert "drop a folder or zip file" in refused(tmp_path / "empty")


def test_rotations_written_with_few_digits_become_the_nearest_ones(written):
    """Python's come from a singular value decomposition, whose errors are some 1e-16."""
    folder = written("transforms")
    path = folder / "transforms.json"
    contents = json.loads(path.read_text())
    for frame in contents["frames"]:
        frame["transform_matrix"] = np.round(frame["transform_matrix"], 3).tolist()
    path.write_text(json.dumps(contents))
    check_agrees(read(folder), folder)


def test_an_impossible_pose_is_left_out(written):
    folder = written("transforms")
    path = folder / "transforms.json"
    contents = json.loads(path.read_text())
    contents["frames"][3]["transform_matrix"][0] = [0.0, 0.0, 0.0, 1.0]
    path.write_text(json.dumps(contents))
    found = read(folder)
    assert len(found["views"]) == 16 and "impossible pose" in found["notes"][0]


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_zip_file_is_read_as_its_folder(written, tmp_path, method):
    folder = written("colmap")
    archive = tmp_path / "capture.zip"
    with zipfile.ZipFile(archive, "w", method) as packed:
        packed.mkdir("été")
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                packed.write(path, f"été/{path.relative_to(folder)}")
        packed.comment = b"PK\5\6 in a comment"
    one, other = read(folder), read(archive)
    for view in (*one["views"], *other["views"]):
        view["path"] = view["path"].rpartition("/")[2]
    assert one == other


def test_damaged_and_large_zip_files_are_refused(written, tmp_path):
    folder = written("colmap")
    archive = Path(shutil.make_archive(str(tmp_path / "capture"), "zip", folder))
    data = archive.read_bytes()
    archive.write_bytes(data[: len(data) // 2])
    assert "truncated or damaged" in refused(archive)
    end = data.rindex(b"PK\5\6")
    archive.write_bytes(data[: end + 16] + b"\xff\xff\xff\xff" + data[end + 20 :])
    assert "zip64" in refused(archive)
    entry = data.index(b"PK\1\2")
    archive.write_bytes(data[: entry + 8] + bytes([data[entry + 8] | 1]) + data[entry + 9 :])
    assert "password" in refused(archive)
    model = data.index(b"images.bin") + len("images.bin")
    archive.write_bytes(data[: model + 40] + bytes(8) + data[model + 48 :])
    assert "is damaged in the zip file" in refused(archive)


def test_the_example_is_read(tmp_path):
    archive = Path(str(files("gsplat_edu.studio") / "example.zip"))
    with zipfile.ZipFile(archive) as packed:
        packed.extractall(tmp_path / "example")
    check_agrees(read(archive), tmp_path / "example")
