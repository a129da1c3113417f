"""What crosses between the host and a device without either waiting for the other."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
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
        name: The adapter's.
        lock: Of the device.
        staging: The copy of the buffer.
        arrival: Is fulfilled when the copy can be read.
        free: Takes `staging` back.
    """

    def __init__(
        self,
        name: str,
        lock: AbstractContextManager[Any],
        staging: Any,  # noqa: ANN401
        arrival: Any,  # noqa: ANN401
        free: Callable[[Any], None],
    ) -> None:
        self._name, self._lock, self._staging, self._arrival, self._free = name, lock, staging, arrival, free

    def words(self) -> np.ndarray:
        """Wait for the submission, and return the contents as uint32; call it once.

        Raises:
            BackendUnavailableError: the device fails.
        """
        with self._lock, one_line(f"{self._name} does not answer"):
            self._arrival.sync_wait()
            words = np.frombuffer(self._staging.read_mapped(0, self._staging.size), dtype=np.uint32).copy()
            self._staging.unmap()
            self._free(self._staging)
            return words
