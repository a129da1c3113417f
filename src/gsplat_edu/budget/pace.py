"""Use a time limit: measure the speed while training, and stretch or shrink what is left of the schedule."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

from gsplat_edu.budget.costs import Facts
from gsplat_edu.budget.deadline import Deadline
from gsplat_edu.budget.forecast import ending_seconds, saving_seconds
from gsplat_edu.budget.planned import flags
from gsplat_edu.budget.probe import scoring_seconds
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.train.config import RECIPE_ITERATIONS
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.trainer import Trainer

REMEASURE_AT = (0.0, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Fractions of the time limit at which the cost of the final evaluation is measured again, by scoring one view. The
slowest of the last three measurements counts, since the limit holds on a busy machine too."""

DECIDE_EVERY = 0.02
"""Fraction of the time limit between two decisions about the rest of the schedule."""

WINDOW = 0.05
"""Fraction of the time limit over which the current speed is measured; at least `LEAST_STEPS` iterations."""

LEAST_STEPS = 10

DEAD_BAND = 0.01
"""A decision changes the schedule only if the remaining iterations differ by more than this fraction."""

PLANNED_FRACTION = 0.985
"""Fraction of the remaining time that a decision plans to use."""

RESERVE_FACTOR = 1.3
"""Factor on the estimated time after training, since the views that are not measured may take longer, and the process
takes a moment to exit. Without it, a quiet but slow machine exceeded a limit of two minutes by 0.2 s."""

REPORTED_CHANGE = 0.2
"""Tell the user about a change of the number of iterations by more than this fraction."""


