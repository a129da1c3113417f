"""Time limits depend only on the clock that is passed in."""

from gsplat_edu.budget import deadline, pace, plan, probe
from gsplat_edu.budget.deadline import PACED_STEPS, Deadline, TrialTime, stopwatch


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


class SetClock:
    """A clock that a test sets."""

    def __init__(self, seconds):
        self.seconds = seconds

    def __call__(self):
        return self.seconds


def test_trials_get_a_quarter_of_what_is_left_but_never_what_the_shortest_training_needs():
    clock = SetClock(20.0)
    assert TrialTime(Deadline(100.0, clock)).seconds == 20.0
    assert TrialTime(Deadline(100.0, clock), reserve=70.0).seconds == 10.0
    time = TrialTime(Deadline(100.0, clock), reserve=90.0)
    assert time.seconds == 0.0 and time.is_over()


def test_trials_end_once_their_pace_shows_that_they_will_not_end_in_time():
    """600 steps of 0.1 s take 60 s of a quarter of 200 s; 400 steps take 40 s. The first step comes after 10 s."""
    for planned, fits in ((600, False), (400, True)):
        clock = SetClock(0.0)
        time = TrialTime(Deadline(200.0, clock))
        ended = None
        for step in range(1, planned + 1):
            clock.seconds = (0.0 if fits else 10.0) + 0.1 * step
            if time.is_over(step, planned):
                ended = step
                break
        assert ended == (None if fits else PACED_STEPS + 1)
