"""Files of COLMAP: unusual models, photos in folders, and unsupported, truncated or garbled files."""

import os
import shutil
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data import colmap_files
from gsplat_edu.data.colmap import find_model, read_cameras, read_colmap, read_images, read_points
from gsplat_edu.data.colmap_files import MODELS
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.writers import write_colmap
from systems import needs_posix

EVERYTHING = DataSettings(test_every=0)
MODEL_FILES = ("cameras", "images", "points3D")


@pytest.fixture
def capture(written):
    return written("colmap")


@pytest.fixture
def text(written):
    return written("text")


def test_bin_and_txt_give_the_same_dataset(capture, text):
    a, b = load_dataset(capture, EVERYTHING), load_dataset(text, EVERYTHING)
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(a.colors, b.colors)
    for one, other in zip(a.train, b.train, strict=True):
        assert (one.name, one.camera.fx, one.camera.cx) == (other.name, other.camera.fx, other.camera.cx)
        np.testing.assert_array_equal(one.camera.R, other.camera.R)
        np.testing.assert_array_equal(one.camera.eye, other.camera.eye)


def test_bin_wins_over_txt(capture):
    (capture / "sparse" / "0" / "cameras.txt").write_text("nonsense\n")
    (capture / "sparse" / "0" / "images.txt").write_text("nonsense\n")
    assert len(load_dataset(capture).train) == 7


@pytest.mark.parametrize("name", ["rigs.bin", "frames.bin"])
def test_newer_files_are_ignored(capture, name):
    (capture / "sparse" / "0" / name).write_bytes(b"\1\2\3")
    assert len(load_dataset(capture).train) == 7


# Lines of cameras.txt, with fx, fy, cx, cy and coefficients derived by hand from COLMAP's documentation.
READ = [
    ("SIMPLE_PINHOLE 24 18 30 12 9", (30, 30, 11.5, 8.5), (), False),
    ("PINHOLE 24 18 30 31 12 9", (30, 31, 11.5, 8.5), (), False),
    ("SIMPLE_RADIAL 24 18 30 12 9 0.1", (30, 30, 11.5, 8.5), (0.1,), False),
    ("RADIAL 24 18 30 12 9 0.1 0.2", (30, 30, 11.5, 8.5), (0.1, 0.2), False),
    ("OPENCV 24 18 30 31 12 9 .1 .2 .3 .4", (30, 31, 11.5, 8.5), (0.1, 0.2, 0.3, 0.4), False),
    (
        "FULL_OPENCV 24 18 30 31 12 9 .1 .2 .3 .4 .5 .6 .7 .8",
        (30, 31, 11.5, 8.5),
        (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
        False,
    ),
    ("OPENCV_FISHEYE 24 18 30 31 12 9 .1 .2 .3 .4", (30, 31, 11.5, 8.5), (0.1, 0.2, 0.3, 0.4), True),
    ("SIMPLE_RADIAL_FISHEYE 24 18 30 12 9 0.1", (30, 30, 11.5, 8.5), (0.1,), True),
    ("RADIAL_FISHEYE 24 18 30 12 9 0.1 0.2", (30, 30, 11.5, 8.5), (0.1, 0.2), True),
    ("SIMPLE_FISHEYE 24 18 30 12 9", (30, 30, 11.5, 8.5), (), True),
    ("FISHEYE 24 18 30 31 12 9", (30, 31, 11.5, 8.5), (), True),
]


@pytest.mark.parametrize(
    ("line", "intrinsics", "coefficients", "fisheye"), READ, ids=lambda v: str(v).split()[0]
)
def test_camera_models(tmp_path, line, intrinsics, coefficients, fisheye):
    """Cameras are read from text and from binary files, in which the model id is the index in MODELS."""
    model, W, H, *values = line.split()
    (tmp_path / "cameras.txt").write_text(f"# a comment\n\n7 {line}\n")
    number = [name for name, _ in MODELS].index(model)
    floats = [float(v) for v in values]
    data = struct.pack(f"<QIiQQ{len(floats)}d", 1, 7, number, int(W), int(H), *floats)
    (tmp_path / "cameras.bin").write_bytes(data)
    for suffix in ("bin", "txt"):
        (lens,) = read_cameras(tmp_path / f"cameras.{suffix}").values()
        assert (lens.fx, lens.fy, lens.cx, lens.cy) == intrinsics and (lens.W, lens.H) == (24, 18)
        assert lens.model == ("fisheye" if fisheye else "perspective")
        assert lens.coefficients == (*coefficients, *[0.0] * ((4 if fisheye else 8) - len(coefficients)))


def test_the_ids_of_the_models():
    """The ids are those of COLMAP's documentation."""
    names = [name for name, _ in MODELS]
    assert names[:6] == ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]
    assert names[6:9] == ["FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE"]
    assert names[11] == "RAD_TAN_THIN_PRISM_FISHEYE" and len(names) == 18


