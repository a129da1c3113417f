"""Events of any content are read back from their file, and damaged files do not break readers."""

import math
import os
import typing
from pathlib import Path

import pytest

from gsplat_edu.jobs import emitter, events, following
from gsplat_edu.jobs.emitter import Emitter
from gsplat_edu.jobs.following import Follower, events_after, last_stage, last_word
from gsplat_edu.jobs.process import identity, is_running

ALL = [
    events.Started(12, "boot 34"),
    events.Stage("training"),
    events.Progress("training", 3, 10, 1.5),
    events.Progress("photos", 3),
    events.Message('quotes " and \n line ends, <b>ü\udcff'),
    events.Found(
        "blur", "warning", "2 photos are blurred", "leave them out", ("a.jpg", "b.jpg"), ("0.1", "0.2")
    ),
    events.Diagnosed((("capture", "x"), ("holds", "y")), ("files",), ("train",)),
    events.Metric("psnr", 30.5, "dB", "test"),
    events.Failed("gsplat-edu train: no", 2),
    events.Interrupted("gsplat-edu train: interrupted"),
    events.Finished(("runs/a", "b.spz")),
]


@pytest.mark.parametrize("event", ALL, ids=lambda event: type(event).__name__)
def test_an_event_is_read_back_from_its_line(event):
    line = events.line_of(event, 5.25)
    assert line.count("\n") == 1 and line.isascii()
    assert events.parse_line(line) == (5.25, event)


def test_every_kind_is_tested():
    assert {type(event) for event in ALL} == set(typing.get_args(events.Event))


def test_numbers_that_json_lacks_become_null():
    line = events.line_of(events.Metric("psnr", math.nan), 0.0)
    assert events.parse_line(line)[1] == events.Metric("psnr", None)


@pytest.mark.parametrize(
    "line",
    [
        *("", "{", "[]", "3", '{"event":"begun","time":1}', '{"event":"stage","time":1}'),
        '{"event":"stage","time":"x","name":"a"}',
        *('{"event":"stage","time":NaN,"name":"a"}', '{"event":"stage","time":1e999,"name":"a"}'),
        *('{"event":"stage","time":1,"name":["a"]}', '{"event":"stage","time":1,"name":"a","more":1}'),
        '{"event":"finished","time":1,"outputs":"abc"}',
        '{"event":"finished","time":1,"outputs":["a",2]}',
        '{"event":"started","time":1,"pid":true,"identity":""}',
        '{"event":"progress","time":1,"stage":"a","done":1' + "0" * 400 + "}",
        '{"event":"diagnosed","time":1,"facts":[["a"]],"fine":[],"advice":[]}',
    ],
)
def test_lines_that_are_no_events_are_refused(line):
    with pytest.raises(ValueError):
        events.parse_line(line)


def test_a_reader_returns_each_complete_line_once(tmp_path):
    path = tmp_path / "events.jsonl"
    follower = Follower(path)
    assert follower.read() == []
    first, second = (events.line_of(event, 1.0).encode() for event in ALL[:2])
    path.write_bytes(first + second[:7])
    assert [(number, event) for number, _, event in follower.read()] == [(1, ALL[0])]
    with path.open("ab") as file:
        file.write(second[7:] + b"damaged\n" + first)
    assert [(number, event) for number, _, event in follower.read()] == [(2, ALL[1]), (4, ALL[0])]
    assert follower.read() == []
    assert [number for number, *_ in events_after(path, 2)] == [4]


def test_a_line_without_an_end_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(following, "PIECE", 1000)
    monkeypatch.setattr(following, "LONGEST_LINE", 2000)
    path = tmp_path / "events.jsonl"
    last = events.line_of(ALL[0], 1.0)
    path.write_text("x" * 50_000 + "\n" + last)
    follower, found = Follower(path), []
    for _ in range(60):
        found += follower.read()
        assert len(follower.rest) <= 3000
    assert [(number, event) for number, _, event in found] == [(2, ALL[0])]
    monkeypatch.setattr(following, "MOST_READ", 40_000)
    assert events_after(path) == []


def test_the_result_is_that_of_the_last_process(tmp_path):
    path = tmp_path / "events.jsonl"
    assert last_word(path) is None and last_stage(path) == ""
    done, begun, stage = events.Finished(("x",)), events.Started(1, ""), events.Progress("photos", 1)
    path.write_text("".join(events.line_of(event, 0.0) for event in (begun, done)))
    assert last_word(path) == done
    path.write_text("".join(events.line_of(event, 0.0) for event in (begun, done, begun, stage)))
    assert last_word(path) is None and last_stage(path) == "photos"
    long = events.Failed("x" * 10_000, 2)  # longer than the block that is read first
    path.write_text("".join(events.line_of(event, 0.0) for event in (begun, long)))
    assert last_word(path) == long


def test_an_emitter_drops_frequent_progress_but_not_the_last(tmp_path):
    path = tmp_path / "events.jsonl"
    made = Emitter(path)
    for done in range(1000):
        made.progress("training", done + 1, 1000, lambda: 2.0)
    made.output(tmp_path)
    made.output(tmp_path)
    made.finish()
    found = [event for _, _, event in events_after(path)]
    assert found[0] == events.Stage("training")
    assert found[-2:] == [events.Progress("training", 1000, 1000, 2.0), events.Finished((str(tmp_path),))]
    assert len(found) < 20  # a thousand steps take a few ms, and events are at least half a second apart


def test_a_full_disk_does_not_end_the_command(capsys):
    made = Emitter(Path("/dev/full"))
    for _ in range(3):
        made.emit(events.Stage("a"))
    assert (
        capsys.readouterr().err == "the job's events cannot be written any more (No space left on device)\n"
    )


def test_no_events_are_written_outside_a_job(monkeypatch):
    monkeypatch.delenv(events.EVENTS, raising=False)
    emitter.start_reporting()
    emitter.progress("a", 1, 2, lambda: pytest.fail("the forecast was computed for nobody"))


def test_a_process_is_identified_by_its_start_time(tmp_path):
    known = identity(os.getpid())
    assert known and is_running(os.getpid(), known)
    assert not is_running(os.getpid(), known + "1") and not is_running(os.getpid(), "")
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
    assert identity(child) is None  # the process has ended, although its number is still in use
    os.waitpid(child, 0)
