"""Captures and scenes that are huge or made to break readers end in a one-line error after limited work."""

import json
import os
import re
import signal
import socket
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import EpsImagePlugin, Image

from gsplat_edu.base.errors import DatasetError, SceneFormatError
from gsplat_edu.data import capture
from gsplat_edu.data.colmap import read_images, read_points
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.points import read_points_ply
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.io.formats import read_scene
from gsplat_edu.photos.decoding import ImageHeader, decode, decode_mask, image_size
from systems import needs_posix

ROOT = Path(__file__).parents[2]
EVERYTHING = DataSettings(test_every=0)


@pytest.fixture
def no_hang():
    """Fail a test that hangs on a pipe; it needs much less than a minute."""

    def late(number, frame):
        raise AssertionError("the test hangs")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def test_only_one_module_opens_image_files():
    """`image_files.py` has the list of allowed formats; no other module opens an image."""
    opens = re.compile(r"Image\.open\(|\bimread\(|imdecode\(|plt\.imread|image_dimensions")
    files = [*(ROOT / "src").rglob("*.py"), *(ROOT / "train").rglob("*.py")]
    found = [path.name for path in files if opens.search(path.read_text(encoding="utf-8"))]
    assert found == ["image_files.py"]


EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 16 12\n%%EndComments\nshowpage\n%%EOF\n"


@needs_posix
@pytest.mark.parametrize("read", [decode, decode_mask, image_size])
def test_a_drawing_named_like_a_photo_starts_no_other_program(tmp_path, monkeypatch, read):
    """Pillow runs Ghostscript for an EPS. A program named `gs` leaves a mark if it runs."""
    mark, program = tmp_path / "was_run", tmp_path / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {mark}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)  # Pillow looks for the program once
    photo = tmp_path / "a.png"
    photo.write_bytes(EPS)
    with pytest.raises(DatasetError, match="not a JPEG, PNG, WebP, TIFF, BMP, PPM or HEIC image"):
        read(photo)
    assert not mark.exists()
    subprocess.run(["gs"], check=True, env=dict(os.environ))
    assert mark.exists(), "Pillow finds the program `gs`"


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.webp", "a.tif", "a.bmp", "a.ppm"])
def test_the_documented_formats_are_read(tmp_path, name):
    Image.new("RGB", (16, 12), (90, 80, 70)).save(tmp_path / name)
    assert decode(tmp_path / name)[0].shape == (12, 16, 3) and image_size(tmp_path / name) == (16, 12)


def special(folder: Path, kind: str, name: str) -> Path:
    path = folder / name
    if kind == "a pipe":
        os.mkfifo(path)
    elif kind == "a socket":
        here = Path.cwd()
        os.chdir(folder)  # socket paths must be short
        try:
            with socket.socket(socket.AF_UNIX) as made:
                made.bind(name)
        finally:
            os.chdir(here)
    elif kind == "a device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    return path


SCENES = ["a.ply", "a.compressed.ply", "a.splat", "a.spz", "a.sog", "a.glb"]


@needs_posix
@pytest.mark.parametrize("kind", ["a pipe", "a socket", "a device", "a folder"])
def test_special_files_are_refused_by_every_reader(tmp_path, no_hang, kind):
    for name in SCENES:
        with pytest.raises(OSError, match=f"is {kind}, not a file"):
            read_scene(special(tmp_path, kind, name))
    for read, name in (
        (read_points_ply, "b.ply"),
        (decode, "a.png"),
        (decode_mask, "m.png"),
        (image_size, "s.png"),
    ):
        with pytest.raises(DatasetError, match=f"is {kind}, not a file"):
            read(special(tmp_path, kind, name))
    for read, name in ((read_images, "images.bin"), (read_images, "images.txt")):
        with pytest.raises(DatasetError, match=f"is {kind}, not a file"):
            read(special(tmp_path, kind, name))