@pytest.mark.parametrize("number", [18, 99, -1])
def test_unsupported_models_are_refused_by_name(tmp_path, number):
    path = tmp_path / "cameras.bin"
    path.write_bytes(struct.pack("<QIiQQ16d", 1, 7, number, 24, 18, *range(1, 17)))
    with pytest.raises(DatasetError) as caught:
        read_cameras(path)
    message = str(caught.value)
    assert "camera 7" in message and "image_undistorter" in message
    assert (MODELS[number][0] if 0 <= number < 18 else str(number)) in message


@pytest.mark.parametrize(
    ("file", "line", "content"),
    [
        ("cameras", 2, "1 PINHOLE 24 18 30"),
        ("cameras", 2, "1 NOTHING 24 18 30 30 12 9"),
        ("cameras", 2, "1 PINHOLE 24"),
        ("cameras", 2, "1 PINHOLE 24 18 30 x 12 9"),
        ("cameras", 2, "1 PINHOLE 24 18 -30 30 12 9"),
        ("cameras", 2, "1 PINHOLE 24 18 nan 30 12 9"),
        ("cameras", 2, "1 PINHOLE 0 18 30 30 12 9"),
        ("images", 4, "1 1 0 0 0 0 0"),
        ("images", 5, "1 1 0 0 0 0 0 0"),
        ("points3D", 3, "1 2 3 4 5"),
        ("points3D", 3, "1 2 3 x 5 6 7 0"),
    ],
)
def test_a_malformed_line_is_named(text, file, line, content):
    path = text / "sparse" / "0" / f"{file}.txt"
    lines = path.read_text().split("\n")
    lines[line - 1] = content
    path.write_text("\n".join(lines))
    with pytest.raises(DatasetError, match=rf"{file}\.txt, line {line}: ") as caught:
        load_dataset(text)
    assert "\n" not in str(caught.value)


def test_ids_with_gaps_and_a_name_with_a_space(text):
    """COLMAP may give images and cameras any ids, with gaps."""
    model = text / "sparse" / "0"
    for file, old, new in (("cameras", "1 PINHOLE", "907 PINHOLE"), ("images", " 1 view_", " 907 view_")):
        path = model / f"{file}.txt"
        path.write_text(path.read_text().replace(old, new))
    path = model / "images.txt"
    path.write_text(path.read_text().replace("\n3 ", "\n4000000000 ").replace("view_002.png", "view 002.png"))
    (text / "images" / "view_002.png").rename(text / "images" / "view 002.png")
    dataset = load_dataset(text, EVERYTHING)
    assert len(dataset.train) == 9 and dataset.train[0].name == "view 002.png" and dataset.notes == ()


def test_a_missing_camera_is_named(text):
    path = text / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace(" 1 view_003", " 5 view_003"))
    with pytest.raises(DatasetError, match=r"image view_003\.png: its camera 5 is not in cameras\.txt"):
        load_dataset(text)


