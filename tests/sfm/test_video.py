import os
import re
import struct
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import gsplat_edu
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from gsplat_edu.sfm.video import choose_frames, is_video, write_frames
from lab.captures.textured_box import box_camera, photograph_box
from sfm.textured_box import cameras_of, check
from systems import needs_posix

BLURRED = range(7, 90, 9)
"""Frames that the test blurs as camera shake does."""


def silent(stage, done, total):
    pass


def write_video(path, frames):
    """Write RGB frames as mp4."""
    height, width = frames[0].shape[:2]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25, (width, height))
    for frame in frames:
        video.write(frame[..., ::-1])
    video.release()


def turn_metadata(path, matrix):
    """Write an orientation into the track header of an mp4, as phones do (ISO 14496-12, box tkhd, version 0)."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 4 + 5 * 4 + 8 + 8
    assert struct.unpack_from(">9i", data, at) == (65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", data, at, *matrix)
    path.write_bytes(data)


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A video of a walk around the box: 20 frames without motion, then 100 with motion, slower in the second half."""
    path = tmp_path_factory.mktemp("walk") / "walk.mp4"
    angles = np.concatenate([np.zeros(20), np.linspace(0, 2.6, 50), np.linspace(2.6, 3.9, 50)])
    cameras = [box_camera(angle, 0.45 + 0.15 * np.sin(3 * angle)) for angle in angles]
    frames = [photograph_box(camera) for camera in cameras]
    for i in BLURRED:
        frames[i] = cv2.blur(frames[i], (9, 1))
    write_video(path, frames)
    return SimpleNamespace(path=path, cameras=cameras, angles=angles)


def test_sharp_frames_are_chosen_at_equal_steps_of_motion(walk):
    steps = []
    chosen = choose_frames(walk.path, 24, lambda *step: steps.append(step))
    assert set(chosen) & set(BLURRED) == set()
    assert steps[-1] == ("choosing frames", 120, 120)
    assert len(chosen) == 24
    assert sum(number < 20 for number in chosen) == 1, "one of the frames in which the camera stands still"
    fast, slow = (sum(low <= n < high for n in chosen) for low, high in ((20, 70), (70, 120)))
    # The camera covers twice the angle in the first half. Flow is not proportional to the angle, as short sides move
    # less.
    assert 1.4 < fast / slow < 2.8

    steps = np.diff(walk.angles[chosen])
    # Chosen frames are less than two intervals apart. The factor 1.5 allows for uneven flow.
    assert steps.max() < 2 * 1.5 * walk.angles[-1] / 24


@pytest.mark.slow
def test_frames_become_a_capture(walk, colmap, tmp_path):
    said = []
    out = reconstruct(SfmOptions(walk.path, tmp_path / "capture", frames=24), said.append)
    found = cameras_of(out)
    numbers = {name: int(re.fullmatch(r"frame_(\d{6})\.jpg", name)[1]) for name in found}
    assert len(found) >= 22 and set(numbers.values()) & set(BLURRED) == set()
    check(found, {name: walk.cameras[number] for name, number in numbers.items()})
    assert said[0].startswith("frames: 24 of walk.mp4")

    said.clear()
    reconstruct(SfmOptions(walk.path, out, frames=24), said.append)
    assert len(said) == 6 and all(sentence.endswith("(done before)") for sentence in said)


@needs_posix
def test_a_video_name_need_not_be_utf8(walk, tmp_path):
    """OpenCV ends the process if a name is not UTF-8."""
    odd = tmp_path / os.fsdecode(b"raw\xff.mp4")
    odd.symlink_to(walk.path)
    chosen = choose_frames(odd, 3, silent)
    (plain, raw) = (tmp_path / "plain", tmp_path / os.fsdecode(b"frames\xfe"))
    written = [
        write_frames(path, chosen, folder, silent) for path, folder in ((walk.path, plain), (odd, raw))
    ]
    assert len(written[0]) == 3
    assert [file.read_bytes() for file in written[0]] == [file.read_bytes() for file in written[1]]


