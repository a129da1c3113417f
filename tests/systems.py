"""The mark of tests that need POSIX: they set its permissions or locks, or make its links or pipes."""

import os

import pytest

needs_posix = pytest.mark.skipif(
    os.name != "posix", reason="needs POSIX: permissions, locks, signals, links, pipes"
)
