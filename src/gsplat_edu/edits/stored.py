"""An edits file on a server: its largest size, and its versions. Imports nothing slow."""

from __future__ import annotations

import hashlib

MOST_BYTES = 64 << 20
"""Bytes of an edits file; a lasso has thousands of points."""

NO_FILE = "none"
"""Version of a file that does not exist."""


def version_of(data: bytes | None) -> str:
    """Return the version of a file's content, which detects concurrent writes by two tabs; None means no file."""
    return NO_FILE if data is None else hashlib.sha256(data).hexdigest()