def test_frames_without_motion_are_left_out(tmp_path):
    """Noise is not motion, so a video from a table gives one photo instead of one per interval."""
    rng = np.random.default_rng(0)
    still = photograph_box(box_camera(0.3)).astype(int)
    frames = [np.clip(still + rng.normal(0, 3, still.shape), 0, 255).astype(np.uint8) for _ in range(40)]
    write_video(tmp_path / "table.mp4", frames)
    chosen = choose_frames(tmp_path / "table.mp4", 10, silent)
    written = write_frames(tmp_path / "table.mp4", chosen, tmp_path / "frames", silent)
    assert len(written) == 1
    with pytest.raises(DatasetError, match="table.mp4: the camera moves too little"):
        reconstruct(SfmOptions(tmp_path / "table.mp4", tmp_path / "out"))


def test_a_short_video_gives_all_its_frames(tmp_path):
    write_video(tmp_path / "short.mp4", [photograph_box(box_camera(0.2 * i)) for i in range(5)])
    assert choose_frames(tmp_path / "short.mp4", 150, silent) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("matrix", "corner"),
    [
        # rotating clockwise by a quarter moves the top left corner to the top right
        (
            (0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30),
            (0, -1),
        ),
        ((-65536, 0, 0, 0, -65536, 0, 0, 0, 1 << 30), (-1, -1)),
        ((0, -65536, 0, 65536, 0, 0, 0, 0, 1 << 30), (-1, 0)),
    ],
)
def test_frames_are_upright(tmp_path, matrix, corner):
    frames = []
    for i in range(4):
        frame = np.zeros((96, 160, 3), np.uint8)
        frame[:24, :40] = 255
        frame[40:60, 20 * i : 20 * i + 40] = 128
        frames.append(frame)
    write_video(tmp_path / "held.mp4", frames)
    turn_metadata(tmp_path / "held.mp4", matrix)
    first, *_ = write_frames(tmp_path / "held.mp4", [0, 3], tmp_path / "frames", silent)
    image = cv2.imread(str(first), cv2.IMREAD_GRAYSCALE)
    assert image.shape == ((160, 96) if matrix[0] == 0 else (96, 160))
    white = {place for place in ((0, 0), (0, -1), (-1, 0), (-1, -1)) if image[place] > 200}
    assert white == {corner}


def test_a_long_video_is_sampled_in_steps(tmp_path, monkeypatch):
    monkeypatch.setattr("gsplat_edu.sfm.video.CANDIDATES", 2)
    write_video(
        tmp_path / "long.mp4", [photograph_box(box_camera(0.03 * i, size=(96, 64))) for i in range(64)]
    )
    chosen = choose_frames(tmp_path / "long.mp4", 8, silent)
    assert {number % 4 for number in chosen} == {0}, "two frames for each of 8 intervals, of 64 frames"


def test_videos_are_recognised_by_their_suffix(tmp_path):
    assert is_video(tmp_path / "a.MOV") and not is_video(tmp_path / "a.jpg")


@pytest.mark.parametrize("contents", [b"", b"not a video at all" * 100])
def test_an_unreadable_video_is_refused_in_one_line(tmp_path, contents):
    path = tmp_path / "broken.mp4"
    path.write_bytes(contents)
    with pytest.raises(DatasetError, match=r"broken.mp4: is not a video that OpenCV can decode") as failure:
        choose_frames(path, 10, silent)
    assert "\n" not in str(failure.value)


@pytest.mark.own_process
def test_ffmpeg_prints_nothing_of_its_own(tmp_path):
    """OpenCV is silenced once, before it opens its first video, so the test needs a new process."""
    (tmp_path / "broken.mp4").write_bytes(b"")
    code = f"""
import sys
sys.meta_path[:] = [finder for finder in sys.meta_path if "ScikitBuild" not in type(finder).__name__]
sys.path.insert(0, {str(Path(gsplat_edu.__file__).parents[1])!r})
from gsplat_edu.cli.main import main
sys.exit(main(["sfm", "broken.mp4", "out"]))
"""
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 2
    assert re.fullmatch(
        r"gsplat-edu sfm: broken\.mp4: is not a video that OpenCV can decode; .*\n", ran.stderr
    )
