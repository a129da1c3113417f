"""The poses that a user chose, where several programs left some: what is read, and what is refused."""

import numpy as np
import pytest

from data.pose_programs import CAMERAS, WRITERS, write_nvm, write_opensfm
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.chosen_poses import CHOSEN, PoseChoice, choose_poses, chosen_poses, pose_choices
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import layout_of, read_capture
from gsplat_edu.data.writers import write_transforms


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
