"""COLMAP's text files as other programs write them: without lines of points, with a byte order mark, with odd names."""

import shutil

import numpy as np
import pytest

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.colmap import read_images
from gsplat_edu.data.colmap_files import observations_txt
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.survey.support import observed_points

EVERYTHING = DataSettings(test_every=0)
POSE = "0.8 0.6 0 0 1 2 3"
MARKS = {"none": None, "empty": "", "two": "10.5 11.5 7 12 13 -1"}
"""What follows a line of an image, by name; None for nothing."""


@pytest.fixture
def text(written):
    return written("text")


@pytest.mark.parametrize("end", ["\n", "", "\r\n"])
@pytest.mark.parametrize("marks", MARKS)
@pytest.mark.parametrize(
    "name", ["a.jpg", "wp 2 003.jpg", "12 7.5 3.jpg", "1 2 3 4", "12 7 3", "a  b.jpg", "nan inf 4", "# a.jpg"]
)
def test_every_image_is_read_whatever_its_name(tmp_path, name, marks, end):
    """A name of numbers makes a line of 12 words, which could be four marks of a photo."""
    lines = ["# a comment"]
    for i in range(1, 5):
        lines += [f"{i} {POSE} 1 {i} {name}", *([] if MARKS[marks] is None else [MARKS[marks]])]
    path = tmp_path / "images.txt"
    path.write_bytes(("\r\n" if end == "\r\n" else "\n").join(lines).encode() + end.encode())
    assert [pose.name for pose in read_images(path)] == [f"{i} {name}" for i in range(1, 5)]
    seen = [(image.name, image.points.tolist()) for image in observations_txt(path)]
    assert seen == [(f"{i} {name}", [7] if marks == "two" else []) for i in range(1, 5)]


def test_comments_and_blank_lines_anywhere(tmp_path):
    path = tmp_path / "images.txt"
    path.write_text(
        f"# head\n\n1 {POSE} 1 a.png\n# between\n1 2 5 3 4 6\n\n\n2 {POSE} 1 b.png\n\n1 2 8\n# end\n3 {POSE} 1 c.png"
    )
    assert [(image.name, image.points.tolist()) for image in observations_txt(path)] == [
        ("a.png", [5, 6]),
        ("b.png", [8]),
        ("c.png", []),
    ]


@pytest.mark.parametrize(
    ("marks", "points"),
    [
        (
            "0 0 -1 0 0 -1 0 0 -1 0 0 -1",
            [],
        ),  # place holders: the first nine words read as an image, except the camera
        ("1 0.1 4 0.2 0.3 5 7 8 9 10 11 12", [4, 5, 9, 12]),
        ("1 2 18446744073709551615", []),  # -1 as an unsigned number
        ("1.5e+01 2 3.0", [3]),
    ],
)
def test_marks_are_read(tmp_path, marks, points):
    path = tmp_path / "images.txt"
    path.write_text(f"1 {POSE} 1 a.png\n{marks}\n2 {POSE} 1 b.png\n\n")
    assert [image.points.tolist() for image in observations_txt(path)] == [points, []]


@pytest.mark.parametrize("line", ["1 2 3.5", "1 2 x", "1 2 3 4", "1 2 nan", "word"])
def test_a_line_that_is_neither_points_nor_an_image_is_named(tmp_path, line):
    path = tmp_path / "images.txt"
    path.write_text(f"1 {POSE} 1 a.png\n{line}\n2 {POSE} 1 b.png\n\n")
    with pytest.raises(
        DatasetError, match=r"images\.txt, line 2: expected the image's points .* or the next"
    ):
        read_images(path)


def test_photos_with_spaces_and_no_lines_of_points(text):
    """Nine photos are written; every second one was dropped."""
    path = text / "sparse" / "0" / "images.txt"
    lines = [line for line in path.read_text().split("\n") if "view_" in line]
    assert len(lines) == 9
    path.write_text("\n".join(line.replace("view_", "wp 2 ") for line in lines))
    for photo in (text / "images").iterdir():
        photo.rename(photo.with_name(photo.name.replace("view_", "wp 2 ")))
    dataset = load_dataset(text, EVERYTHING)
    assert [view.name for view in dataset.train] == [f"wp 2 {i:03d}.png" for i in range(9)]
    assert dataset.notes == ()


def test_a_byte_order_mark(text):
    """Editors on Windows write one, and end lines by CR LF."""
    plain = load_dataset(text, EVERYTHING)
    counts = observed_points(text)
    for path in (text / "sparse" / "0").glob("*.txt"):
        lines = [line for line in path.read_text().split("\n") if not line.startswith("#")]
        path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines).encode())
    marked = load_dataset(text, EVERYTHING)
    np.testing.assert_array_equal(marked.points, plain.points)
    assert len(plain.points) > 0 and observed_points(text) == counts
    for one, other in zip(marked.train, plain.train, strict=True):
        np.testing.assert_array_equal(one.camera.R, other.camera.R)


def test_a_photo_list_with_a_byte_order_mark(text):
    (text / "left_out.txt").write_bytes(b"\xef\xbb\xbfview_003.png\r\nview_004.png\r\n")
    assert [v.name for v in load_dataset(text, EVERYTHING).train] == [
        f"view_{i:03d}.png" for i in (0, 1, 2, 5, 6, 7, 8)
    ]


def test_the_capture_that_lost_every_second_photo(real, tmp_path):
    shutil.copytree(real("fell/names_with_spaces"), tmp_path / "capture")
    assert len(load_dataset(tmp_path / "capture", EVERYTHING).train) == 24
