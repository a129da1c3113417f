"""`gsplat-edu web`: a page that trains a scene inside a browser tab."""

from __future__ import annotations

import argparse

from gsplat_edu.base.printing import say
from gsplat_edu.cli.screen import has_screen, open_in_browser
from gsplat_edu.server.address import warning_for
from gsplat_edu.tab.serving import TabServer


def run(arguments: argparse.Namespace) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        ArgumentError: the WebAssembly module is not built, or the address cannot be used.
    """
    with TabServer(arguments.host, arguments.port) as server:
        if warning := warning_for(arguments.host, "can open the page, which trains in their browser"):
            say(warning)

        def opened() -> None:
            say(f"{server.url}   (press Ctrl-C to stop)")
            if not arguments.no_open and has_screen():
                open_in_browser(server.url)

        try:
            server.run(server.application(), opened)
        except KeyboardInterrupt:
            say("ended")
