"""`gsplat-edu view`: a real server in its own process, and real requests."""

import contextlib
import dataclasses
import json
import os
import re
import select
import shutil
import signal
import socket
import sys
import time
import urllib.error
import urllib.request
from contextlib import contextmanager

import numpy as np
import pytest

import gsplat_edu.cli.main as command_line
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.mesh_files import write_mesh
from gsplat_edu.io.ply import save_ply
from gsplat_edu.io.scene import Scene
from gsplat_edu.paths.keyframes import Keyframe, KeyframePath, read_path, write_path
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.source import open_source
from gsplat_edu.scene.mesh import Mesh
from gsplat_edu.viewer import page
from gsplat_edu.viewer.page_mesh import open_meshes
from gsplat_edu.viewer.stream import folder_page
from processes import Program
from scene_files import small_levels
from splats import splats_on
from waiting import PATIENCE, until

COMMAND = "import sys; from gsplat_edu.cli.main import main; sys.exit(main())"
IN_A_TERMINAL = (
    """
import json, os, sys
os.environ.update(json.loads(sys.argv.pop(1)))
terminal = os.open(sys.argv.pop(1), os.O_RDWR)
for number, name in enumerate(("stdin", "stdout", "stderr")):
    os.dup2(terminal, number)
    setattr(sys, name, open(number, "w" if number else "r", closefd=False))
"""
    + COMMAND
)
PRESSED = """
import signal
from gsplat_edu.cli import view
view.has_screen = lambda: signal.raise_signal(signal.SIGINT) or False
"""
"""Presses Ctrl-C once the address was printed."""

ORIGIN = (512.0, -64.0, 8.0)
ORANGE = (1.0, 0.5, 0.0)

