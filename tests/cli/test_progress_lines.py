"""Redirected output gets lines of progress; a terminal of 80 columns shows the time left."""

import io
import re
from queue import SimpleQueue

import pytest
from rich.console import Console
from rich.progress import MofNCompleteColumn, TimeRemainingColumn

from gsplat_edu.cli.main import main
from gsplat_edu.cli.terminal import GROWS, LINE_SECONDS, Bar, clock, stage_bars
from gsplat_edu.cli.train import progress_bar
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.sfm.colmap import await_result


class Time:
    """A clock that a test sets."""

    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def log():
    return Console(file=io.StringIO(), width=80)


def lines(console):
    return console.file.getvalue().splitlines()


def test_times_are_short():
    assert [clock(s) for s in (0.4, 65, 600, 3785)] == ["0:00", "1:05", "10:00", "1:03:05"]


def test_a_long_task_prints_lines_with_its_times(log):
    time = Time()
    with Bar(MofNCompleteColumn(), TimeRemainingColumn(), console=log, disable=True, get_time=time) as bar:
        task = bar.add_task("evaluating", total=100)
        for _ in range(100):
            time.now += 2.0
            bar.advance(task)
    assert lines(log)[0] == "evaluating: 15 of 100, 0:30 elapsed, 2:50 left"
    assert len(lines(log)) == 200 // LINE_SECONDS
    assert all(
        re.fullmatch(r"evaluating: \d+ of 100, \d:\d\d elapsed, \d:\d\d left", line) for line in lines(log)
    )


def test_the_log_of_a_task_of_hours_stays_short(log):
    time = Time()
    with Bar(TimeRemainingColumn(), console=log, disable=True, get_time=time) as bar:
        task = bar.add_task("rendering\x1b[2J", total=36_000)
        for _ in range(3600):
            time.now += 10.0
            bar.advance(task, 10)
    assert 50 < len(lines(log)) < 120
    assert lines(log)[-1].startswith("rendering\\x1b[2J: 3") and " left" in lines(log)[-1]


def test_short_tasks_and_tasks_that_print_their_own_lines_print_nothing(log):
    time = Time()
    with Bar(console=log, disable=True, get_time=time) as bar:
        short, own = bar.add_task("photos", total=None), bar.add_task("training", total=5, lines=False)
        time.now = LINE_SECONDS - 1.0
        bar.update(short, completed=3)
        time.now = 1000.0
        bar.advance(own)
    assert lines(log) == []


def test_the_forecast_of_mapping_knows_that_photos_take_longer_and_longer():
    time = Time()
    log = Console(file=io.StringIO(), width=80, get_time=time)
    growth, registered = GROWS["mapping"], 1000.0
    whole = registered / growth.share
    with stage_bars(log) as progress:
        progress("mapping", 0, 100)
        for done in (5, 30, 60, 100):
            time.now = registered * (done / 100) ** growth.power
            progress("mapping", done, 100)
        time.now = (registered + whole) / 2
        progress("mapping", 100, 100)
        time.now = whole + 60.0
        progress("mapping", 100, 100)
    passed = [registered * share**growth.power for share in (0.3, 0.6, 1.0)] + [(registered + whole) / 2]
    told = [line.partition("elapsed")[2] for line in lines(log)]
    forecast = [f", {clock(whole - seconds)} left" for seconds in passed]
    assert told == [*forecast, ""], "a forecast that has passed is not shown"


def test_an_attempt_that_starts_over_has_its_own_forecast():
    time = Time()
    log = Console(file=io.StringIO(), width=80, get_time=time)
    with stage_bars(log) as progress:
        for attempt in range(2):
            progress("mapping", 0, 100)
            for done in (40, 41):
                time.now += 40.0
                progress("mapping", done, 100)
            assert len(lines(log)) == 2 * (attempt + 1)
    assert lines(log)[:2] == lines(log)[2:], "the time of an earlier attempt does not count"


def test_stages_of_steady_speed_show_the_time_left():
    time = Time()
    log = Console(file=io.StringIO(), width=80, get_time=time)
    with stage_bars(log) as progress:
        for stage in ("features", "matches"):
            progress(stage, 0, 120)
            for done in (10, 20, 30, 40):
                time.now += 10.0
                progress(stage, done, 120)
    assert lines(log) == [
        "features: 30 of 120, 0:30 elapsed, 1:30 left",
        "matches: 30 of 120, 0:30 elapsed, 1:30 left",
    ]


def test_a_terminal_gets_no_lines():
    time = Time()
    console = Console(file=io.StringIO(), width=80, force_terminal=True)
    with Bar(MofNCompleteColumn(), console=console, get_time=time) as bar:
        task = bar.add_task("evaluating", total=100)
        time.now = 100.0
        bar.advance(task)
    assert "elapsed" not in console.file.getvalue()


def test_the_time_left_is_visible_in_80_columns():
    time = Time()
    console = Console(file=io.StringIO(), width=80, force_terminal=True, get_time=time)
    with progress_bar(console, "{task.fields[state]}") as bar:
        state = "loss 0.123  PSNR 22.2 of ...long_name_000123.jpg  1234567 Gaussians  123 it/s"
        task = bar.add_task("training", total=300_000, state=state)
        bar.update(task, completed=100_000)
        time.now = 100.0
        bar.update(task, completed=200_000)
        bar.refresh()
    drawn = console.file.getvalue()
    assert re.search(r"200000/300000.*0:01:40", drawn), "the time left is in the visible part of the line"
    assert "loss 0.123" in drawn


def test_progress_is_repeated_while_the_mapper_reports_nothing(monkeypatch):
    """COLMAP's mapper may adjust all poses for minutes between two photos, and after the last photo."""
    monkeypatch.setattr("gsplat_edu.sfm.colmap.BEAT", 0.0)
    answers, seen = SimpleQueue(), []

    def progress(done):
        seen.append(done)
        if len(seen) == 5:
            answers.put({"result": {"models": []}})

    answers.put({"done": 7})
    assert await_result(answers, progress) == {"models": []}
    assert seen == [7, 7, 7, 7, 7]
    answers.put({"ended": True})
    assert await_result(answers, progress) is None


def test_a_training_without_a_terminal_prints_the_time_left(tmp_path, capsys):
    write_colmap(tmp_path / "egg", *procedural_capture(12, 4, splats=30))
    words = ["train", str(tmp_path / "egg"), "--out", str(tmp_path / "run")]
    assert main([*words, "--iterations", "40", "--strategy", "none"]) == 0
    found = re.findall(
        r"^iteration (\d+)/40: (.*), loss \d\.\d{4}, PSNR ", capsys.readouterr().out, re.MULTILINE
    )
    assert [int(iteration) for iteration, _ in found][-1] == 40 and len(found) >= 10
    assert all(re.fullmatch(r"\d:\d\d elapsed(, \d:\d\d left)?", times) for _, times in found)
    assert found[-1][1].endswith("0:00 left")