@needs_posix
def test_a_pipe_among_the_files_of_a_capture(one_photo, no_hang):
    folder = one_photo(np.zeros((12, 16, 3), np.uint8), ply_file_path="points.ply")
    special(folder, "a pipe", "points.ply")
    with pytest.raises(DatasetError, match=r"points\.ply: cannot be read \(is a pipe, not a file\)"):
        load_dataset(folder)
    (folder / "images" / "a.png").unlink()
    special(folder, "a pipe", "images/a.png")
    with pytest.raises(
        DatasetError, match=r"none of its 1 photos has a file, first .*a\.png \(it is a pipe, not a file\)"
    ):
        load_dataset(folder)


@needs_posix
@pytest.mark.parametrize("kind", ["a pipe", "a socket", "a device", "a folder"])
def test_a_photo_that_is_no_file_is_named_as_what_it_is(tmp_path, no_hang, kind):
    """In both layouts, with a photo that is there, so that the capture is read."""
    views, points, colors = procedural_capture(24, 3)
    for write in (write_colmap, write_transforms):
        folder = tmp_path / write.__name__
        write(folder, views, points, colors)
        photos = sorted((folder / "images").iterdir())
        photos[0].unlink()
        special(photos[0].parent, kind, photos[0].name)
        said = [str(note) for note in load_dataset(folder, DataSettings(test_every=0)).notes]
        assert any(
            "1 of 3 photos have no file" in line and f"(it is {kind}, not a file)" in line for line in said
        ), said


def ply(folder: Path, *lines: str) -> Path:
    path = folder / "a.ply"
    path.write_text("\n".join(["ply", *lines, "end_header", ""]))
    return path


BINARY = "format binary_little_endian 1.0"
VERTEX = ("element vertex 0", *(f"property float {axis}" for axis in "xyz"))


def test_elements_larger_than_any_file(tmp_path):
    path = ply(tmp_path, BINARY, "element foo 1" + 25 * "0", "property double a", *VERTEX)
    with pytest.raises(DatasetError, match="line 3: element foo of 1000.* rows is more than any file holds"):
        read_points_ply(path)
    path = ply(
        tmp_path,
        BINARY,
        *("element foo 999999999999", *(f"property double a{i}" for i in range(9000))),
        *VERTEX,
    )
    assert len(read_points_ply(path).points) == 0, "no row is read, so no row has to be skipped"


def test_thousands_of_elements_and_properties_are_looked_up_in_tables(tmp_path, monkeypatch):
    """The names count their comparisons, which are a few per name instead of one with every other name."""
    from gsplat_edu.base import ply_table

    compared = 0

    class Name(str):
        __slots__ = ()

        def __eq__(self, other):
            nonlocal compared
            compared += isinstance(other, Name)
            return str.__eq__(self, other)

        def __hash__(self):
            return str.__hash__(self)

    lines = ply_table.HeaderLines()
    count = 2000
    for i in range(count):
        assert lines.add(["element", Name(f"e{i}"), "0"]) is None
    for i in range(count):
        assert lines.add(["property", "float", Name(f"p{i}")]) is None
    assert lines.add(["property", "float", Name("p7")]) == "property p7 appears twice"
    assert compared < 4 * count


def test_elements_without_properties_have_no_rows(tmp_path):
    path = ply(tmp_path, "format ascii 1.0", "element e 5", "element vertex 1", *VERTEX[1:])
    path.write_text(path.read_text() + "1 2 3\n")
    assert read_points_ply(path).points.tolist() == [[1.0, 2.0, 3.0]]


def transforms(folder: Path, names, **more) -> Path:
    pose = np.eye(4).tolist()
    frames = [{"file_path": name, "transform_matrix": pose} for name in names]
    contents = {"fl_x": 20.0, "w": 16, "h": 12, "frames": frames, **more}
    (folder / "transforms.json").write_text(json.dumps(contents))
    (folder / "images").mkdir(exist_ok=True)
    Image.new("RGB", (16, 12), (90, 80, 70)).save(folder / "images" / "a.png")
    return folder


def test_many_frames_without_a_photo_need_few_system_calls(tmp_path, monkeypatch):
    """300,000 frames used to take minutes, because each could have 28 endings in 4 folders."""
    checked = []
    monkeypatch.setattr(
        capture, "is_file", lambda path, really=capture.is_file: checked.append(path) or really(path)
    )
    folder = transforms(tmp_path, [*(f"images/{i:04d}" for i in range(500)), "images/a"])
    dataset = load_dataset(folder, EVERYTHING)
    assert any("500 of 501 photos have no file" in note for note in map(str, dataset.notes))
    assert len(checked) < 50


