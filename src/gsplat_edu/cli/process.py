"""Age of this process, because a time limit counts from the start of the command."""

from __future__ import annotations

import os
import time
from pathlib import Path


def process_age() -> float:
    """Return the seconds since this process began; if the system cannot tell, since Python's clock began."""
    try:
        fields = Path("/proc/self/stat").read_text("ascii", errors="replace").rpartition(")")[2].split()
        up = float(Path("/proc/uptime").read_text("ascii").split()[0])
        return max(up - int(fields[19]) / os.sysconf("SC_CLK_TCK"), 0.0)
    except (OSError, ValueError, IndexError):
        return time.process_time()
