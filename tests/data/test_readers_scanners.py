"""Poses of Polycam, Record3D, 7-Scenes, ScanNet and TUM: photos, lenses and damage."""

import json

import pytest

from data.pose_programs import (
    CAMERAS,
    WRITERS,
    assert_reads,
    numbered,
    polycam_name,
    tum_time,
    write_photo,
    write_polycam,
    write_record3d,
    write_scannet,
    write_seven_scenes,
    write_tum,
)
from data.test_readers_openmvg import brown
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.reader import read_capture


def seen(x, y):
    return 20 * x + 12.4, 21 * y + 8.7


def tum_name(name):
    return f"rgb/{tum_time(name) + 0.004:.6f}.png"


def test_polycam(tmp_path):
    write_polycam(tmp_path)
    assert_reads(tmp_path, "Polycam", seen, called=polycam_name)


def test_polycams_own_poses_are_read_if_there_are_no_corrected_ones(tmp_path):
    write_polycam(tmp_path, kind="")
    assert_reads(tmp_path, "Polycam", seen, called=lambda name: polycam_name(name).replace("corrected_", ""))


def test_polycams_corrected_poses_go_with_corrected_photos(tmp_path):
    write_polycam(tmp_path, kind="")
    write_polycam(tmp_path)
    for path in (tmp_path / "keyframes/cameras").iterdir():
        path.write_text(path.read_text().replace('"fx": 20.0', '"fx": 30.0'))
    capture = read_capture(tmp_path)
    assert all(frame.lens.fx == 20.0 for frame in capture.frames)
    assert sorted(frame.name for frame in capture.frames) == [polycam_name(name) for name, _, _ in CAMERAS]


@pytest.mark.parametrize(
    ("photos", "metadata"), [("rgbd", "metadata"), ("EXR_RGBD/rgb", "EXR_RGBD/metadata.json")]
)
def test_record3d(tmp_path, photos, metadata):
    write_record3d(tmp_path, photos=photos, metadata=metadata)
    assert_reads(tmp_path, "Record3D", seen, called=lambda name: f"{photos}/{numbered(name)}.jpg")


def test_record3ds_intrinsics_of_each_frame(tmp_path):
    write_record3d(tmp_path, perFrameIntrinsicCoeffs=[[22.0, 23.0, 11.0, 9.0]] * 6)
    assert_reads(
        tmp_path,
        "Record3D",
        lambda x, y: (22 * x + 11, 23 * y + 9),
        called=lambda name: f"rgbd/{numbered(name)}.jpg",
    )


def test_a_packed_record3d_file_is_refused_with_advice(tmp_path):
    (tmp_path / "scan.r3d").write_bytes(b"PK\x03\x04")
    write_photo(tmp_path / "images/0.jpg")
    with pytest.raises(DatasetError, match=r"scan\.r3d: is packed; unzip it"):
        read_capture(tmp_path)


def test_seven_scenes(tmp_path):
    write_seven_scenes(tmp_path)
    assert_reads(
        tmp_path,
        "7-Scenes",
        lambda x, y: (585 * x + 320, 585 * y + 240),
        called=lambda name: f"frame-{int(numbered(name)):06d}.color.png",
    )


def test_scannet(tmp_path):
    write_scannet(tmp_path)
    assert_reads(tmp_path, "ScanNet", seen, called=lambda name: f"color/{numbered(name)}.jpg")


def test_a_pose_that_scannet_lost_leaves_its_photo_out(tmp_path):
    write_scannet(tmp_path)
    (tmp_path / "pose/2.txt").write_text("-inf -inf -inf -inf\n" * 4)
    capture = read_capture(tmp_path)
    assert sorted(frame.name for frame in capture.frames) == [f"color/{i}.jpg" for i in (0, 1, 3, 4, 5)]
    assert any("lost its pose" in str(note) for note in capture.notes)


