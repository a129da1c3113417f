"""Photos on a capture's list are not used, by any command; the held-out views stay, and the list is undone."""

import json

import numpy as np
import pytest

from gsplat_edu import orbit_camera
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.left_out import LEFT_OUT, read_left_out, write_left_out
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.scene.views import View

SIZE = 24


@pytest.fixture
def capture(tmp_path):
    """Return a capture of 16 grey photos; every eighth is held out."""
    grey = np.full((SIZE, SIZE, 3), 120, np.uint8)
    cameras = [orbit_camera(0.4 * i, 0.1, SIZE, 30.0) for i in range(16)]
    views = [View(camera, grey + i, name=f"{i:04d}.png") for i, camera in enumerate(cameras)]
    points = np.random.default_rng(0).normal(size=(200, 3)) * 0.2
    write_transforms(tmp_path / "capture", views, points, np.full((200, 3), 0.5))
    return tmp_path / "capture"


def names(dataset):
    return [view.name for view in dataset.train], [view.name for view in dataset.test]


def photo(capture, number):
    return next(
        path.relative_to(capture).as_posix()
        for path in capture.rglob("*.png")
        if f"{number:04d}" in path.name
    )


def test_a_photo_that_is_left_out_is_used_nowhere_and_the_split_stays(capture, capsys):
    train, test = names(load_dataset(capture))
    assert main(["leave-out", str(capture), "0003.png"]) == 0
    assert "1 of 16 photos are left out" in capsys.readouterr().out
    dataset = load_dataset(capture)
    gone = next(name for name in train if "0003" in name)
    assert names(dataset) == ([name for name in train if name != gone], test)
    assert f"1 of 16 photos are left out, first {gone}" in map(str, dataset.notes)
    assert len(dataset.files) == 15
    # a run that was made before keeps its photos
    assert names(load_dataset(capture, DataSettings(left_out=()))) == (train, test)
    listed = DataSettings(train_views=tuple(train), test_views=tuple(test))
    assert names(load_dataset(capture, listed)) == (train, test)
    assert main(["doctor", str(capture)]) == 0
    assert "1 of 16 photos are left out" in capsys.readouterr().out
    assert main(["leave-out", str(capture), photo(capture, 3), "--undo"]) == 0
    assert not (capture / LEFT_OUT).exists()
    assert names(load_dataset(capture)) == (train, test)


def test_a_damaged_photo_can_be_left_out(capture):
    (capture / photo(capture, 5)).write_bytes(b"\x89PNG damaged")
    with pytest.raises(DatasetError):
        load_dataset(capture)
    assert main(["leave-out", str(capture), "0005.png"]) == 0
    assert len(load_dataset(capture).files) == 15


def test_a_held_out_photo_can_be_left_out_too(capture):
    _, test = names(load_dataset(capture))
    assert main(["leave-out", str(capture), test[0]]) == 0
    assert names(load_dataset(capture))[1] == test[1:]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["9999.png"], "has no photo 9999.png; give its path below the folder, as"),
        ([f"{i:04d}.png" for i in range(16)], "none of its 16 photos would be left; keep some"),
        (["0001.png", "x\x1b[31m"], "has no photo"),
    ],
)
def test_mistakes_are_one_line_and_change_nothing(capture, capsys, words, line):
    write_left_out(capture, [photo(capture, 2)])
    before = (capture / LEFT_OUT).read_bytes()
    assert main(["leave-out", str(capture), *words]) == 2
    said = capsys.readouterr().err
    assert line in said and said.count("\n") == 1 and "\x1b" not in said
    assert (capture / LEFT_OUT).read_bytes() == before


def test_lists_by_hand_are_read(capture, capsys):
    path = photo(capture, 4)
    (capture / LEFT_OUT).write_bytes(f"# my list\r\n\r\n {path} \r\nnot/here.jpg\r\n".encode())
    assert read_left_out(capture) == (path, "not/here.jpg")
    assert len(load_dataset(capture).files) == 15  # a photo that is gone may stay on the list
    assert main(["leave-out", str(capture), "0004.png", "--undo"]) == 0
    assert read_left_out(capture) == ("not/here.jpg",)
    (capture / LEFT_OUT).write_bytes(b"\xff\xfe\x00")
    assert main(["info", str(capture)]) == 2
    assert "left_out.txt: is not text in UTF-8" in capsys.readouterr().err


def test_a_list_of_every_photo_for_training_is_one_line(capture, capsys):
    write_left_out(
        capture, [f"images/{i:04d}.png" for i in range(16)] + [photo(capture, i) for i in range(16)]
    )
    assert main(["info", str(capture)]) == 2
    assert "left_out.txt leaves out every photo for training" in capsys.readouterr().err


def test_a_run_keeps_the_list_with_which_it_began(capture, tmp_path, capsys):
    out = tmp_path / "run"
    words = ["train", str(capture), "--out", str(out), "--iterations", "20", "--eval-every", "0"]
    assert main(["leave-out", str(capture), "0003.png"]) == 0
    assert main(words) == 0
    assert json.loads((out / "config.json").read_text())["data"]["left_out"] == [photo(capture, 3)]
    assert main(["leave-out", str(capture), "0004.png", "0005.png"]) == 0
    words[words.index("20")] = "30"
    capsys.readouterr()
    assert main([*words, "--resume"]) == 0  # with the photos with which it began
    assert "1 of 16 photos are left out" in capsys.readouterr().out
    assert main(["eval", str(out)]) == 0