def test_many_frames_of_one_photo_read_its_header_once(tmp_path, monkeypatch):
    """Such a photo is one view."""
    from gsplat_edu.photos import decoding

    read = []
    header = ImageHeader((16, 12), "")
    monkeypatch.setattr(decoding, "image_header", lambda path: read.append(path) or header)
    assert len(load_dataset(transforms(tmp_path, ["images/a.png"] * 300), EVERYTHING).train) == 1
    assert len(read) == 1


def test_photos_are_found_under_every_ending_in_any_case(tmp_path):
    folder = transforms(tmp_path, ["images/b", "images/c", "images/./a"])
    Image.new("RGB", (16, 12)).save(folder / "images" / "b.JPG")
    (folder / "images_2").mkdir()
    Image.new("RGB", (16, 12)).save(folder / "images_2" / "c.jpeg")
    assert [view.name for view in load_dataset(folder, EVERYTHING).train] == [
        "images/a",
        "images/b",
        "images/c",
    ]


def test_photos_in_a_folder_that_cannot_be_listed(tmp_path, monkeypatch):
    """A folder may allow opening its files but not listing them; every name then has to be tried."""

    def refuse(place, really=os.listdir):
        if Path(place).name.startswith("images"):
            raise PermissionError
        return really(place)

    monkeypatch.setattr(capture.os, "listdir", refuse)
    assert len(load_dataset(transforms(tmp_path, ["images/a"]), EVERYTHING).train) == 1


@pytest.mark.parametrize(
    "text", ['{"frames": ' + 50_000 * "[" + 50_000 * "]" + "}", '{"frames": ' + 9000 * "9" + "}"]
)
def test_json_made_to_break_parsers(tmp_path, text):
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(DatasetError, match=r"transforms\.json: is not JSON"):
        load_dataset(tmp_path)
    (tmp_path / "meta.json").write_text(text)
    with pytest.raises(SceneFormatError, match="its metadata is not JSON"):
        read_scene(tmp_path / "meta.json")


@pytest.mark.parametrize("spelled", ["../other/p.png", "{absolute}", "images/../../other/p.png"])
def test_files_from_elsewhere_are_named(tmp_path, spelled):
    other = tmp_path / "other" / "p.png"
    other.parent.mkdir()
    Image.new("RGB", (16, 12)).save(other)
    folder = tmp_path / "capture"
    folder.mkdir()
    transforms(folder, ["images/a.png", spelled.format(absolute=other)])
    dataset = load_dataset(folder, EVERYTHING)
    (note,) = [note for note in map(str, dataset.notes) if "outside" in note]
    assert "p.png lies outside of" in note and str(folder) in note
    inside = load_dataset(
        transforms(folder, [str(folder / "images" / "a.png"), "images/../images/a.png"]), EVERYTHING
    )
    assert not any("outside" in note for note in map(str, inside.notes))


def test_a_mask_points_and_a_model_from_elsewhere_are_named(tmp_path, small):
    other = tmp_path / "m.png"
    Image.new("L", (16, 12), 255).save(other)
    folder = tmp_path / "capture"
    folder.mkdir()
    transforms(folder, ["images/a.png"])
    contents = json.loads((folder / "transforms.json").read_text())
    contents["frames"][0]["mask_path"] = "../m.png"
    (folder / "transforms.json").write_text(json.dumps(contents))
    assert any("m.png lies outside of" in note for note in map(str, load_dataset(folder, EVERYTHING).notes))
    write_colmap(tmp_path / "model", *small, binary=False)
    listed = tmp_path / "model" / "sparse" / "0" / "images.txt"
    listed.write_text(listed.read_text().replace("view_003.png", "../../away.png"))
    (tmp_path / "model" / "images" / "view_003.png").rename(tmp_path / "away.png")
    notes = [str(note) for note in load_dataset(tmp_path / "model", EVERYTHING).notes]
    assert any("away.png lies outside of" in note for note in notes)
    assert read_points(listed.parent) is not None
