"""Turn errors of wgpu into one line that names the adapter and the remedy, and recognise a lost device."""

from __future__ import annotations

import logging
from typing import Any, Protocol, runtime_checkable

from gsplat_edu.base.errors import BackendUnavailableError
from gsplat_edu.base.text import first_line

PATIENCE = 1.0
"""Seconds between two looks at a device that has not answered: wgpu waits for ever for one that is lost."""


class DeviceLostError(BackendUnavailableError):
    """The system reset the device or took it away. Its buffers are gone; another device may work."""


@runtime_checkable
class Losable(Protocol):
    """Something on a device that can be lost."""

    def is_lost(self) -> bool:
        """Return whether it is."""
        ...


class _LossLog(logging.Handler):
    """Counts what wgpu logs as errors: that a device is lost, it only logs."""

    count = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Count a record."""
        self.count += record.levelno >= logging.ERROR


LOG = _LossLog()
"""Counts wgpu's errors once `listen` was called."""


def listen() -> None:
    """Count wgpu's errors from now on; they are not printed, because what they mean is raised."""
    import wgpu  # noqa: F401  wgpu wants to make its logger itself

    logger = logging.getLogger("wgpu")
    if LOG not in logger.handlers:
        logger.addHandler(LOG)


class one_line:  # noqa: N801  used like a function
    """Turns what wgpu raises into one line.

    Args:
        what: What fails.
        device: If it is lost, the error is a `DeviceLostError`; None if it cannot be.
    """

    def __init__(self, what: str, device: Losable | None = None) -> None:
        self.what, self.device = what, device

    def __enter__(self) -> None:
        """Nothing to prepare."""

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        """Translate errors of wgpu."""
        if error is None or not _is_of_wgpu(error):
            return
        lost = self.device is not None and self.device.is_lost()
        raise (DeviceLostError if lost else BackendUnavailableError)(
            f"backend 'webgpu': {self.what} ({'the device is lost' if lost else first_line(error)}); "
            "use the backend cpu"
        ) from error


def wait(arrival: Any, what: str, device: Losable) -> None:  # noqa: ANN401
    """Wait for a promise of wgpu; its own `sync_wait` never returns if the device is lost.

    Raises:
        DeviceLostError: it is.
    """
    before = LOG.count
    event = getattr(arrival, "_thread_event", None)  # what sync_wait waits for
    while event is not None and not event.wait(PATIENCE):
        _check(what, device)
    arrival.sync_wait()
    if LOG.count != before:
        _check(what, device)


def _check(what: str, device: Losable) -> None:
    if device.is_lost():
        raise DeviceLostError(f"backend 'webgpu': {what} (the device is lost); use the backend cpu")


def _is_of_wgpu(error: BaseException) -> bool:
    import wgpu

    return isinstance(error, (wgpu.GPUError, RuntimeError))
