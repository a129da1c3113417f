"""The exception tree of this package.

    SplatError
    ├── ArgumentError (also a ValueError)    an argument has an invalid value
    │   └── ShapeError                       an argument has the wrong shape
    ├── BackendUnavailableError              the requested backend cannot run on this machine
    ├── DatasetError                         a capture cannot be read or used
    ├── SceneFormatError                     a scene file is damaged or of another format
    ├── CheckpointError                      a run cannot be resumed or saved
    ├── ProcessLostError                     another process of a shared training ended
    └── NotEnoughMemoryError                 work needs more memory than is free

    BackendWarning                           a backend is replaced, leaves its device or loses it

Every message is one line that says what is wrong, where, and what to do next. The command line prints that
line and exits with 2.
"""

from __future__ import annotations


class SplatError(Exception):
    """Base of every error this package raises on purpose."""


class ArgumentError(SplatError, ValueError):
    """An argument has an invalid value; the message names the argument."""


class ShapeError(ArgumentError):
    """An argument has the wrong shape; the message names it, the expected shape and the actual one."""


class BackendUnavailableError(SplatError):
    """The requested rendering backend is unavailable here; the message says why and which one to use."""


class BackendWarning(UserWarning):
    """A backend does not do what one would expect, such as stay on its device; the message says why."""


class DatasetError(SplatError):
    """A capture cannot be read; the message names the file, and the line or image where there is one.

    Args:
        message: One line: what is wrong, where, and what to do next.
        reason: What is wrong in a few words, for a list that already names the file; None for the message.
    """

    def __init__(self, message: str, reason: str | None = None) -> None:
        super().__init__(message)
        self.reason = message if reason is None else reason


class SceneFormatError(SplatError):
    """A scene file cannot be read; the message names the file and what it lacks."""


class ProcessLostError(SplatError):
    """Another process of a training that several share ended, or is out of reach."""


class CheckpointError(SplatError):
    """A run cannot be saved or resumed; the message names the file and what remains intact."""


class NotEnoughMemoryError(SplatError):
    """Work needs more memory than is free; the message says which work, how much, and what to do."""
