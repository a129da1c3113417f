import os
import subprocess
import sys

import cv2
import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.base.files import written_aside
from gsplat_edu.evaluate.images import NOT_WRITTEN, save_png, side_by_side, write_frames


def colour(height, width, rgb):
    return np.broadcast_to(np.array(rgb, dtype=np.uint8), (height, width, 3))


def test_a_png_holds_the_bytes(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    save_png(tmp_path / "new" / "a.png", image)
    np.testing.assert_array_equal(np.array(Image.open(tmp_path / "new" / "a.png")), image)
    save_png(tmp_path / "b.png", image / 255.0)
    np.testing.assert_array_equal(np.array(Image.open(tmp_path / "b.png")), image)


def test_side_by_side_puts_a_line_between_images():
    row = side_by_side([colour(6, 5, (255, 0, 0)), np.zeros((6, 3, 3))])
    assert row.shape == (6, 5 + 4 + 3, 3)
    assert (row[:, :5] == (255, 0, 0)).all() and (row[:, 5:9] == 128).all() and (row[:, 9:] == 0).all()


@pytest.mark.usefixtures("as_shipped")
def test_side_by_side_refuses_other_heights():
    with pytest.raises(ShapeError, match="images"):
        side_by_side([colour(6, 5, (0, 0, 0)), colour(5, 5, (0, 0, 0))])
    with pytest.raises(ArgumentError, match="images: is empty"):
        side_by_side([])


def test_frames_go_into_a_folder_numbered_or_named(tmp_path):
    frames = [colour(4, 4, (i, i, i)) for i in range(3)]
    assert [p.name for p in write_frames(tmp_path / "f", iter(frames))] == [
        "frame_0000.png",
        "frame_0001.png",
        "frame_0002.png",
    ]
    (path,) = write_frames(tmp_path / "g", frames[2:], names=["left.png"])
    assert path == tmp_path / "g" / "left.png" and np.array(Image.open(path))[0, 0, 0] == 2


@pytest.mark.parametrize(
    ("frames", "says"),
    [
        ([], "frames: is empty"),
        ([(4, 4), (4, 6)], "frame 1 is 6x4, but the first is 4x4; write a folder"),
    ],
)
def test_an_impossible_video_leaves_no_file(tmp_path, frames, says):
    with pytest.raises(ArgumentError, match=says):
        write_frames(tmp_path / "v.mp4", [colour(*size, (0, 0, 0)) for size in frames])
    assert list(tmp_path.iterdir()) == []


def test_a_file_and_a_folder_are_not_confused(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(ArgumentError, match=r"taken: is a file; give a video \(\.mp4\) or a folder of PNGs"):
        write_frames(tmp_path / "taken", [colour(4, 4, (0, 0, 0))])
    (tmp_path / "v.mp4").mkdir()
    with pytest.raises(ArgumentError, match=r"v\.mp4: is a folder"):
        write_frames(tmp_path / "v.mp4", [colour(4, 4, (0, 0, 0))])
    with pytest.raises(ArgumentError, match="frames: is empty"):
        write_frames(tmp_path / "none", [])


@pytest.mark.parametrize("suffix", [*sorted(NOT_WRITTEN), ".GIF"])
def test_other_formats_are_refused_by_name(tmp_path, suffix):
    """`--out x.gif` used to create a folder."""
    with pytest.raises(
        ArgumentError, match=rf"x\{suffix}: {suffix[1:].upper()} is not supported; give a video"
    ):
        write_frames(tmp_path / f"x{suffix}", [colour(4, 4, (0, 0, 0))])
    assert list(tmp_path.iterdir()) == []


def test_a_folder_may_have_a_dot_in_its_name(tmp_path):
    (tmp_path / "made.gif").mkdir()
    for name in ("frames.v2", "made.gif"):
        assert write_frames(tmp_path / name, [colour(4, 4, (0, 0, 0))]) == [
            tmp_path / name / "frame_0000.png"
        ]


def test_leftovers_of_killed_writers_are_removed_and_other_files_kept(tmp_path):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    with written_aside(tmp_path / "x") as aside:
        machine = aside.name.split(".")[2].split("-")[0]
    (tmp_path / "x").unlink()
    other = "0" * 8 if machine != "0" * 8 else "1" * 8
    stale = [
        f".v.{machine}-{gone.pid}-abcd1234.mp4",
        f".frame_0001.{machine}-{gone.pid}-a_b_c_d1.png",
        f".x.{machine}-{gone.pid}-00000000",
        f".old.{other}-{os.getppid()}-abcd1234.mp4",
    ]
    kept = [
        f".v.{machine}-{os.getppid()}-abcd1234.mp4",
        f".v.{other}-{gone.pid}-abcd1234.mp4",  # no such process on this machine, but perhaps on the other
        f"v.{machine}-{gone.pid}-abcd1234.mp4",
        ".v.original.mp4",
        ".v.12-ab.mp4",
    ]
    for name in (*stale, *kept):
        (tmp_path / name).write_text("")
    os.utime(tmp_path / stale[3], (0, 0))
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / stale[0]).write_text("not in this folder")
    write_frames(tmp_path / "v.mp4", [colour(4, 4, (0, 0, 0))])
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*kept, "v.mp4", "below"])
    assert list((tmp_path / "below").iterdir())
    (tmp_path / "below" / stale[1]).write_text("")
    write_frames(tmp_path / "below", [colour(4, 4, (0, 0, 0))])
    assert [p.name for p in (tmp_path / "below").iterdir()] == ["frame_0000.png"]


def test_an_encoder_that_does_not_open_is_reported(tmp_path, monkeypatch):
    class Closed:
        fourcc = staticmethod(lambda *_: 0)

        def __init__(self, *_):
            pass

        def isOpened(self):
            return False

        def release(self):
            pass

    monkeypatch.setattr(cv2, "VideoWriter", Closed)
    with pytest.raises(ArgumentError, match="OpenCV cannot encode VP9 at 4x4, 30 fps here; write a folder"):
        write_frames(tmp_path / "v.mp4", [colour(4, 4, (0, 0, 0))])