@pytest.mark.parametrize("quat", ["0 0 0 0", "nan 0 0 0", "inf 0 0 0"])
@pytest.mark.parametrize("shift", ["0 0 0", "nan 0 0", "1e300 0 0", "1e13 0 0"])
def test_an_invalid_pose_names_its_image(text, quat, shift):
    path = text / "sparse" / "0" / "images.txt"
    lines = path.read_text().split("\n")
    lines[3] = f"2 {quat} {shift} 1 view_001.png"
    path.write_text("\n".join(lines))
    dataset = load_dataset(text, EVERYTHING)
    assert len(dataset.train) == 8
    assert [str(n).startswith("1 of 9 photos has an unusable pose or camera") for n in dataset.notes] == [
        True
    ]
    assert "left out: view_001.png (its " in str(dataset.notes[0])


@pytest.mark.parametrize("place", ["images/a/b.png", "a/b.png", "images/b.png"])
def test_names_with_folders(tmp_path, small, place):
    """A photo is found as images/NAME, as NAME in the capture's folder, and by its bare name in images/."""
    view = small[0][0]
    write_colmap(tmp_path, [view], *small[1:])
    path = tmp_path / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes().replace(b"view_000.png", b"a/b.png"))
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    shutil.move(tmp_path / "images" / "view_000.png", tmp_path / place)
    (found,) = load_dataset(tmp_path).train
    assert found.name == "a/b.png"
    np.testing.assert_array_equal(found.image, view.image)


def test_missing_photos_are_reported_and_skipped(capture):
    for i in (2, 5):
        (capture / "images" / f"view_00{i}.png").unlink()
    dataset = load_dataset(capture, EVERYTHING)
    assert len(dataset.train) == 7
    assert tuple(map(str, dataset.notes)) == ("2 of 9 photos have no file: skipped, first view_002.png",)
    shutil.rmtree(capture / "images")
    with pytest.raises(DatasetError, match="none of the 9 photos"):
        load_dataset(capture)


def test_a_model_without_images(capture):
    (capture / "sparse" / "0" / "images.bin").write_bytes(struct.pack("<Q", 0))
    with pytest.raises(DatasetError, match=r"images\.bin: lists no images"):
        load_dataset(capture)


@pytest.mark.parametrize("lost", ["cameras", "images"])
def test_half_a_model(capture, lost):
    (capture / "sparse" / "0" / f"{lost}.bin").unlink()
    with pytest.raises(DatasetError, match="needs both cameras and images"):
        load_dataset(capture)


@pytest.mark.parametrize("how", ["missing", "empty", "not finite"])
def test_without_points_the_start_is_random(capture, how):
    path = capture / "sparse" / "0" / "points3D.bin"
    path.unlink()
    if how == "empty":
        path.write_bytes(struct.pack("<Q", 0))
    if how == "not finite":
        path.write_bytes(struct.pack("<QQ3d3BdQ", 1, 1, np.nan, 0, 0, 1, 2, 3, 0, 0))
    dataset = load_dataset(capture)
    assert len(dataset.points) == 100_000 and any("no points" in note for note in map(str, dataset.notes))


def test_tracks_and_observations_are_skipped(tmp_path):
    """Their lengths vary from entry to entry. The test writes the files itself, so the expected values are known."""
    data = struct.pack("<Q", 2)
    for i, track in ((3, 2), (9, 0)):
        data += struct.pack("<Q3d3BdQ", i, i, i + 0.5, -i, 255, 0, 51, 0.7, track) + b"\xff" * 8 * track
    (tmp_path / "points3D.bin").write_bytes(data)
    data = struct.pack("<Q", 2)
    for i, observed in ((4, 3), (8, 1)):
        data += struct.pack("<I7dI", i, 1, 0, 0, 0, i, 2, 3, 5) + f"{i}.jpg".encode() + b"\0"
        data += struct.pack("<Q", observed) + b"\xff" * 24 * observed
    (tmp_path / "images.bin").write_bytes(data)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<Q", 0))
    cloud = read_points(tmp_path)
    np.testing.assert_array_equal(cloud.points, [[3, 3.5, -3], [9, 9.5, -9]])
    np.testing.assert_allclose(cloud.colors, [[1, 0, 0.2]] * 2, atol=1e-15)
    poses = read_images(tmp_path / "images.bin")
    assert [(p.name, p.camera, p.shift) for p in poses] == [("4.jpg", 5, (4, 2, 3)), ("8.jpg", 5, (8, 2, 3))]


