"""Serve the page that trains in a browser tab: its own files, the capture to try, and nothing else."""

from __future__ import annotations

import shutil
from pathlib import Path

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gsplat_edu.base.constants import LOOPBACK
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.server.page_server import TYPES, PageServer

PACKAGE = Path(__file__).parents[1]
"""The folder of the package."""

MODULES = ("gsplat_edu.wasm", "gsplat_edu_threads.wasm")
"""The compiled kernels and trainer, for one thread and for several: files beside the page's scripts."""

ROOMS = ("base", "tab", "viewer")
"""Rooms of the package whose folder `web` the page loads files from, at the path that they have in the package."""

EXAMPLE = "/example.zip"
"""Address of the capture to try, the one of the studio."""

POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self' 'wasm-unsafe-eval'",
        "style-src 'self'",
        "img-src 'self' data: blob:",
        "connect-src 'self'",
        "worker-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
    )
)
"""Content-Security-Policy: scripts, styles and data of this server only."""

PAGE = "/tab/web/index.html"
"""Address of the page's file, which is served at `/`: its links begin there."""

EMBEDDER = "Cross-Origin-Embedder-Policy"
"""Header that a browser needs to let a page share memory between threads, beside those of `gsplat_edu.server.guard`."""


class TabServer(PageServer):
    """Serves the page.

    Args:
        host: Address to listen on.
        port: Port; 0 picks a free one.

    Raises:
        ArgumentError: a module is not built, or as for `PageServer`.
    """

    def __init__(self, host: str = LOOPBACK, port: int = 0) -> None:
        found = page_files()
        super().__init__(POLICY, host, port)
        self.page = found[PAGE].read_bytes()
        self.served = found

    def application(self) -> ASGIApp:
        """Return the application that answers with the page and its files, isolated from other pages."""
        inner = super().application()

        async def isolated(scope: Scope, receive: Receive, send: Send) -> None:
            async def sending(message: Message) -> None:
                if message["type"] == "http.response.start":
                    MutableHeaders(scope=message)[EMBEDDER] = "require-corp"
                await send(message)

            await inner(scope, receive, sending)

        return isolated


def write_page(folder: Path) -> None:
    """Write the page and its files, for a server that only has files. There it trains on one thread.

    Args:
        folder: A new folder.

    Raises:
        ArgumentError: a module is not built.
    """
    files = page_files()
    page = files.pop(PAGE).read_text("utf-8")
    for address, path in files.items():
        copy = folder / address.removeprefix("/")
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)
    policy = f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
    (folder / "index.html").write_text(page.replace("<head>", f"<head>\n{policy}", 1), "utf-8")


def page_files(package: Path = PACKAGE) -> dict[str, Path]:
    """Return the files that the page may load, by their addresses.

    Args:
        package: The folder of the package.

    Raises:
        ArgumentError: a module is not built.
    """
    for module in (package / "tab" / "web" / name for name in MODULES):
        if not module.is_file():
            raise ArgumentError(
                f"{module}: is not built; run python tools/build_wasm.py in a clone of the repository"
            )
    found = {EXAMPLE: package / "studio" / "example.zip"}
    for room in ROOMS:
        files = (package / room / "web").iterdir()
        found |= {f"/{room}/web/{path.name}": path for path in files if path.suffix in TYPES}
    return found
