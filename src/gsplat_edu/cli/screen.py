"""Whether there is a screen to open a browser on."""

from __future__ import annotations

import os
import sys


def has_screen() -> bool:
    """Return whether a user at this computer could see a browser window."""
    windows = sys.platform in ("win32", "darwin") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    return windows and sys.stdin.isatty() and sys.stdout.isatty()
