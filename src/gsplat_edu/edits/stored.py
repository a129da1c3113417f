"""An edits file on a server: how large it may be, and which version of it a page has. Imports nothing slow."""

from __future__ import annotations

import hashlib

MOST_BYTES = 64 << 20
"""Bytes of an edits file; a lasso has thousands of points."""

NO_FILE = "none"
"""Version of a file that does not exist."""


def version_of(data: bytes | None) -> str:
    """Return the version of a file's content, which tells two tabs that both write it apart; None: no file."""
    return NO_FILE if data is None else hashlib.sha256(data).hexdigest()