def test_observations_are_never_held_in_memory(tmp_path):
    """Thousands of photos have gigabytes of observations. This file has a hole of 3 GiB in their place."""
    observed = 2**27
    with (tmp_path / "images.bin").open("wb") as file:
        for i in (4, 8):
            file.write(struct.pack("<Q", 2) if i == 4 else b"")
            file.write(struct.pack("<I7dI", i, 1, 0, 0, 0, i, 2, 3, 5) + f"{i}.jpg".encode() + b"\0")
            file.write(struct.pack("<Q", observed if i == 4 else 0))
            file.seek(24 * observed if i == 4 else 0, os.SEEK_CUR)
    tracemalloc.start()
    poses = read_images(tmp_path / "images.bin")
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert [pose.name for pose in poses] == ["4.jpg", "8.jpg"]
    assert most < 2**20, "memory for the file's buffer and two poses"


@pytest.mark.parametrize("name", ["points3D", "images"])
def test_a_line_or_a_name_without_end_is_refused(tmp_path, monkeypatch, name):
    monkeypatch.setattr(colmap_files, "LONGEST_LINE", 1_000)
    read = {"points3D": lambda path: read_points(path.parent), "images": read_images}[name]
    (tmp_path / f"{name}.txt").write_text(f"# first\n{'1 ' * 600}\n")
    with pytest.raises(DatasetError, match=rf"{name}\.txt, line 2: expected lines shorter than 1,000"):
        read(tmp_path / f"{name}.txt")
    image = struct.pack("<I7dI", 1, 1, 0, 0, 0, 1, 2, 3, 5)
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 1) + image + b"x" * 70_000 + b"\0" + bytes(8))
    with pytest.raises(DatasetError, match=r"images\.bin: image 1 of 1 has a name of more than 65,536 bytes"):
        read_images(tmp_path / "images.bin")


def test_a_text_file_without_points_is_a_model_without_points(tmp_path):
    (tmp_path / "points3D.txt").write_text("# no points\n")
    assert read_points(tmp_path) is None


@pytest.mark.parametrize("stem", [".png.png", ".png"])
def test_masks_beside_the_images(capture, stem):
    mask = np.zeros((18, 24), np.uint8)
    mask[3:9, 4:20] = 1
    (capture / "masks").mkdir()
    Image.fromarray(mask).save(capture / "masks" / f"view_004{stem}")
    views = {view.name: view for view in load_dataset(capture, EVERYTHING).train}
    np.testing.assert_array_equal(views["view_004.png"].read().mask, mask == 1)
    assert views["view_003.png"].read().mask is None
    Image.fromarray(mask[:-1]).save(capture / "masks" / f"view_004{stem}")
    with pytest.raises(DatasetError, match=r"view_004.*\.png: the mask is 24x17 but its photo 24x18"):
        load_dataset(capture)


@pytest.mark.parametrize("file", MODEL_FILES)
def test_every_truncation_names_the_file(capture, file):
    """The error names the truncated file, which is never read as a complete one."""
    path = capture / "sparse" / "0" / f"{file}.bin"
    data = path.read_bytes()
    # 7 is coprime to the 51 bytes of a point
    for end in range(0, len(data), 7 if len(data) > 500 else 1):
        path.write_bytes(data[:end])
        with pytest.raises(DatasetError, match=rf"{file}\.bin"):
            read_colmap(capture, capture / "sparse" / "0")


def test_a_count_beyond_the_file_allocates_nothing(capture):
    for file in MODEL_FILES:
        path = capture / "sparse" / "0" / f"{file}.bin"
        whole = path.read_bytes()
        path.write_bytes(struct.pack("<Q", 2**63) + whole[8:])
        with pytest.raises(DatasetError, match="more than the file can contain"):
            load_dataset(capture)
        path.write_bytes(whole)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    file=st.sampled_from(MODEL_FILES),
    flips=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), min_size=1, max_size=6),
    head=st.booleans(),
)
def test_garbled_files_end_in_a_dataset_error_or_a_dataset(capture, file, flips, head):
    """If bytes are flipped, half of them early in the file, nothing but DatasetError is raised."""
    path = capture / "sparse" / "0" / f"{file}.bin"
    whole = path.read_bytes()
    data = bytearray(whole)
    for where, change in flips:
        data[int(where * (min(96, len(data)) if head else len(data)))] ^= change
    path.write_bytes(bytes(data))
    try:
        load_dataset(capture).preload()
    except DatasetError as error:
        assert "\n" not in str(error)
    finally:
        path.write_bytes(whole)


