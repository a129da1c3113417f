"""The views of a step, for tests of gradients without a training."""

from gsplat_edu.train.step import StepView
from gsplat_edu.train.trainer import Trainer


def step_views(run: Trainer, count: int = 1) -> list[StepView]:
    """Draw views, and prepare the targets that a step compares them with."""
    settings, background = run._settings(run.config.background), run.config.background
    draws = [run._feed.next() for _ in range(count)]
    return [StepView(draw, run._feed.target(draw, background), settings) for draw in draws]
