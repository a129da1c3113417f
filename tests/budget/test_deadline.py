"""Time limits depend only on the clock that is passed in."""

from gsplat_edu.budget import deadline, pace, plan, probe
from gsplat_edu.budget.deadline import Deadline, stopwatch


def test_the_time_left_follows_the_clock():
    moments = iter((2.0, 2.5, 11.0))
    limit = Deadline(10.0, lambda: next(moments))
    assert (limit.spent, limit.left, limit.left) == (2.0, 7.5, -1.0)


def test_a_stopwatch_counts_from_when_it_was_made(monkeypatch):
    moments = iter((1_000.0, 1_003.0, 2_000.0, 2_001.5, 5_000.0, 5_040.0))
    monkeypatch.setattr(deadline.time, "perf_counter", lambda: next(moments))
    assert stopwatch(7.0)() == 10.0
    assert stopwatch()() == 1.5
    assert Deadline(60.0).left == 20.0


def test_the_budget_does_not_use_the_age_of_the_process():
    """Only the command line counts from the start of the process; a program that has run for hours may plan minutes."""
    assert not any(hasattr(module, "process_age") for module in (deadline, pace, plan, probe))
