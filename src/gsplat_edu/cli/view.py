"""`gsplat-edu view`: show a scene or a capture in the browser."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import check_writable
from gsplat_edu.cli.screen import has_screen, open_in_browser
from gsplat_edu.cli.terminal import Terminal
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.io.formats import LOD_META, SOG_META, file_in
from gsplat_edu.io.lod.codec import read_index
from gsplat_edu.options.view import BESIDE
from gsplat_edu.paths.keyframes import read_path
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.source import open_source
from gsplat_edu.server.address import warning_for
from gsplat_edu.server.page_server import PageServer
from gsplat_edu.viewer import export, page, page_parts
from gsplat_edu.viewer.edit_page import editing_of
from gsplat_edu.viewer.edit_serve import ADDRESS, EditServer
from gsplat_edu.viewer.page_mesh import open_meshes
from gsplat_edu.viewer.stream import folder_page


def run(arguments: argparse.Namespace) -> None:
    """Serve the page until Ctrl-C."""
    console = Terminal()
    _check_is_no_page(arguments.source)
    if _is_capture(arguments.source):
        _run_capture(arguments, console)
        return
    file = file_in(arguments.source)
    levels = file.name.lower() == LOD_META
    if arguments.budget is not None and not levels:
        raise ArgumentError(f"--budget: {arguments.source} has no levels of detail; convert it to {LOD_META}")
    editing = arguments.edit is not None
    if editing and levels:
        raise ArgumentError(
            "--edit: levels of detail cannot be edited; edit the scene, then convert it again"
        )
    does = "sees the scene and changes its edits" if editing else "sees the scene"
    # before loading the scene, so that a port in use is reported at once
    with _server(arguments, levels) as server:
        (_prepare_levels if levels else _prepare)(server, console, arguments)
        _serve(server, console, arguments, does, editing)


def _is_capture(path: Path) -> bool:
    """Return whether a path is to be read as a capture, and not as a scene or a run."""
    from gsplat_edu.data.reader import is_capture, layout_of

    if path.is_file():
        return path.name.lower() not in (LOD_META, SOG_META) and layout_of(path) is not None
    if not path.is_dir() or RunFolder(path).exists() or file_in(path) != path:
        return False
    return is_capture(path)


def _run_capture(arguments: argparse.Namespace, console: Terminal) -> None:
    """Serve the page of a capture until Ctrl-C; meanwhile, the doctor examines its photos."""
    from gsplat_edu.viewer import capture_page
    from gsplat_edu.viewer.capture_serve import CaptureServer, Examination

    for name in ("path", "surface", "collider", "budget", "edit"):
        if getattr(arguments, name) is not None:
            raise ArgumentError(
                f"--{name}: {arguments.source} is a capture; this option is for scenes and runs"
            )
    path: Path = arguments.source
    with CaptureServer(arguments.host, arguments.port, capture_page.policy(), path) as server:
        found = server.prepare(_title(path))
        console.say(f"{path}: {len(found.frames):,} photos, {found.facts['count']:,} points")
        console.say(found.facts["gap_sentence"])
        examination = Examination(server)
        examination.start()
        try:
            _serve(server, console, arguments, "sees the photos and leaves them out", True)
        finally:
            examination.stop()


def _serve(
    server: PageServer, console: Terminal, arguments: argparse.Namespace, does: str, token: bool
) -> None:
    """Print the address of a server's page, open it, and answer until Ctrl-C."""
    if warning := warning_for(arguments.host, does, token=token):
        console.say(warning)

    def opened() -> None:
        console.say(f"{server.url}   (press Ctrl-C to stop)")
        if not arguments.no_open and has_screen():
            open_in_browser(server.url)

    try:
        server.run(server.application(), opened)
    except KeyboardInterrupt:
        console.print("ended")


def _server(arguments: argparse.Namespace, levels: bool) -> PageServer:
    if arguments.edit is None:
        kind = page_parts.LEVELS if levels else page_parts.PLAIN
        return PageServer(page_parts.policy(kind), arguments.host, arguments.port)
    file = edits_file(arguments)
    check_writable("--edit", file)
    return EditServer(arguments.host, arguments.port, page_parts.policy(page_parts.EDITOR), file)


def edits_file(arguments: argparse.Namespace) -> Path:
    """Return the file that --edit names, or the usual one."""
    if arguments.edit != BESIDE:
        return Path(arguments.edit)
    source: Path = arguments.source
    return (
        source / "edits.json"
        if RunFolder(source).exists()
        else source.parent / f"{_title(source)}.edits.json"
    )


def _prepare(server: PageServer, console: Terminal, arguments: argparse.Namespace) -> None:
    """Put a page with the whole scene on the server."""
    along = None if arguments.path is None else read_path(arguments.path)
    source = open_source(arguments.source)
    if along is not None:
        along = along.shifted(-np.array(source.origin))
    meshes = open_meshes(arguments.surface, arguments.collider, source)
    title, tour = _title(arguments.source), page.Tour(along, meshes=meshes)
    editing = None
    if isinstance(server, EditServer):
        editing = editing_of(source, arguments.source, server.file, ADDRESS)
        server.prepare(identity_of(source.scene), arguments.source)
        console.say(f"edits: {server.file}")
    server.page = page.html(
        source.scene, source.cameras, source.settings, title, source.held_out, tour, editing
    )
    cameras = f", {len(source.cameras)} cameras" if source.cameras else ""
    console.say(
        f"{source.path}: {len(source.scene.gaussians):,} Gaussians{cameras}, {len(server.page):,} bytes"
    )


def _prepare_levels(server: PageServer, console: Terminal, arguments: argparse.Namespace) -> None:
    """Put a page on the server that loads levels of detail, and the files of their folder."""
    if arguments.path is not None:
        raise ArgumentError("--path: a page with levels of detail plays no path; view the scene itself")
    if arguments.surface is not None:
        raise ArgumentError("--surface: a page with levels of detail shows no mesh; view the scene itself")
    path = file_in(arguments.source)
    server.page, server.served = folder_page(path, _title(path.parent), arguments.budget)
    index = read_index(path)
    counts = ", ".join(f"{count:,}" for count in index.counts())
    console.say(f"{path}: levels of {counts} splats, {len(server.served)} files")


def _check_is_no_page(path: Path) -> None:
    """Reject a page, which a browser opens without this program."""
    if path.suffix.lower() == export.PAGE and path.is_file():
        raise ArgumentError(f"{path}: is already a page; open it in a browser: {path.resolve().as_uri()}")


def _title(path: Path) -> str:
    return path.resolve().name