class Pace:
    """Keeps a command within its time limit, and uses nearly all of the time.

    It is a callback of the trainer, which calls `over` after every iteration. With `profile`, the number of iterations
    follows the machine: at regular times, the rest of the schedule is stretched or shrunk to what still fits (see
    `gsplat_edu.train.tempo.Tempo`). Each such decision is written to config.json before the iteration that it concerns,
    so that a resumed or repeated run takes the same steps.

    Args:
        run: The run, with its dataset loaded.
        deadline: The limit and its clock, which also times the evaluation.
        profile: Expected seconds of each iteration of the recipe; only their ratios matter. None to keep the
            schedule.
        say: Called with sentences for the user.
    """

    def __init__(
        self,
        run: CaptureRun,
        deadline: Deadline,
        *,
        profile: Float64[np.ndarray, " iterations"] | None = None,
        say: Callable[[str], None] = lambda sentence: None,
    ) -> None:
        self._run, self._deadline, self._say = run, deadline, say
        self._facts = Facts.of(run.dataset)
        self._profile = profile
        self._due = [part * deadline.seconds for part in REMEASURE_AT]
        self._next_decision = 0.0
        self._costs = deque[tuple[float, float, float]](maxlen=3)
        # After each step: seconds by the model, seconds of the steps, and seconds since the command began.
        self._history = deque([(0.0, 0.0, deadline.spent)])
        self._last = deadline.spent
        self._between_steps = 0.0  # seconds between steps: density, evaluations, checkpoints
        self._planned = self._reported = run.options.config.iterations

    def over(self) -> bool:
        """Return whether training has to stop now."""
        now = self._deadline.spent
        self._between_steps, self._last = self._between_steps + now - self._last, now
        late = self._deadline.seconds - now <= self._reserve
        if late and self._profile is not None:
            # The schedule follows the time, so the run is complete at this iteration.
            self._settle(self._run.trainer.iteration, self._run.options.config.tempo)
        return late

    @property
    def outcome(self) -> str | None:
        """How the finished run deviates from the plan; None if it does not."""
        options = self._run.options
        if self._profile is None or options.config.iterations == self._planned:
            return None
        return (
            f"{self._planned} iterations were planned, {options.config.iterations} fitted; "
            f"to repeat the run: {flags(options)}"
        )

    def __call__(self, trainer: Trainer, event: Event) -> None:
        """Record a step, measure the evaluation again if due, and fit the rest of the schedule to the time."""
        if not isinstance(event, StepEvent):
            return
        now = self._deadline.spent
        self._mark(trainer, now)
        if self._due and now >= self._due[0]:
            self._due = [moment for moment in self._due if moment > now]
            self._measure(trainer)
        at_end = trainer.iteration >= trainer.config.iterations
        if self._profile is not None and (now >= self._next_decision or at_end):
            self._next_decision = now + DECIDE_EVERY * self._deadline.seconds
            self._decide(trainer, self._profile)
        self._last = self._deadline.spent

    def _mark(self, trainer: Trainer, now: float) -> None:
        """Record the measured and the expected duration of the step."""
        expected = 1.0
        if self._profile is not None:
            position = trainer.tempo.position(trainer.iteration - trainer.config.batch)
            expected = float(self._profile[min(position, len(self._profile) - 1)])
        modelled, stepped, _ = self._history[-1]
        batch = trainer.config.batch
        self._history.append((modelled + expected * batch, stepped + now - self._last, now))
        window = WINDOW * self._deadline.seconds
        while len(self._history) > LEAST_STEPS + 1 and self._history[1][2] < now - window:
            self._history.popleft()

    @property
    def _slowness(self) -> float:
        """Ratio of the measured to the expected time of the steps in the window; 1 before the first step."""
        (modelled, stepped, _), (last, now, _) = self._history[0], self._history[-1]
        return (now - stepped) / (last - modelled) if last > modelled and now > stepped else 1.0

    @property
    def _reserve(self) -> float:
        """Seconds to keep for the end of the run, at the current speed."""
        if not self._costs:
            return 0.0
        score, picture, _ = (max(parts) for parts in zip(*self._costs, strict=True))
        slowness = self._costs[-1][2]
        trainer = self._run.trainer
        count, degree = trainer.stepper.count, trainer.config.sh_degree
        ending = ending_seconds(self._facts, score, picture) + 2 * saving_seconds(count, degree)
        slower = self._slowness / slowness if self._profile is not None else 1.0
        return RESERVE_FACTOR * ending * max(slower, 1.0)

    def _measure(self, trainer: Trainer) -> None:
        """Score a view to estimate the time that the end of the run takes; none if the end scores none."""
        dataset, options = self._run.dataset, self._run.options
        if not options.scores_at_end:
            self._costs.append((0.0, 0.0, self._slowness))
            return
        view = (dataset.test or dataset.train)[0]
        clock = self._deadline.clock
        found = scoring_seconds(trainer.gaussians, [view], options.config, options.backend, clock)
        self._costs.append((*found, self._slowness))

    def _decide(self, trainer: Trainer, profile: Float64[np.ndarray, " iterations"]) -> None:
        """Change the number of iterations to the one that fits, if the difference exceeds `DEAD_BAND`."""
        done, config, tempo = trainer.iteration, trainer.config, trainer.tempo
        if len(self._history) <= LEAST_STEPS:
            return
        rest = profile[min(tempo.position(done), len(profile) - 1) :]
        share_of_steps = self._history[-1][1] / (self._history[-1][1] + self._between_steps)
        left = PLANNED_FRACTION * (self._deadline.left - self._reserve) * share_of_steps
        fitting = min(int(left / (self._slowness * float(rest.mean()))), RECIPE_ITERATIONS - done)
        fitting -= fitting % config.batch
        remaining = config.iterations - done
        if fitting < config.batch or abs(fitting - remaining) <= DEAD_BAND * max(fitting, remaining):
            return
        total = done + fitting
        self._settle(total, str(tempo.changed(done, total)))
        if abs(total - self._reported) > REPORTED_CHANGE * self._reported:
            self._say(
                f"iteration {done}: the time is enough for {total} iterations, instead of {self._reported}"
            )
            self._reported = total

    def _settle(self, iterations: int, tempo: str) -> None:
        """Set the number of iterations and the tempo here and in config.json."""
        run = self._run
        if (run.options.config.iterations, run.options.config.tempo) == (iterations, tempo):
            return
        config = dataclasses.replace(run.options.config, iterations=iterations, tempo=tempo)
        run.trainer.config, run.options = config, dataclasses.replace(run.options, config=config)
        stored = run.folder.read_config()
        changed = {"iterations": iterations, "tempo": tempo}
        run.folder.write_config(stored | {"train": {**stored["train"], **changed}})