def test_scannets_lens_is_asked_for(tmp_path):
    write_scannet(tmp_path)
    (tmp_path / "intrinsic/intrinsic_color.txt").unlink()
    with pytest.raises(
        DatasetError, match=r"lacks the lens of its photos; put intrinsic/intrinsic_color\.txt"
    ):
        read_capture(tmp_path)


@pytest.mark.parametrize("rgb", ["rgb.txt", None])
def test_tum_takes_the_nearest_pose(tmp_path, rgb):
    write_tum(tmp_path, rgb=rgb)
    assert_reads(tmp_path, "TUM", seen, called=tum_name)


def test_tum_with_distortion(tmp_path):
    write_tum(tmp_path, lens=(20.0, 21.0, 11.9, 8.2, -0.1, 0.02, 0.003, -0.002, -0.004))

    def distorted(x, y):
        return seen(*brown(x, y, -0.1, 0.02, -0.004, 0.003, -0.002))

    assert_reads(tmp_path, "TUM", distorted, called=tum_name)


def test_tum_in_the_order_of_photos(tmp_path):
    write_tum(tmp_path, rgb=None)
    path = tmp_path / "groundtruth.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[1::2]))
    for i, photo in enumerate(sorted((tmp_path / "rgb").iterdir())):
        photo.rename(photo.with_name(f"shot_{i}.png"))
    assert_reads(tmp_path, "TUM", seen, called=lambda name: f"rgb/{name}")
    (tmp_path / "rgb/shot_0.png").unlink()
    with pytest.raises(DatasetError, match=r"has 6 poses for 5 photos; put rgb\.txt beside it"):
        read_capture(tmp_path)


def test_a_photo_without_a_pose_in_time_is_left_out(tmp_path):
    write_tum(tmp_path)
    path = tmp_path / "rgb.txt"
    path.write_text(path.read_text() + "1305031200.0 rgb/later.png\n")
    assert any("within 0.02 s" in str(note) for note in read_capture(tmp_path).notes)


@pytest.mark.parametrize(
    ("program", "name", "text", "says"),
    [
        ("TUM", "calibration.txt", None, "has no lens; write fx fy cx cy"),
        ("TUM", "calibration.txt", "1 2 3", "has 3 numbers; write fx fy cx cy"),
        ("TUM", "rgb.txt", "one rgb/a.png", "rgb.txt, line 1: is 'one', but has to be 1 numbers"),
        (
            "TUM",
            "groundtruth.txt",
            "1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n",
            "groundtruth.txt, line 2: .* 8 numbers",
        ),
        ("ScanNet", "pose/1.txt", "1 0 0", "1.txt: is '1 0 0', but has to be 16 numbers"),
        ("7-Scenes", "frame-000001.pose.txt", "1 nan", "pose.txt: is '1 nan', but has to be 16 numbers"),
        ("Polycam", "keyframes/corrected_cameras/shot_1.json", '{"t_00": 1}', "lacks 'fx'"),
        ("Record3D", "metadata", '{"w": 24}', "lacks 'h'"),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, program, name, text, says):
    WRITERS[program](tmp_path)
    (tmp_path / name).unlink()
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(DatasetError, match=says) as caught:
        read_capture(tmp_path)
    assert str(caught.value).startswith(str(tmp_path)) and "\n" not in str(caught.value)


def test_a_pose_without_length_and_other_counts_of_intrinsics_are_refused(tmp_path):
    write_record3d(tmp_path, perFrameIntrinsicCoeffs=[[22.0, 23.0, 11.0, 9.0]])
    with pytest.raises(DatasetError, match="has 6 poses, but 1 intrinsics"):
        read_capture(tmp_path)
    path = tmp_path / "metadata"
    contents = json.loads(path.read_text())
    del contents["perFrameIntrinsicCoeffs"]
    contents["poses"][1][:4] = [0, 0, 0, 0]
    path.write_text(json.dumps(contents))
    with pytest.raises(DatasetError, match="pose 1: its quaternion has the length 0"):
        read_capture(tmp_path)
