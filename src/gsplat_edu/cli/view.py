"""`gsplat-edu view`: a scene in the browser."""

from __future__ import annotations

import argparse
import os
import sys
import threading
import webbrowser
from pathlib import Path

from gsplat_edu.cli.arguments import whole_number_text
from gsplat_edu.cli.terminal import Terminal
from gsplat_edu.runs.source import open_source
from gsplat_edu.viewer import page
from gsplat_edu.viewer.serve import LOOPBACK, PageServer, exposure

EXAMPLE = "example: gsplat-edu view runs/plush"

PORT = 8080


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("source", type=Path, metavar="SCENE|RUN", help="scene file, or folder of a run")
    parser.add_argument(
        "--host",
        default=LOOPBACK,
        metavar="ADDRESS",
        help=f"where to listen (default: {LOOPBACK}, which only this computer can reach)",
    )
    parser.add_argument(
        "--port",
        type=whole_number_text,
        default=PORT,
        metavar="N",
        help=f"port to listen at, 0 for any that is free (default: {PORT})",
    )
    parser.add_argument("--no-open", action="store_true", help="print the URL, but do not open the browser")


def run(arguments: argparse.Namespace) -> None:
    """Serve the page until Ctrl-C, which is how it ends."""
    console = Terminal()
    with PageServer(
        b"", arguments.host, arguments.port
    ) as server:  # a port that is taken is no reason to wait
        source = open_source(arguments.source)
        server.page = page.html(source.scene, source.cameras, source.settings, _title(arguments.source))
        cameras = f", {len(source.cameras)} cameras" if source.cameras else ""
        console.print(
            f"{source.path}: {len(source.scene.gaussians):,} Gaussians{cameras}, {len(server.page):,} bytes",
            soft_wrap=True,
        )
        if warning := exposure(arguments.host, "sees the scene"):
            console.print(warning, soft_wrap=True)
        console.print(f"{server.url}   (Ctrl-C ends it)", soft_wrap=True)
        if not arguments.no_open and _has_screen():
            # a thread: some browsers are programs that have to end before webbrowser goes on
            threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            console.print("ended")


def _title(path: Path) -> str:
    return path.resolve().name


def _has_screen() -> bool:
    """Say whether a person sits here whose screen can show a browser's window."""
    windows = sys.platform in ("win32", "darwin") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    return windows and sys.stdin.isatty() and sys.stdout.isatty()