own_process = pytest.mark.own_process


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run with moved coordinates and an orange background, and its scene alone as a .splat."""
    root = tmp_path_factory.mktemp("made")
    views, points, colors = procedural_capture(size=48, count=6)
    gaussians = splats_on(points, colors)
    folder = RunFolder(root / "egg & spoon")
    settings = RenderSettings(background=ORANGE, antialiased=True, jacobian_limit=1.3)
    folder.write_config({"render": dataclasses.asdict(settings), "origin": list(ORIGIN), "data": {}})
    save_ply(folder.scene(30), gaussians, ORIGIN)
    folder.write_cameras(views[:4], views[4:], ORIGIN)
    write_scene(root / "bare.splat", Scene(gaussians))
    return folder, root / "bare.splat"


@contextmanager
def viewing(folder, *words, ends_with=signal.SIGINT):
    """Run the command, with its output in a folder; yield its output up to the URL, and the URL. It must exit cleanly
    on the signal `ends_with`."""
    address = r"(http://\S+/)   \(press Ctrl-C to stop\)\n"
    program = Program(COMMAND, ["view", *words], folder)
    try:
        until(lambda: not program.runs or re.search(address, program.said()))
        printed = program.said()
        found = re.search(address, printed)
        assert found, printed
        yield printed, found[1]
        program.send(ends_with)
        assert program.ended(PATIENCE) == (0, f"{printed}ended\n", "")
    finally:
        program.process.kill()
        program.process.join()


def fetched(url):
    with urllib.request.urlopen(url, timeout=PATIENCE) as answer:
        return answer.read()


@own_process
def test_a_run_is_shown_with_its_cameras_path_and_settings_until_ctrl_c(made, tmp_path):
    folder, _ = made
    frames = [Keyframe.of_camera(camera) for _, _, camera in folder.read_cameras(ORIGIN)[:3]]
    path = KeyframePath(tuple(frames), True)
    write_path(tmp_path / "path.json", path, ORIGIN)
    mesh = Mesh(np.eye(3) + ORIGIN, np.array([[0, 1, 2]]), np.eye(3, dtype=np.float32))
    write_mesh(tmp_path / "a.glb", mesh)
    words = ["--port", "0", "--no-open", "--path", tmp_path / "path.json", "--surface", tmp_path / "a.glb"]
    with viewing(tmp_path, folder.path, *words) as (printed, url):
        source = open_source(folder.path)
        assert len(source.cameras) == 6 and len(source.held_out) == 2
        assert source.settings.background == ORANGE
        assert fetched(url) == page.html(
            source.scene,
            source.cameras,
            source.settings,
            "egg & spoon",
            source.held_out,
            page.Tour(
                read_path(tmp_path / "path.json", ORIGIN),
                meshes=open_meshes(tmp_path / "a.glb", None, source),
            ),
        )
        with pytest.raises(urllib.error.HTTPError) as refused:
            fetched(f"{url}config.json")
        assert refused.value.code == 404
        refused.value.close()
    scene = folder.scene(30)
    assert re.fullmatch(
        rf"{re.escape(str(scene))}: 200 Gaussians, 6 cameras, [\d,]+ bytes", printed.splitlines()[0]
    )
    assert url.startswith("http://127.0.0.1:")


@own_process
def test_a_scene_of_another_format_has_no_cameras(made, tmp_path):
    _, bare = made
    with viewing(tmp_path, bare, "--port", "0", "--host", "0.0.0.0", "--no-open") as (printed, url):
        source = open_source(bare)
        assert fetched(url) == page.html(source.scene, (), source.settings, "bare.splat")
    first, warning, _ = printed.splitlines()
    assert "200 Gaussians, " in first and "cameras" not in first
    assert warning.startswith(
        "warning: listening on 0.0.0.0: anyone who can reach this computer sees the scene"
    )


@own_process
def test_levels_of_detail_are_served_with_their_files(tmp_path):
    path = small_levels(tmp_path)
    with viewing(tmp_path, path.parent, "--port", "0", "--no-open", "--budget", "30") as (printed, url):
        assert fetched(url) == folder_page(path, "levels", 30)[0]
        assert fetched(f"{url}lod-meta.json") == path.read_bytes()
        assert fetched(f"{url}0_1/quats.webp") == (path.parent / "0_1" / "quats.webp").read_bytes()
    assert printed.splitlines()[0] == f"{path}: levels of 40, 20 splats, 25 files"


@own_process
def test_ctrl_c_right_after_the_address_was_printed_ends_the_command_cleanly(made, tmp_path):
    """The line says that Ctrl-C stops it; the server may not have begun to answer yet."""
    program = Program(PRESSED + COMMAND, ["view", made[1], "--port", "0"], tmp_path)
    code, said, complaints = program.ended(PATIENCE)
    assert (code, complaints) == (0, "") and said.endswith("   (press Ctrl-C to stop)\nended\n")


@pytest.mark.skipif(shutil.which("sh") is None or sys.platform == "win32", reason="needs sh and a terminal")
@own_process
def test_the_browser_opens_only_on_a_terminal_with_a_screen(made, tmp_path):
    import pty

    _, bare = made
    noted = tmp_path / "opened"
    script = tmp_path / "browser"
    script.write_text(f'#!/bin/sh\necho "$1" > {noted}.part && mv {noted}.part {noted}\n')
    script.chmod(0o755)

    def opened(*words, **environment):
        """Return whether the browser opened the URL before the command was interrupted."""
        noted.unlink(missing_ok=True)
        ours, theirs = pty.openpty()
        settings = {"BROWSER": str(script), "DISPLAY": ":99", "WAYLAND_DISPLAY": ""} | environment
        given = [json.dumps(settings), os.ttyname(theirs), "view", bare, "--port", "0", *words]
        program = Program(IN_A_TERMINAL, given, tmp_path)
        try:
            printed, deadline = b"", time.monotonic() + PATIENCE
            while b"press Ctrl-C to stop" not in printed:
                assert select.select([ours], [], [], deadline - time.monotonic())[0], printed
                printed += os.read(ours, 1 << 16)
            url = re.search(rb"http://\S+", printed)[0].decode()
            with urllib.request.urlopen(url, timeout=PATIENCE):
                pass
            if not words and not environment:
                until(noted.exists)
            program.send(signal.SIGINT)
            assert program.ended(PATIENCE)[0] == 0
            os.close(theirs)
            with contextlib.suppress(OSError):  # once the command and the browser have closed the terminal
                while os.read(ours, 1 << 16):
                    pass
        finally:
            program.process.kill()
            program.process.join()
            os.close(ours)
        return noted.exists() and noted.read_text().strip() == url

    assert opened()
    assert not opened("--no-open")
    assert not opened(DISPLAY="")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["nowhere"], "nowhere: does not exist; give a scene file or the folder of a run"),
        (["empty"], "empty: is not a run (it has no config.json)"),
        (["notes.txt"], "notes.txt: unknown scene format"),
        (["cut.ply"], "cut.ply: "),
        (["desk.html"], "desk.html: is already a page; open it in a browser: file://"),
        (["gone.html"], "gone.html: does not exist"),
        (["unfinished"], "unfinished: contains no scene"),
        (["cut.ply", "--path", "notes.txt"], "notes.txt: is not JSON"),
        (["desk.splat", "--budget", "5"], "--budget: desk.splat has no levels of detail"),
        (["levels", "--path", "notes.txt"], "--path: a page with levels of detail plays no path"),
        (["levels", "--surface", "notes.txt"], "--surface: a page with levels of detail shows no mesh"),
        (["nowhere", "--port", "70000"], "--port: is 70000"),
        (["nowhere", "--port", "many"], "argument --port: 'many' is not a whole number"),
        (["nowhere", "--host", "no such host"], "--host: 'no such host' is not an address"),
    ],
)
@pytest.mark.usefixtures("as_shipped")
def test_sources_that_cannot_be_viewed_are_refused_in_one_line(tmp_path, monkeypatch, capsys, words, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("notes")
    (tmp_path / "desk.html").write_bytes(page.html(Scene(splats_on(np.zeros((1, 3)), np.zeros((1, 3))))))
    (tmp_path / "cut.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement ver")
    RunFolder(tmp_path / "unfinished").write_config({"render": {}})
    small_levels(tmp_path)
    default = [] if "--port" in words else ["--port", "0"]
    try:
        code = command_line.main(["view", *words, *default])
    except SystemExit as stop:  # raised by argparse
        code = stop.code
    said = capsys.readouterr()
    assert code == 2 and said.out == ""
    assert said.err.startswith(f"gsplat-edu view: {says}") and said.err.count("\n") == 1


@pytest.mark.usefixtures("as_shipped")
def test_a_port_that_is_taken_costs_one_line_before_the_scene_is_read(capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen(1)
        port = taken.getsockname()[1]
        assert command_line.main(["view", "nowhere", "--port", str(port)]) == 2
    says = f"gsplat-edu view: --port: {port} is in use on 127.0.0.1; choose another port, or 0 for any free one\n"
    assert capsys.readouterr().err == says
