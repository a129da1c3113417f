"""Keep a run within its time limit: stop it in time, or extend it if time is left."""

from __future__ import annotations

import dataclasses
import statistics
from collections import deque
from collections.abc import Callable

from gsplat_edu.budget.costs import Facts
from gsplat_edu.budget.deadline import Deadline
from gsplat_edu.budget.forecast import ending_seconds, saving_seconds
from gsplat_edu.budget.plan import flags
from gsplat_edu.budget.probe import judging_seconds
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.train.config import RECIPE_ITERATIONS
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.trainer import Trainer

REMEASURE_AT = (0.0, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Fractions of the time limit at which the cost of the final evaluation is measured again, by scoring one view. The
median of the last three measurements counts, so that one disturbed by another program does not."""

WINDOW = 200
"""Number of recent iterations from which the current speed is computed."""

CAREFUL = 0.97
"""Fraction of the remaining time that an extension plans to use."""

MARGIN = 1.3
"""Factor on the estimated time after training, since the views that are not measured may take longer, and the process
takes a moment to exit. Without it, a quiet but slow machine exceeded a limit of two minutes by 0.2 s."""

LEFT_OVER = 0.025
"""Do not extend if less than this fraction of the limit is left."""


class Pace:
    """Keeps a run within a time limit, from the start of the command to its end.

    It is a callback of the trainer, which calls `over` after every iteration. With `extend`, a run that reaches its
    last iteration early continues at its current learning rates; no milestone moves. The new number of iterations is
    written to config.json, so that the run can be repeated like any other.

    Args:
        run: The run, with its dataset loaded.
        deadline: The limit and its clock.
        extend: Whether the iterations were chosen for the limit, see `gsplat_edu.budget.plan.Plan.by_time`.
        say: Called with sentences for the user.
    """

    def __init__(
        self,
        run: CaptureRun,
        deadline: Deadline,
        *,
        extend: bool = False,
        say: Callable[[str], None] = lambda sentence: None,
    ) -> None:
        self._run, self._deadline, self._extend, self._say = run, deadline, extend, say
        self._facts = Facts.of(run.dataset)
        self._due = [part * deadline.seconds for part in REMEASURE_AT]
        self._costs = deque[tuple[float, float]](maxlen=3)
        self._marks = deque[tuple[int, float]](maxlen=WINDOW)
        self._reserve = 0.0
        self._planned: int | None = None

    def over(self) -> bool:
        """Return whether training has to end now."""
        late = self._deadline.left <= self._reserve
        if late and self._planned is not None:
            # The planned iterations are done, so the run is complete at this iteration.
            self._settle(self._run.trainer.iteration)
        return late

    @property
    def outcome(self) -> str | None:
        """How the finished run deviates from the plan; None if it does not."""
        if self._planned is None:
            return None
        options = self._run.options
        return (
            f"{self._planned} iterations were planned, {options.config.iterations} fitted; "
            f"to repeat the run: {flags(options)}"
        )

    def __call__(self, trainer: Trainer, event: Event) -> None:
        """Record a step, measure again if due, and extend the run if it ends early."""
        if not isinstance(event, StepEvent):
            return
        now = self._deadline.spent
        self._marks.append((trainer.iteration, now))
        if self._due and now >= self._due[0]:
            self._due = [moment for moment in self._due if moment > now]
            self._measure(trainer)
        if self._extend and trainer.iteration == trainer.config.iterations:
            self._lengthen(trainer)

    def _measure(self, trainer: Trainer) -> None:
        """Score a view and update the time reserved for the end of the run."""
        dataset, options = self._run.dataset, self._run.options
        view = (dataset.test or dataset.train)[0]
        self._costs.append(judging_seconds(trainer.gaussians, [view], options.config, options.backend))
        score, picture = (statistics.median(parts) for parts in zip(*self._costs, strict=True))
        count, degree = len(trainer.gaussians), options.config.sh_degree
        ending = ending_seconds(self._facts, score, picture) + 2 * saving_seconds(count, degree)
        self._reserve = MARGIN * ending

    def _lengthen(self, trainer: Trainer) -> None:
        (first, then), (done, now) = self._marks[0], self._marks[-1]
        self._measure(trainer)
        left = self._deadline.left - self._reserve
        if done == first or left < LEFT_OVER * self._deadline.seconds:
            return
        total = min(done + int(CAREFUL * left * (done - first) / (now - then)), RECIPE_ITERATIONS)
        total -= total % trainer.config.batch
        if total <= done:
            return
        self._planned = self._planned or done
        self._settle(total)
        self._say(f"iteration {done}: there is time for {total - done} more")

    def _settle(self, iterations: int) -> None:
        """Set the number of iterations here and in config.json; no milestone moves."""
        run = self._run
        if run.options.config.iterations == iterations:
            return
        config = dataclasses.replace(run.options.config, iterations=iterations)
        run.trainer.config, run.options = config, dataclasses.replace(run.options, config=config)
        stored = run.folder.read_config()
        run.folder.write_config(stored | {"train": {**stored["train"], "iterations": iterations}})
