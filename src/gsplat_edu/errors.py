"""What can go wrong, as one tree.

    SplatError
    ├── ArgumentError (also a ValueError)    an argument's value cannot be used
    │   └── ShapeError                       an argument's shape is not the documented one
    ├── BackendUnavailableError              this machine cannot run the backend that was asked for
    ├── DatasetError                         a capture cannot be read, or not as it stands
    ├── SceneFormatError                     a scene file is not what it says it is
    ├── CheckpointError                      a run cannot be continued, or its state not be written
    └── NotEnoughMemoryError                 work needs more memory than is free

Every message is one line that says what is wrong, where, and what to do next. The command line prints that
line and exits with 2.
"""

from __future__ import annotations


class SplatError(Exception):
    """Base of every error this package raises on purpose."""


class ArgumentError(SplatError, ValueError):
    """An argument has a value that cannot be used; the message names the argument."""


class ShapeError(ArgumentError):
    """An argument has the wrong shape; the message names it, the expected shape and the actual one."""


class BackendUnavailableError(SplatError):
    """The rendering backend that was asked for does not run here; the message says why and what does."""


class DatasetError(SplatError):
    """A capture cannot be read; the message names the file, and the line or image where there is one.

    Args:
        message: One line: what is wrong, where, and what to do next.
        reason: What is wrong in a few words, for a list in which the file stands already; None for the message.
    """

    def __init__(self, message: str, reason: str | None = None) -> None:
        super().__init__(message)
        self.reason = message if reason is None else reason


class SceneFormatError(SplatError):
    """A scene file cannot be read; the message names the file and what it lacks."""


class CheckpointError(SplatError):
    """A run cannot be saved or continued; the message names the file and what stands unharmed."""


class NotEnoughMemoryError(SplatError):
    """Work needs more memory than is free; the message says what, how much, and what to do."""
