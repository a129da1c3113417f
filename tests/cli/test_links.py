"""Folders from strangers: no command writes or deletes through a link that leads out of a run or capture."""

import os
import shutil

import pytest

from gsplat_edu.base.links import check_links, is_inside
from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from systems import needs_posix

pytestmark = needs_posix

CHECKPOINTS = [f"iteration_{number}.safetensors" for number in (1, 2, 3)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A capture, and a run of it."""
    root = tmp_path_factory.mktemp("trained")
    write_colmap(root / "box", *procedural_capture(24, 6))
    assert main([*words(root), "--iterations", "5"]) == 0
    return root


def words(root):
    options = "--test-every 3 --backend cpu --appearance none --sky none --eval-every 0 --max-gaussians 500"
    return ["train", str(root / "box"), "--out", str(root / "run"), *options.split()]


@pytest.fixture
def stranger(trained, tmp_path):
    """A copy of the run, and a folder of the user with files named like those of a run."""
    shutil.copytree(trained, tmp_path / "from")
    mine = tmp_path / "mine"
    (mine / "test").mkdir(parents=True)
    for name in (*CHECKPOINTS, "test/frame_000.png", "metrics.json", "notes.txt"):
        (mine / name).write_text("precious")
    return tmp_path / "from", mine


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refused(capsys, command, link):
    capsys.readouterr()
    assert main(command) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"{link} is a link that leads out of" in error, error


def linked(root, part, target):
    """Put a link in the place of a part of the run."""
    place = root / "run" / part
    if place.is_dir():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(target)
    return place


@pytest.mark.parametrize("part", ["renders", "renders/test", "refined", "checkpoints", "log.jsonl"])
def test_eval_and_resume_leave_what_links_lead_to_alone(stranger, capsys, part):
    root, mine = stranger
    link = linked(root, part, mine / "notes.txt" if part == "log.jsonl" else mine)
    before, inside = contents(mine), sorted((root / "run").iterdir())
    refused(capsys, ["eval", str(root / "run")], link)
    refused(capsys, [*words(root), "--iterations", "8", "--resume"], link)
    refused(capsys, ["render", str(root / "run"), "--frames", "2"], link)
    refused(capsys, ["clean", str(root / "run")], link)
    assert contents(mine) == before and sorted((root / "run").iterdir()) == inside


def test_a_link_that_leads_in_a_circle_or_to_a_pipe_is_named(stranger, capsys):
    root, _ = stranger
    link = linked(root, "renders", "renders")
    refused(capsys, ["eval", str(root / "run")], link)
    link.unlink()
    (root / "run" / "config.json").unlink()
    os.mkfifo(root / "run" / "config.json")
    assert main(["eval", str(root / "run")]) == 2 and capsys.readouterr().err.count("\n") == 1


def test_a_checkpoint_that_is_a_pipe_is_named(stranger, capsys):
    root, _ = stranger
    place = root / "run" / "checkpoints" / "iteration_5.safetensors"
    place.unlink()
    os.mkfifo(place)
    assert main([*words(root), "--iterations", "8", "--resume"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"{place}: cannot be read (is a pipe, not a file)" in error


def test_poses_are_not_searched_in_a_folder_elsewhere(stranger, capsys, tmp_path):
    root, mine = stranger
    photos = root / "box" / "images"
    (root / "found").mkdir()
    (root / "found" / "sfm").symlink_to(mine)
    before = contents(mine)
    refused(capsys, ["sfm", str(photos), str(root / "found")], root / "found" / "sfm")
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "capture").symlink_to(mine)
    train = ["train", str(photos), "--out", str(tmp_path / "new")]
    refused(capsys, train, tmp_path / "new" / "capture")
    blocks = [*train, "--blocks", "2", "--iterations", "5", "--coarse-iterations", "5"]
    refused(capsys, blocks, tmp_path / "new" / "capture")
    assert contents(mine) == before


def test_links_within_a_folder_and_to_the_folder_itself_are_followed(tmp_path):
    (tmp_path / "run" / "renders").mkdir(parents=True)
    (tmp_path / "run" / "again").symlink_to("renders")
    (tmp_path / "way").symlink_to("run")
    check_links("RUN", tmp_path / "way")
    assert is_inside(tmp_path / "way" / "again", [tmp_path / "run"])
    assert not is_inside(tmp_path / "run" / ".." / "other", [tmp_path / "run"])
