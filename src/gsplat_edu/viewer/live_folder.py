"""The files by which another process watches a training. This module imports nothing slow, so that a server can use it.

They lie in `live/` in the run's folder. The watcher writes these, and makes the folder:

    wanted      empty; the watcher touches it. While it is younger than `FRESH` seconds, `gsplat-edu train` writes the
                files below, and otherwise nothing.
    pause       empty; while it is present, the training waits between two iterations, watched or not. Only the watcher
                removes it. A run that is started or resumed while it is present waits after its first iteration.

The training writes these, each under a temporary name that is then renamed, and removes them when it ends:

    page.json   the facts of `gsplat_edu.viewer.page` without splats: cameras, start, settings, up, title. It is written
                once, and a reader may keep it as long as `pid` in state.json stays the same.
    page.html   the page that shows the training, with its own Content-Security-Policy. It asks, relative to its own
                address, for what `gsplat_edu.viewer.live` lists: a server in front of these files has to answer
                `state?after=V`, `scene?after=I` and `control`, and `picture` for browsers without WebGL2.
    state.json  strict JSON on one line; see `gsplat_edu.viewer.snapshots.state_of`. It is written at most twice a
                second, less often if that would slow the training, and while the training waits at least every two.
    scene.bin   the newest Gaussians. It begins with four bytes, the length H of a header as uint32, little-endian; H is
                a multiple of 4. H bytes follow, JSON padded with spaces:
                {"format": "gsplat-edu snapshot", "version": 1, "iteration": ..., "count": N, "sh_degree": d}.
                The rest is what `gsplat_edu.viewer.page_data` packs for N splats of degree d.

`iteration` in the header counts the images trained on and identifies the scene: a reader has the newest one if it
equals `scene` in state.json. scene.bin is written first, so it may be newer than state.json says, but never older.
A training that is killed leaves its files; `seconds_old` tells by state.json whether they are still being written.
"""

from __future__ import annotations

import errno
import json
import struct
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import open_file, parse_json, read_text

FRESH = 5.0
"""Seconds for which a touch of `wanted` counts."""

WAIT = 2.0
"""Seconds that a page's request for a state or a scene waits for something new."""

SNAPSHOT_FORMAT = "gsplat-edu snapshot"
SNAPSHOT_VERSION = 1

HEADER_LENGTH = struct.Struct("<I")
ALIGNMENT = 4
"""The header's length is a multiple of this, so that the float32 behind it can be read in place."""

LONGEST_HEADER = 4096


@dataclass(frozen=True)
class LiveFolder:
    """The files of a watched training; they need not exist.

    Args:
        run: The run's folder.
    """

    run: Path

    @property
    def path(self) -> Path:
        """The folder of the files."""
        return self.run / "live"

    @property
    def wanted(self) -> Path:
        """Touched by the watcher."""
        return self.path / "wanted"

    @property
    def pause(self) -> Path:
        """Present while the training should wait."""
        return self.path / "pause"

    @property
    def page(self) -> Path:
        """The facts of the page."""
        return self.path / "page.json"

    @property
    def html(self) -> Path:
        """The page."""
        return self.path / "page.html"

    @property
    def state(self) -> Path:
        """The state of the training."""
        return self.path / "state.json"

    @property
    def scene(self) -> Path:
        """The newest Gaussians."""
        return self.path / "scene.bin"

    def ask(self) -> None:
        """Ask the training for its files during the next `FRESH` seconds.

        Raises:
            OSError: the file cannot be written.
        """
        self._touch(self.wanted)

    def is_wanted(self) -> bool:
        """Return whether a watcher asked for the files within the last `FRESH` seconds."""
        return _age(self.wanted) < FRESH

    def is_paused(self) -> bool:
        """Return whether the training should wait."""
        return self.pause.exists()

    def set_paused(self, paused: bool) -> None:
        """Let the training wait, or continue.

        Raises:
            OSError: the file cannot be written or removed.
        """
        if paused:
            self._touch(self.pause)
        else:
            self.pause.unlink(missing_ok=True)

    def _touch(self, path: Path) -> None:
        """Touch a file of the watcher; again if the training has just removed the folder, which was empty."""
        for last in (False, False, True):
            self.path.mkdir(parents=True, exist_ok=True)
            try:
                path.touch()
            except FileNotFoundError:
                if last:
                    raise
            else:
                return

    def seconds_old(self) -> float:
        """Return the age of state.json in seconds; infinite if there is none."""
        return _age(self.state)

    def read_state(self) -> dict[str, Any] | None:
        """Read state.json; None if there is none.

        Raises:
            SceneFormatError: the file is damaged.
            OSError: the file cannot be read.
        """
        return _read(self.state)

    def read_page(self) -> dict[str, Any] | None:
        """Read page.json; None if there is none.

        Raises:
            SceneFormatError: the file is damaged.
            OSError: the file cannot be read.
        """
        return _read(self.page)

    def write(self, path: Path, value: Mapping[str, Any]) -> None:
        """Write page.json or state.json.

        Raises:
            OSError: the file cannot be written. An existing file is unchanged.
        """
        with written_aside(path) as aside:
            aside.write_text(json.dumps(value, allow_nan=False, separators=(",", ":")) + "\n", "utf-8")

    def write_bytes(self, path: Path, data: bytes) -> None:
        """Write scene.bin or page.html.

        Raises:
            OSError: the file cannot be written. An existing file is unchanged.
        """
        with written_aside(path) as aside:
            aside.write_bytes(data)

    def clear(self) -> None:
        """Remove what the training wrote, and the folder if nothing else is in it.

        Raises:
            OSError: a file cannot be removed.
        """
        for path in (self.page, self.html, self.state, self.scene):
            path.unlink(missing_ok=True)
        try:
            self.path.rmdir()
        except OSError as error:  # there is none, or a watcher has files in it
            if error.errno not in (errno.ENOENT, errno.ENOTEMPTY, errno.EEXIST):
                raise


