"""Serve the studio: one process, one event loop."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gsplat_edu.base.locks import locked
from gsplat_edu.server.serving import Server
from gsplat_edu.studio.app import application
from gsplat_edu.studio.library import HIDDEN, check_own_folders
from gsplat_edu.studio.state import Studio
from gsplat_edu.studio.uploads import Limits


def serve(
    folder: Path,
    host: str,
    port: int,
    at_once: int,
    limits: Limits,
    say: Callable[[str], None],
    opened: Callable[[str], None],
) -> None:
    """Serve a library until Ctrl-C; running jobs then end with a checkpoint, and the next start holds waiting ones.

    Args:
        folder: The library's folder.
        host: Address to listen on.
        port: Port; 0 for any free one.
        at_once: Jobs that run at the same time.
        limits: How much may be taken in.
        say: Prints a line.
        opened: Called with the page's URL once it can be opened.

    Raises:
        ArgumentError: the address cannot be used, another server has the folder, or its own folders are links.
    """
    check_own_folders(folder)
    with (
        Server(host, port, token=True) as server,
        locked("FOLDER", folder / HIDDEN, "gsplat-edu studio", say),
    ):
        studio = Studio(folder, at_once, limits)
        try:
            app = application(studio, server.token, host, server.cookie)
            server.run(app, lambda: opened(server.url), studio.stream.close)
        finally:
            if any(job.pid for job in studio.queue.jobs()):
                say("ending the running jobs; a training writes a checkpoint first")
            studio.close()
