"""What crosses between the host and a device without either waiting for the other."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsplat_edu.engine.failures import one_line


@dataclass(frozen=True, eq=False)
class Kept:
    """An array on a device; `Device.keep` makes it.

    Args:
        buffer: Where it is.
        nbytes: Its size.
    """

    buffer: Any
    nbytes: int


class Ticket:
    """What a submission leaves in a small buffer; `Memory.submit` makes it.

    Args:
        device: The device.
        staging: The copy of the buffer.
        arrival: Is fulfilled when the copy can be read.
        took: Receives the seconds that the device took, at most.
    """

    def __init__(
        self,
        device: Any,  # noqa: ANN401  a Device of host.py, which imports this module
        staging: Any,  # noqa: ANN401
        arrival: Any,  # noqa: ANN401
        took: Callable[[float], None],
    ) -> None:
        self._device, self._staging, self._arrival, self._took = device, staging, arrival, took
        self._began = time.perf_counter()

    def words(self) -> np.ndarray:
        """Wait for the submission, and return the contents as uint32; call it once.

        Raises:
            BackendUnavailableError: the device fails; a `DeviceLostError` if it is lost.
        """
        device = self._device
        with device.lock, one_line(f"{device.name.name} does not answer", device):
            device.wait(self._arrival)
            now = time.perf_counter()
            self._took(now - max(self._began, device.answered))
            device.answered = now
            words = np.frombuffer(self._staging.read_mapped(0, self._staging.size), dtype=np.uint32).copy()
            self._staging.unmap()
            device.free_staging(self._staging)
            return words
