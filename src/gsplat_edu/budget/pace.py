"""The clock of a run with a limit of time: when training has to end, and what is done with time that is left."""

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

LOOKS = (0.0, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Parts of the limit at which it is measured again what judging takes: a view is scored and thrown away. The median of
the last three counts, so that one moment in which another program was busy does not."""

WINDOW = 200
"""Iterations over which the present speed is taken."""

CAREFUL = 0.97
"""Part of the time left that more iterations are made for."""

LEFT_OVER = 0.025
"""Part of the limit that is not worth more iterations."""


class Pace:
    """Keeps a run within a limit of time, from the start of the command to its end.

    It is a callback of the trainer, and `over` is asked after every iteration. A run that reaches its last iteration
    early goes on, where `extend` says so: at the rates it has come to, since no milestone moves. The new number of
    iterations is written to config.json, which therefore decides the run as it does any other.

    Args:
        run: The run, whose dataset is loaded.
        deadline: The limit, and the clock that counts towards it.
        extend: Whether the iterations were chosen for the limit, see `gsplat_edu.budget.plan.Plan.by_time`.
        say: Told, in sentences, what the user wants to know.
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
        self._looks = [part * deadline.seconds for part in LOOKS]
        self._costs = deque[tuple[float, float]](maxlen=3)
        self._marks = deque[tuple[int, float]](maxlen=WINDOW)
        self._reserve = 0.0
        self._planned: int | None = None

    def over(self) -> bool:
        """Say whether training has to end now."""
        late = self._deadline.left <= self._reserve
        if late and self._planned is not None:
            # What was planned is done: the run is complete where it stands.
            self._settle(self._run.trainer.iteration)
        return late

    @property
    def outcome(self) -> str | None:
        """Say what became of the plan, once the run has ended; None where it was kept to the letter."""
        if self._planned is None:
            return None
        options = self._run.options
        return (
            f"{self._planned} iterations were planned, {options.config.iterations} fitted; "
            f"the same again: {flags(options)}"
        )

    def __call__(self, trainer: Trainer, event: Event) -> None:
        """Take note of a step; measure where a look is due; lengthen the run where it ends early."""
        if not isinstance(event, StepEvent):
            return
        now = self._deadline.spent
        self._marks.append((trainer.iteration, now))
        if self._looks and now >= self._looks[0]:
            self._looks = [moment for moment in self._looks if moment > now]
            self._look(trainer)
        if self._extend and trainer.iteration == trainer.config.iterations:
            self._lengthen(trainer)

    def _look(self, trainer: Trainer) -> None:
        """Score a view as the end will, and reckon what the end will take."""
        dataset, options = self._run.dataset, self._run.options
        view = (dataset.test or dataset.train)[0]
        self._costs.append(judging_seconds(trainer.gaussians, [view], options.config, options.backend))
        score, picture = (statistics.median(parts) for parts in zip(*self._costs, strict=True))
        count, degree = len(trainer.gaussians), options.config.sh_degree
        self._reserve = ending_seconds(self._facts, score, picture) + 2 * saving_seconds(count, degree)

    def _lengthen(self, trainer: Trainer) -> None:
        (first, then), (done, now) = self._marks[0], self._marks[-1]
        self._look(trainer)
        left = self._deadline.left - self._reserve
        if done == first or left < LEFT_OVER * self._deadline.seconds:
            return
        total = min(done + int(CAREFUL * left * (done - first) / (now - then)), RECIPE_ITERATIONS)
        if total <= done:
            return
        self._planned = self._planned or done
        self._settle(total)
        self._say(f"iteration {done}: there is time for {total - done} more")

    def _settle(self, iterations: int) -> None:
        """Make the run one of so many iterations, here and in config.json; no milestone moves."""
        run = self._run
        if run.options.config.iterations == iterations:
            return
        config = dataclasses.replace(run.options.config, iterations=iterations)
        run.trainer.config, run.options = config, dataclasses.replace(run.options, config=config)
        stored = run.folder.read_config()
        run.folder.write_config(stored | {"train": {**stored["train"], "iterations": iterations}})
