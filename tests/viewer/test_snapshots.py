"""A training is watched through files in the run's folder, as by another process."""

import json
import os
import shutil
import threading
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.cli.main import build_parser
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.options.train import options_from
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.train.checkpoint import list_checkpoints
from gsplat_edu.viewer import live_folder, page_data, snapshots
from gsplat_edu.viewer.live_folder import LiveFolder, header_of
from gsplat_edu.viewer.snapshots import Broadcast, FolderWatcher, page_facts, snapshot_of
from live_clients import PATIENCE, until

GROWING = ["--max-gaussians", "300", "--set", "densify_start=5", "densify_every=10", "--seed", "3"]


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "egg"
    write_colmap(folder, *procedural_capture(24, 6, splats=60))
    return folder


def made_run(capture, out, *words):
    words = ["train", str(capture), "--out", str(out), *GROWING, *words]
    return CaptureRun(plan(options_from(build_parser(["train"]).parse_args(words)), Limits()).options)


class Watched:
    """A training in its own thread, watched through files."""

    def __init__(self, capture, out, *words):
        self.run, self.live, self.said = made_run(capture, out, *words), LiveFolder(out), []
        self.watcher = FolderWatcher(self.live, lambda: page_facts(self.run), self.said.append)
        self.stopped, self.failure = threading.Event(), None
        self.broadcast = Broadcast(self.run, self.stopped.is_set, [self.watcher])
        self.thread = threading.Thread(target=self._train)
        self.close = self.watcher.close

    def _train(self):
        try:
            self.run.train(self.stopped.is_set, [self.broadcast.show])
        except BaseException as error:
            self.failure = error

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.stopped.set()
        self.thread.join(PATIENCE)
        assert self.failure is None and not self.thread.is_alive()
        self.close()


def scene_of(path):
    """Read scene.bin by its specification; return its header and Gaussians."""
    data = path.read_bytes()
    length = int.from_bytes(data[:4], "little")
    assert length % 4 == 0
    header = json.loads(data[4 : 4 + length])
    return header, page_data.unpacked(path, data[4 + length :], header["count"], header["sh_degree"])


def test_no_files_are_written_unless_somebody_watches(capture, tmp_path):
    with Watched(capture, tmp_path / "run", "--iterations", "60") as made:
        made.thread.join(PATIENCE)
        assert not made.live.path.exists()


def test_a_watcher_gets_state_and_scene_of_the_same_iteration(capture, tmp_path):
    run = tmp_path / "run"
    LiveFolder(run).ask()
    LiveFolder(run).set_paused(True)
    with Watched(capture, run, "--iterations", "100000") as made:  # it is stopped long before
        live = made.live
        state = until(
            lambda: (live.ask(), (s := live.read_state()) and s["state"] == "paused" and s)[1], "the state"
        )
        assert made.said == [f"paused; remove {live.pause} to continue"]
        trainer = made.run.trainer
        assert state["iteration"] == state["scene"] == trainer.iteration == 1
        header, shown = scene_of(live.scene)
        assert header == header_of(live.scene) and header["iteration"] == 1
        assert (state["count"], state["iterations"], state["pid"]) == (len(shown), 100_000, os.getpid())
        assert state["history"]["iteration"] == [1] and state["history"]["loss"] == [state["loss"]]
        assert torch.equal(shown.means, trainer.gaussians.means.detach()), "means are exact"
        facts = live.read_page()
        assert facts["count"] == 0 and len(facts["cameras"]) == 6
        assert facts["start"]["camera"]["eye"] == facts["cameras"][facts["start"]["index"]]["eye"]

        live.set_paused(False)
        again = until(
            lambda: (live.ask(), (s := live.read_state())["iteration"] > 30 and s["scene"] > 1 and s)[1],
            "a newer scene",
        )
        assert header_of(live.scene)["iteration"] >= again["scene"] and again["pid"] == state["pid"]
        assert again["seconds_left"] > 0 and len(again["history"]["count"]) > 1
    assert not live.scene.exists() and not live.state.exists() and live.wanted.exists()


def test_no_files_are_written_after_the_watcher_left(capture, tmp_path):
    with Watched(capture, tmp_path / "run", "--iterations", "100000") as made:
        until(lambda: (made.live.ask(), made.live.scene.exists())[1], "a scene")
        os.utime(made.live.wanted, (0, 0))
        until(lambda: not made.watcher.watches(), "that the training has noticed it")
        held = made.run.trainer.iteration
        until(lambda: made.run.trainer.iteration > held + 20, "many more iterations")
        before = made.live.state.stat().st_mtime_ns
        held = made.run.trainer.iteration
        until(lambda: made.run.trainer.iteration > held + 60, "many more iterations")
        assert made.live.state.stat().st_mtime_ns == before


def bits(run):
    tensors, numbers = run.trainer.state()
    return {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}, repr(numbers)


