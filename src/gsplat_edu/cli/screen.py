"""Detect a screen for a browser, and open one without showing a token to other users."""

from __future__ import annotations

import atexit
import html
import os
import shutil
import sys
import tempfile
import threading
import urllib.parse
import webbrowser
from pathlib import Path

from gsplat_edu.base.files import described
from gsplat_edu.base.printing import complain

REDIRECT_SECONDS = 60.0
"""Seconds after which the file that redirects a browser to its page is removed; a browser takes a few to start."""


def has_screen() -> bool:
    """Return whether a user at this computer could see a browser window."""
    windows = sys.platform in ("win32", "darwin") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    return windows and sys.stdin.isatty() and sys.stdout.isatty()


def open_in_browser(url: str) -> None:
    """Open a page in the user's browser, in a thread: some browsers have to exit before `webbrowser` returns.

    All users of a computer can read the command lines of its programs. The browser therefore does not get the URL with
    its token, but a file that only this user can read and that redirects to the page. It is removed after
    `REDIRECT_SECONDS`, or at the end of this process. Where a browser may not read it, the printed URL remains.

    Args:
        url: The page.
    """
    threading.Thread(target=_open, args=(url,), daemon=True).start()


def _open(url: str) -> None:
    try:
        webbrowser.open(_redirect_file(url) if urllib.parse.urlsplit(url).query else url)
    except OSError as error:
        complain(f"no browser was opened ({described(error)}); open the URL above in one")


def _redirect_file(url: str) -> str:
    """Return the address of a file that redirects to a URL; it is removed later."""
    folder = Path(tempfile.mkdtemp(prefix="gsplat-edu-"))  # only its owner can read it

    def remove() -> None:
        shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    timer = threading.Timer(REDIRECT_SECONDS, remove)
    timer.daemon = True
    timer.start()
    path = folder / "open.html"
    quoted = html.escape(url)
    text = (
        '<!doctype html><meta charset="utf-8"><title>gsplat-edu</title><meta name="referrer" content="no-referrer">'
        f'<meta http-equiv="refresh" content="0; url={quoted}"><p><a href="{quoted}">Open the page</a></p>\n'
    )
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
        file.write(text)
    return path.as_uri()