def test_the_statue_as_bin_and_as_txt(real, tmp_path):
    """One model in both forms. The text has six digits of the camera and unrounded points."""
    folder = real("odd/statue_sparse_bin_and_txt")
    (a,), (b,) = (read_cameras(folder / f"cameras.{s}").values() for s in ("bin", "txt"))
    np.testing.assert_allclose((a.fx, a.fy, a.cx, a.cy), (b.fx, b.fy, b.cx, b.cy), rtol=5e-6)
    np.testing.assert_allclose(a.coefficients, b.coefficients, rtol=5e-6)
    binary, text = ({p.name: p for p in read_images(folder / f"images.{s}")} for s in ("bin", "txt"))
    assert binary.keys() == text.keys() and len(binary) == 40
    for name in binary:
        np.testing.assert_allclose(binary[name].quat, text[name].quat, atol=2e-5)
        np.testing.assert_allclose(binary[name].shift, text[name].shift, rtol=1e-4, atol=1e-4)
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        shutil.copy(folder / name, tmp_path)
    clouds = [read_points(place) for place in (folder, tmp_path)]
    order = [np.lexsort(cloud.points.T) for cloud in clouds]
    assert len(order[0]) == 1816
    for field in ("points", "colors"):
        one, other = (getattr(cloud, field)[index] for cloud, index in zip(clouds, order, strict=True))
        np.testing.assert_allclose(one, other, rtol=1e-12)
    with pytest.raises(DatasetError, match="none of the 40 photos"):
        load_dataset(folder)
    assert find_model(folder) == folder


def renamed(capture, names):
    """Give images of the text model other names; their files stay where they are."""
    path = capture / "sparse" / "0" / "images.txt"
    text = path.read_text()
    for old, new in names.items():
        text = text.replace(old, new)
    path.write_text(text)


def test_a_bare_name_that_two_images_share_is_not_used(text):
    """Otherwise, training would use one photo as two views with two poses."""
    renamed(text, {"view_001.png": "a/view_000.png"})
    with pytest.raises(DatasetError, match=r"none of the 9 photos"):
        (text / "images").rename(text / "elsewhere")
        load_dataset(text)
    (text / "elsewhere").rename(text / "images")
    dataset = load_dataset(text, EVERYTHING)
    assert len(dataset.train) == 8 and "a/view_000.png" not in [view.name for view in dataset.train]
    assert tuple(map(str, dataset.notes)) == ("1 of 9 photos have no file: skipped, first a/view_000.png",)


def test_two_images_of_one_file_are_refused(text):
    renamed(text, {"view_001.png": "images/view_000.png"})
    with pytest.raises(DatasetError, match=r"view_000\.png: is the file of two images, (images/)?view_000"):
        load_dataset(text)
    renamed(text, {"images/view_000.png": "view_000.png"})
    with pytest.raises(DatasetError, match=r"lists the image view_000\.png twice"):
        load_dataset(text)


def test_a_bare_mask_that_two_images_share_is_reported_and_not_used(text):
    renamed(text, {"view_001.png": "a/view_000.png", "view_000.png 1": "view_000.png 1"})
    (text / "images" / "a").mkdir()
    (text / "images" / "view_001.png").rename(text / "images" / "a" / "view_000.png")
    (text / "masks").mkdir()
    Image.new("L", (24, 18), 255).save(text / "masks" / "view_000.png.png")
    dataset = load_dataset(text, EVERYTHING)
    masked = [view.name for view in dataset.train if view.read().mask is not None]
    assert masked == ["view_000.png"]
    assert any(
        "mask whose bare name several photos share" in n and "first a/view_000.png" in n
        for n in map(str, dataset.notes)
    )


