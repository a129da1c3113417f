"""`gsplat-edu studio`: one page that takes photos to a finished scene."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.printing import say
from gsplat_edu.cli.screen import has_screen, open_in_browser
from gsplat_edu.server.address import warning_for


def run(arguments: argparse.Namespace) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        ArgumentError: the system has no signals for its jobs.
    """
    if sys.platform == "win32":
        raise ArgumentError("studio: does not run on Windows; use sfm, train and view, or run it in WSL")
    from gsplat_edu.studio.server import serve
    from gsplat_edu.studio.uploads import Limits

    limits = Limits()
    if arguments.max_upload is not None:
        limits = replace(limits, file=arguments.max_upload)
    if arguments.max_library is not None:
        limits = replace(limits, library=arguments.max_library)
    if warning := warning_for(arguments.host, "can run trainings and read and write your files", token=True):
        say(warning)

    def opened(url: str) -> None:
        say(f"{url}   (press Ctrl-C to stop)")
        if not arguments.no_open and has_screen():
            open_in_browser(url)

    try:
        serve(arguments.folder, arguments.host, arguments.port, arguments.jobs, limits, say, opened)
    except KeyboardInterrupt:
        say("ended")
    else:
        say("ended")
