"""Render Gaussians from a camera: projection, sorting and compositing, with one implementation per backend.

The package can be called: `gsplat_edu.render(gaussians, camera)` is `gsplat_edu.render.api.render`.
"""

from __future__ import annotations

import inspect
import sys
from types import ModuleType
from typing import Any


class _CallableModule(ModuleType):
    """The package as a callable module, so that `from gsplat_edu import render` gives the function `render`."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:  # noqa: ANN401
        """Render; see `gsplat_edu.render.api.render`."""
        from gsplat_edu.render.api import render  # it imports torch

        return render(*arguments, **options)

    @property
    def __signature__(self) -> inspect.Signature:
        from gsplat_edu.render.api import render

        return inspect.signature(render)


def _documentation(package: _CallableModule) -> str:
    """Return the package's docstring, then the function's, for `help` and for notebooks."""
    from gsplat_edu.render.api import render

    return f"{_ABOUT}\n\nrender{inspect.signature(render)}\n\n{inspect.getdoc(render)}"


_ABOUT = __doc__
setattr(_CallableModule, "__doc__", property(_documentation))  # noqa: B010 - mypy knows __doc__ as text
sys.modules[__name__].__class__ = _CallableModule
