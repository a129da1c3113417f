"""Captures with poses of other programs: how photos are found, which of several files is read, and damaged files."""

import re

import numpy as np
import pytest

from data.pose_programs import CAMERAS, WRITERS, write_bundler, write_nvm, write_opensfm
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.reader import layout_of, read_capture
from gsplat_edu.data.writers import write_colmap

DAMAGED = 60
"""Damaged copies of each program's file that are read."""


@pytest.mark.parametrize(("program", "write"), WRITERS.items())
def test_the_layout_is_found_by_content(tmp_path, program, write):
    write(tmp_path)
    assert layout_of(tmp_path) == program
    dataset = load_dataset(tmp_path)
    assert (dataset.layout, len(dataset.train) + len(dataset.test)) == (program, 6)
    for path in tmp_path.rglob("*"):
        if path.is_file() and path.suffix not in (".png", ".jpg"):
            path.write_bytes(b"of another program")
    assert layout_of(tmp_path) is None


def test_a_pose_file_can_be_given_itself(tmp_path):
    write_opensfm(tmp_path)
    write_nvm(tmp_path)
    assert layout_of(tmp_path / "any name.nvm") == "VisualSFM"
    assert read_capture(tmp_path / "any name.nvm").layout == "VisualSFM"
    assert read_capture(tmp_path / "reconstruction.json").layout == "OpenSfM"


def test_photos_are_found_by_path_then_name_then_stem_in_any_case(tmp_path):
    write_opensfm(tmp_path)
    images = tmp_path / "images"
    (images / "shot_0.png").rename(images / "SHOT_0.PNG")
    (images / "deeper").mkdir()
    (images / "shot_1.png").rename(images / "deeper" / "shot_1.png")
    (images / "shot_2.png").rename(images / "shot_2.webp")
    path = tmp_path / "reconstruction.json"
    path.write_text(path.read_text().replace('"shot_3.png"', '"C:\\\\work\\\\shot_3.png"'))
    path.write_text(path.read_text().replace('"shot_4.png"', '"shot_4"'))
    names = sorted(frame.name for frame in read_capture(tmp_path).frames)
    assert names == sorted(
        ["SHOT_0.PNG", "deeper/shot_1.png", "shot_2.webp", "shot_3.png", "shot_4.png", "shot_5.png"]
    )


def test_a_name_that_fits_two_photos_is_an_error(tmp_path):
    write_opensfm(tmp_path)
    for folder in ("left", "right"):
        (tmp_path / "images" / folder).mkdir()
        (tmp_path / "images" / folder / "shot_1.png").write_bytes(
            (tmp_path / "images" / "shot_1.png").read_bytes()
        )
    assert len(read_capture(tmp_path).frames) == 6  # the whole path fits images/shot_1.png
    (tmp_path / "images" / "shot_1.png").unlink()
    with pytest.raises(
        DatasetError, match=r"names the photo shot_1\.png, but images/left/shot_1\.png and images/"
    ):
        read_capture(tmp_path)


def test_two_names_of_one_photo_are_an_error(tmp_path):
    write_opensfm(tmp_path)
    path = tmp_path / "reconstruction.json"
    path.write_text(path.read_text().replace('"shot_3.png"', '"other/shot_1.png"'))
    with pytest.raises(DatasetError, match=r"shot_1\.png would both be the photo images/shot_1\.png"):
        read_capture(tmp_path)


def test_missing_photos_are_noted_and_all_missing_is_an_error(tmp_path):
    write_opensfm(tmp_path)
    (tmp_path / "images" / "shot_2.png").unlink()
    notes = list(map(str, read_capture(tmp_path).notes))
    assert notes == [
        "poses of OpenSfM: 5 of 5 photos",
        "1 of 6 photos have no file: skipped, first shot_2.png",
    ]
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    with pytest.raises(
        DatasetError, match=r"none of its 6 photos is in .*, first shot_0\.png; put the photos"
    ):
        read_capture(tmp_path)


def test_of_several_files_the_one_that_poses_more_photos_is_read(tmp_path):
    write_bundler(tmp_path)
    path = tmp_path / "bundle.out"
    path.write_text(path.read_text().replace("20.0 -0.1 0.02", "0 0 0", 2))
    write_nvm(tmp_path)
    (tmp_path / "reconstruction.json").write_text("[{")
    first, second, *_ = map(str, read_capture(tmp_path).notes)
    assert first == "poses of VisualSFM: 6 of 6 photos"
    assert second.startswith(
        "any name.nvm (6 photos) is read, as it poses the most photos; not read: bundle.out (4 photos), "
        "reconstruction.json ("
    )


def test_a_colmap_model_comes_first(tmp_path, small):
    write_colmap(tmp_path, *small)
    write_opensfm(tmp_path)
    assert read_capture(tmp_path).layout == layout_of(tmp_path) == "COLMAP"


def test_photos_alone_are_no_capture_and_the_error_names_what_was_looked_for(tmp_path):
    write_opensfm(tmp_path)
    (tmp_path / "reconstruction.json").unlink()
    programs = (
        "OpenSfM, Metashape, RealityCapture, OpenMVG, Meshroom, Pix4D, Bundler, VisualSFM, LLFF, Polycam, Record3D, "
        "7-Scenes, ScanNet, TUM"
    )
    said = f"holds photos but no camera poses; .* poses of {programs}"
    with pytest.raises(DatasetError, match=said):
        read_capture(tmp_path)


@pytest.mark.parametrize(("program", "write"), WRITERS.items())
def test_a_photo_that_is_absurdly_far_away_is_left_out(tmp_path, program, write):

    far = CAMERAS[0][0], CAMERAS[0][1], np.full(3, 1e13)
    write(tmp_path, [far, *CAMERAS[1:]])
    capture = read_capture(tmp_path)
    assert len(capture.frames) == 5
    assert any("1 of 6 photos has an unusable pose" in str(note) for note in capture.notes)


@pytest.mark.parametrize(("program", "write"), WRITERS.items())
def test_damaged_files_raise_our_errors_only(tmp_path, program, write):
    """Bytes are changed, cut off or repeated; what is still read has finite poses."""
    write(tmp_path)
    rng = np.random.default_rng(7)
    poses = (p for p in tmp_path.rglob("*") if p.is_file() and p.suffix not in (".png", ".jpg"))
    files = sorted(poses)[:3]
    refused = 0
    for path in files:
        whole = path.read_bytes()
        for _ in range(DAMAGED):
            data = bytearray(whole)
            kind, at = rng.integers(4), int(rng.integers(len(data)))
            if kind == 0:
                del data[at:]
            elif kind == 1:
                data[at:at] = data[at : at + int(rng.integers(1, 60))]
            else:
                for place in rng.integers(len(data), size=1 + 7 * (kind - 2)):
                    data[place] = rng.integers(256) if kind == 2 else rng.choice(list(b'0-9e."{[<>,\n'))
            path.write_bytes(data)
            try:
                frames = read_capture(tmp_path).frames
            except DatasetError as error:
                refused += 1
                assert re.fullmatch("[^\n]+", str(error))
            else:
                assert all(np.isfinite(frame.eye).all() for frame in frames)
        path.write_bytes(whole)
    assert refused > DAMAGED / 4