def test_watching_and_pausing_by_files_does_not_change_the_bits(capture, tmp_path, monkeypatch):
    """The files are written after every iteration, however fast the training is and however late a reader comes."""
    alone = made_run(capture, tmp_path / "alone", "--iterations", "50", "--random-background")
    alone.train()
    monkeypatch.setattr(snapshots, "SHARE", 1e9)
    monkeypatch.setattr(snapshots, "POLL", 0.0)
    monkeypatch.setattr(live_folder, "FRESH", PATIENCE)
    run, shown = tmp_path / "watched", []
    LiveFolder(run).set_paused(True)
    LiveFolder(run).ask()
    with Watched(capture, run, "--iterations", "50", "--random-background") as made:
        write = made.watcher.take_scene
        monkeypatch.setattr(
            made.watcher, "take_scene", lambda *words: (shown.append(words[0]), write(*words))
        )
        until(lambda: made.said, "the pause")
        made.live.set_paused(False)
        while made.thread.is_alive():
            made.live.ask()
            header_of(made.live.scene)
    assert len(shown) > 40, "the training was watched"
    assert bits(made.run) == bits(alone)


def test_stopping_the_program_ends_a_pause(capture, tmp_path):
    LiveFolder(tmp_path / "run").set_paused(True)
    with Watched(capture, tmp_path / "run", "--iterations", "100000") as made:
        until(lambda: made.said, "the pause")
        held = made.run.trainer.iteration
        made.stopped.set()
        made.thread.join(PATIENCE)
    assert list_checkpoints(made.run.folder.checkpoints)[-1].stem == f"iteration_{held}"


def test_a_folder_that_cannot_be_written_ends_the_watching_but_not_the_training(capture, tmp_path):
    with Watched(capture, tmp_path / "run", "--iterations", "100000") as made:
        made.live.page.mkdir(parents=True)  # a folder of the file's name makes the renaming fail
        until(lambda: (made.live.ask(), made.said)[1], "the failure")
        held = made.run.trainer.iteration
        until(lambda: made.run.trainer.iteration > held + 20, "more iterations")
        (sentence,) = made.said
        assert (
            sentence.startswith("the live view of the run's folder ends: ")
            and str(made.live.page) in sentence
        )
        made.live.page.rmdir()


def test_splats_that_are_not_finite_are_left_out(capture, tmp_path):
    run = made_run(capture, tmp_path / "run", "--iterations", "10")
    with torch.no_grad():
        run.trainer.gaussians.sh0[3] = float("nan")
        run.trainer.gaussians.log_scales[5, 1] = float("inf")
    path = tmp_path / "scene.bin"
    path.write_bytes(snapshot_of(run.trainer))
    kept = np.delete(run.trainer.gaussians.means.numpy(force=True), (3, 5), axis=0)
    np.testing.assert_array_equal(scene_of(path)[1].means, kept)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "is not a snapshot"),
        (b"\x04\0\0\0{}  ", "is not a snapshot"),
        (b"\xff\xff\xff\xff{", "is not a snapshot"),
        (live_folder.framed(1, 0, 0, b"").replace(b'"version": 1', b'"version": 9'), "snapshot version 9"),
    ],
)
def test_a_damaged_snapshot_is_refused(tmp_path, data, says):
    path = tmp_path / "scene.bin"
    path.write_bytes(data)
    with pytest.raises(SceneFormatError, match=says):
        header_of(path)
    assert header_of(tmp_path / "none.bin") is None


def test_damaged_json_is_refused(tmp_path):
    live = LiveFolder(tmp_path)
    assert live.read_state() is None and live.seconds_old() == float("inf")
    live.path.mkdir()
    for text in ("", "[]", "{", "\udcff"):
        live.state.write_text(text, errors="surrogateescape")
        with pytest.raises(SceneFormatError, match="is damaged"):
            live.read_state()


def test_the_curves_keep_few_points(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(snapshots, "MOST_POINTS", 8)
    run = made_run(capture, tmp_path / "run", "--iterations", "50")
    figures = snapshots.Figures(run.trainer)

    def measured(trainer, event):
        if hasattr(event, "loss_tensor"):
            figures.note(event)
            figures.measure(trainer)

    run.train(callbacks=[measured])
    iterations = [point[0] for point in figures.points]
    assert len(iterations) <= 8 and iterations[0] == 1 and iterations[-1] > 40
    assert len({b - a for a, b in pairwise(iterations)}) == 1, "the kept points are evenly spaced"


def test_a_watcher_and_a_training_may_make_and_remove_the_folder_at_the_same_time(tmp_path, monkeypatch):
    live, touch = LiveFolder(tmp_path), Path.touch

    def removed_first(path, *words, **options):
        monkeypatch.setattr(Path, "touch", touch)
        live.clear()
        return touch(path, *words, **options)

    for wish in (live.ask, lambda: live.set_paused(True)):
        monkeypatch.setattr(Path, "touch", removed_first)
        wish()
        assert any(live.path.iterdir())
        shutil.rmtree(live.path)

    live.path.mkdir()
    remove = Path.rmdir

    def asked_first(path):
        live.ask()
        remove(path)

    monkeypatch.setattr(Path, "rmdir", asked_first)
    live.clear()
    assert live.path.is_dir()