@pytest.mark.parametrize("number", [7, 10, 11, 12, 13, 16, 17])
def test_an_unsupported_camera_that_no_image_uses_is_skipped(capture, number):
    """The parameter count of every model is known, so the next camera is read from the right offset."""
    path = capture / "sparse" / "0" / "cameras.bin"
    values = range(1, 1 + len(dict(MODELS)[MODELS[number][0]].split()))
    odd = struct.pack(f"<IiQQ{len(values)}d", 99, number, 24, 18, *values)
    path.write_bytes(struct.pack("<Q", 2) + odd + path.read_bytes()[8:])
    assert len(load_dataset(capture, EVERYTHING).train) == 9
    assert len(values) == {7: 5, 10: 12, 11: 16, 12: 4, 13: 5, 16: 6, 17: 2}[number]


def test_a_pose_without_a_photo_is_not_checked(text):
    renamed(text, {"view_001.png": "gone.png"})
    path = text / "sparse" / "0" / "images.txt"
    lines = path.read_text().split("\n")
    lines[3] = "2 nan 0 0 0 0 0 0 77 gone.png"
    path.write_text("\n".join(lines))
    dataset = load_dataset(text, EVERYTHING)
    assert len(dataset.train) == 8
    assert tuple(map(str, dataset.notes)) == ("1 of 9 photos have no file: skipped, first gone.png",)


@pytest.mark.parametrize("named", [".", "sparse", "sparse/1"])
def test_the_folder_of_models_and_a_model_that_is_not_0(capture, named):
    (capture / "sparse" / "0").rename(capture / "sparse" / "1")
    (capture / "sparse" / "10").mkdir()
    dataset = load_dataset(capture / named, EVERYTHING)
    assert len(dataset.train) == 9
    assert [n for n in map(str, dataset.notes) if "models" in n] == [
        f"{capture / 'sparse'} holds 2 models: 1 (9 photos) is read, 10 (unreadable) not"
    ]


def test_points_in_the_other_format(capture, text):
    """cameras.bin and images.bin with a points3D.txt."""
    (capture / "sparse" / "0" / "points3D.bin").unlink()
    shutil.copy(text / "sparse" / "0" / "points3D.txt", capture / "sparse" / "0")
    a, b = load_dataset(capture), load_dataset(text)
    np.testing.assert_array_equal(a.points, b.points)


@needs_posix
@pytest.mark.parametrize("layout", ["colmap", "text"])
def test_names_from_other_systems(written, layout):
    """A backslash separates folders. A name that is not UTF-8 matches the file with the same bytes."""
    folder = written(layout)
    path = folder / "sparse" / "0" / ("images.bin" if layout == "colmap" else "images.txt")
    data = path.read_bytes().replace(b"view_000.png", b"a\\view0.png").replace(b"view_001", b"view\xff01")
    path.write_bytes(data)
    (folder / "images" / "a").mkdir()
    (folder / "images" / "view_000.png").rename(folder / "images" / "a" / "view0.png")
    (folder / "images" / "view_001.png").rename(os.fsdecode(bytes(folder / "images") + b"/view\xff01.png"))
    dataset = load_dataset(folder, EVERYTHING)
    names = [view.name for view in dataset.train]
    assert len(names) == 9 and "a/view0.png" in names and "view\\xff01.png" in names


def test_a_nonfinite_colour_channel_is_gray(text):
    path = text / "sparse" / "0" / "points3D.txt"
    lines = path.read_text().split("\n")
    lines[1] = "1 0 0 0 nan 51 255 0"
    path.write_text("\n".join(lines))
    np.testing.assert_allclose(load_dataset(text).colors[0], [0.5, 0.2, 1.0])


def test_a_full_photo_beside_the_model_wins_over_a_smaller_copy(capture):
    """The photos lie beside the model instead of in images/, and there is an unrelated images_2."""
    (capture / "images").rename(capture / "images_2")
    for file in (capture / "images_2").iterdir():
        shutil.copy(file, capture)
        Image.new("RGB", (12, 9)).save(file)
    dataset = load_dataset(capture, EVERYTHING)
    assert {view.image.shape for view in dataset.train} == {(18, 24, 3)}