def framed(iteration: int, count: int, sh_degree: int, packed: bytes) -> bytes:
    """Put the header of scene.bin in front of packed splats.

    Args:
        iteration: Images trained on.
        count: Number of splats.
        sh_degree: Their SH degree.
        packed: The splats, from `gsplat_edu.viewer.page_data.packed`.
    """
    header = {
        "format": SNAPSHOT_FORMAT,
        "version": SNAPSHOT_VERSION,
        "iteration": iteration,
        "count": count,
        "sh_degree": sh_degree,
    }
    text = json.dumps(header).encode("ascii")
    text += b" " * (-len(text) % ALIGNMENT)
    return HEADER_LENGTH.pack(len(text)) + text + packed


def header_of(path: Path) -> dict[str, Any] | None:
    """Read the header of scene.bin without its splats; None if there is no file.

    Args:
        path: The file.

    Raises:
        SceneFormatError: the file is damaged, or of another version.
        OSError: the file cannot be read.
    """
    try:
        with open_file(path) as file:
            begin = file.read(HEADER_LENGTH.size)
            length = HEADER_LENGTH.unpack(begin)[0] if len(begin) == HEADER_LENGTH.size else 0
            text = file.read(min(length, LONGEST_HEADER))
    except FileNotFoundError:
        return None
    return _checked_header(path, text)


def _checked_header(path: Path, text: bytes) -> dict[str, Any]:
    try:
        header = parse_json(text)
    except ValueError:
        header = None
    if not isinstance(header, dict) or header.get("format") != SNAPSHOT_FORMAT:
        raise SceneFormatError(f"{path}: is not a snapshot of a training, or is damaged; remove it")
    if header.get("version") != SNAPSHOT_VERSION:
        raise SceneFormatError(
            f"{path}: has snapshot version {header.get('version')!r}, but {SNAPSHOT_VERSION} is supported; use the same"
            " gsplat_edu for both programs"
        )
    return header


def split(path: Path, data: bytes) -> tuple[dict[str, Any], bytes]:
    """Split the bytes of scene.bin into its header and its splats.

    Args:
        path: The file's name for messages.
        data: Its bytes.

    Raises:
        SceneFormatError: they are damaged, or of another version.
    """
    length = HEADER_LENGTH.unpack(data[: HEADER_LENGTH.size])[0] if len(data) >= HEADER_LENGTH.size else 0
    begin = HEADER_LENGTH.size + min(length, LONGEST_HEADER)
    return _checked_header(path, data[HEADER_LENGTH.size : begin]), data[begin:]


def _age(path: Path) -> float:
    """Return the seconds since a file was written or touched; infinite if there is none."""
    try:
        return abs(time.time() - path.stat().st_mtime)
    except OSError:
        return float("inf")


def _read(path: Path) -> dict[str, Any] | None:
    try:
        value = parse_json(read_text(path))
    except FileNotFoundError:
        return None
    except ValueError:
        value = None
    if not isinstance(value, dict):
        raise SceneFormatError(f"{path}: is damaged; remove it")
    return value
