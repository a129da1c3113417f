"""The poses that a user chose, where several programs left some: what is read, and what is refused."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from data.pose_programs import CAMERAS, WRITERS, write_nvm, write_opensfm
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.capture import capture_folder
from gsplat_edu.data.chosen_poses import CHOSEN, PoseChoice, choose_poses, chosen_poses, pose_choices
from gsplat_edu.data.left_out import read_left_out, write_left_out
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import layout_of, read_capture
from gsplat_edu.data.sparse_depth import tracked_points
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.options.poses import posed_by
from gsplat_edu.survey.support import observed_points


@pytest.fixture
def capture(tmp_path):
    """OpenSfM poses all photos, VisualSFM four of them."""
    write_opensfm(tmp_path)
    write_nvm(tmp_path, CAMERAS[:4])
    return tmp_path


def test_the_choice_is_read_until_it_is_taken_back(capture):
    assert [choice.program for choice in pose_choices(capture)] == ["VisualSFM", "OpenSfM"]
    assert (read_capture(capture).layout, len(read_capture(capture).frames)) == ("OpenSfM", 6)
    choose_poses(capture, "any name.nvm")
    assert (capture / CHOSEN).read_text() == "any name.nvm\n"
    found = read_capture(capture)
    assert (layout_of(capture), found.layout, len(found.frames)) == ("VisualSFM", "VisualSFM", 4)
    assert "not read" not in " ".join(map(str, found.notes))
    assert (
        read_capture(capture / "reconstruction.json").layout == "OpenSfM"
    )  # a file that is named comes first
    choose_poses(capture, None)
    assert not (capture / CHOSEN).exists() and read_capture(capture).layout == "OpenSfM"


def test_poses_of_another_program_can_be_chosen_before_a_transforms_json(tmp_path):
    views, _, _ = procedural_capture(24, 6, splats=40)
    write_transforms(tmp_path, views)
    write_opensfm(tmp_path)
    assert pose_choices(tmp_path) == [
        PoseChoice("transforms.json", "transforms.json"),
        PoseChoice("reconstruction.json", "OpenSfM"),
    ]
    assert read_capture(tmp_path).layout == "transforms.json"
    choose_poses(tmp_path, "reconstruction.json")
    assert read_capture(tmp_path).layout == "OpenSfM"
    choose_poses(tmp_path, "transforms.json")
    assert read_capture(tmp_path).layout == "transforms.json"


@pytest.mark.parametrize("place", ["sparse/0", "sparse/1", "sparse", "colmap/sparse/0", "12", "."])
def test_a_model_of_colmap_can_be_chosen_wherever_it_is(tmp_path, place):
    """The capture's own name is a number, as models' names are."""
    capture = tmp_path / "7"
    views, points, colors = procedural_capture(24, 6, splats=40)
    write_transforms(capture, views)
    write_colmap(tmp_path / "colmap", views[:4], points, colors)
    write_left_out(capture, ["images/view_001.png"])
    shutil.copytree(tmp_path / "colmap" / "sparse" / "0", capture / place, dirs_exist_ok=True)
    file = Path(place, "images.bin").as_posix()
    assert pose_choices(capture) == [
        PoseChoice("transforms.json", "transforms.json"),
        PoseChoice(file, "COLMAP"),
    ]
    assert read_capture(capture).layout == "transforms.json"
    choose_poses(capture, file)
    for path in (capture, capture / file):
        found = read_capture(path)
        assert (found.layout, layout_of(path), len(found.frames)) == ("COLMAP", "COLMAP", 4)
    assert capture_folder(capture / file) == capture
    assert read_left_out(capture / file) == ("images/view_001.png",)
    assert posed_by(capture, Path(file)) == capture / file
    choose_poses(capture, "transforms.json")
    assert read_capture(capture).layout == "transforms.json"


def test_points_and_depth_are_of_the_model_that_was_chosen(tmp_path):
    views, points, colors = procedural_capture(24, 6, splats=40)
    write_colmap(tmp_path, views, points, colors)
    write_colmap(tmp_path / "other", views[:4], points[:10], colors[:10])
    shutil.move(tmp_path / "other" / "sparse" / "0", tmp_path / "sparse" / "1")
    assert [choice.file for choice in pose_choices(tmp_path)] == [
        "sparse/0/images.bin",
        "sparse/1/images.bin",
    ]
    assert (len(read_capture(tmp_path).frames), len(read_capture(tmp_path).cloud.points)) == (6, len(points))
    choose_poses(tmp_path, "sparse/1/images.bin")
    assert (len(read_capture(tmp_path).frames), len(read_capture(tmp_path).cloud.points)) == (4, 10)
    assert len(tracked_points(tmp_path, 1e9, 0).points) == 10
    for points in tmp_path.rglob("points3D.bin"):  # which say that the tracks are no evidence
        points.unlink()
    assert len(observed_points(tmp_path)) == len(observed_points(tmp_path / "sparse/1/images.bin")) == 4
    choose_poses(tmp_path, None)
    assert len(observed_points(tmp_path)) == 6


def test_blenders_file_can_be_chosen(tmp_path):
    (tmp_path / "transforms_train.json").write_text("{}")
    write_opensfm(tmp_path)
    assert [choice.program for choice in pose_choices(tmp_path)] == ["Blender", "OpenSfM"]
    choose_poses(tmp_path, "reconstruction.json")
    assert read_capture(tmp_path).layout == "OpenSfM"


@pytest.mark.parametrize(("program", "write"), WRITERS.items())
def test_a_capture_of_one_program_has_one_file_that_can_be_chosen(tmp_path, program, write):
    write(tmp_path)
    (choice,) = pose_choices(tmp_path)
    assert choice.program == program
    eyes = np.array([frame.eye for frame in read_capture(tmp_path).frames])
    choose_poses(tmp_path, choice.file)
    assert np.array_equal(np.array([frame.eye for frame in read_capture(tmp_path).frames]), eyes)


@pytest.mark.parametrize(
    "name", ["gone.xml", "../reconstruction.json", "/etc/passwd", "", "images/shot_0.png"]
)
def test_a_choice_of_something_else_costs_one_line(capture, name):
    with pytest.raises(DatasetError, match="is no file with poses"):
        choose_poses(capture, name)
    assert not (capture / CHOSEN).exists()
    (capture / CHOSEN).write_text(name)
    with pytest.raises(
        DatasetError, match=r"chosen_poses\.txt: .* choose again, or delete the file"
    ) as caught:
        read_capture(capture)
    assert "\n" not in str(caught.value)
    assert layout_of(capture) is not None  # the capture stays one


def test_a_choice_that_is_not_text_costs_one_line(capture):
    (capture / CHOSEN).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DatasetError, match=r"chosen_poses\.txt: is not text in UTF-8"):
        chosen_poses(capture)
