"""The rank of this process under `torchrun`, and which process reports a failure. Imports torch only for a failure."""

from __future__ import annotations

import os
from datetime import timedelta

VARIABLES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
"""Environment variables that torchrun sets for each process."""

PATIENCE = timedelta(seconds=10)
"""Time limit for a connection to torchrun's store."""


def num_processes() -> int:
    """Return the number of processes that `torchrun` started for this command; 1 without it."""
    size = os.environ.get("WORLD_SIZE", "")
    return int(size) if size.isdecimal() and all(name in os.environ for name in VARIABLES) else 1


def is_first() -> bool:
    """Return whether this is process 0, which prints."""
    return num_processes() == 1 or os.environ["RANK"] == "0"


def restarts_are_allowed() -> bool:
    """Return whether `torchrun` starts the processes again when one fails."""
    return num_processes() > 1 and os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0") != "0"


def speaks_for_all() -> bool:
    """Return whether this process reports a failure: only the first to ask, since one failure ends all."""
    if num_processes() == 1:
        return True
    import torch.distributed as dist

    attempt = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
    try:
        address, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
        store = dist.TCPStore(  # type: ignore[attr-defined]
            address, port, is_master=False, timeout=PATIENCE
        )
        return bool(store.add(f"gsplat_edu/failures/{attempt}", 1) == 1)
    except (OSError, RuntimeError, ValueError):
        return is_first()
