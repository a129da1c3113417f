"""Learning Gaussians from views: initialise, render, compare, step, densify.

`training` puts a training together from a configuration, a dataset and a backend. The package knows neither where views
come from nor which backends exist. The names below are imported on first use, because the command line reads the
settings of `gsplat_edu.train.config` without torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gsplat_edu.train.compose import Start as Start, Views as Views, training as training

__all__ = ["Start", "Views", "training"]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from gsplat_edu.train import compose

    return getattr(compose, name)
