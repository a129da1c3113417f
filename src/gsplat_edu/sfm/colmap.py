"""Run COLMAP in a separate process: jobs for `gsplat_edu.sfm.engine` and their results."""

from __future__ import annotations

import importlib.util
import json
import queue
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.text import install_command

BEAT = 10.0
"""Seconds after which the progress of a job that reports nothing is repeated, so that its time can be shown."""

COLMAP_SEED = 0
"""Seed for all random numbers of COLMAP and of this package during structure from motion."""


def require_colmap() -> None:
    """Check that pycolmap is installed, without loading it.

    Raises:
        ArgumentError: it is missing; says how to install it.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise ArgumentError(f"sfm: needs pycolmap, which is not installed: {install_command('sfm')}")


def call(
    job: str, log: Path, progress: Callable[[int], None] = lambda done: None, **arguments: object
) -> dict[str, Any]:
    """Run a COLMAP job in a process that always ends with this call.

    Args:
        job: One of `gsplat_edu.sfm.engine.jobs.JOBS`.
        log: File to which COLMAP's output is appended.
        progress: Called with the amount done, in the calling thread. An exception from it ends the job.
        arguments: Arguments of the job.

    Returns:
        The job's result.

    Raises:
        DatasetError: the job failed; names the log.
    """
    # -P: the files next to the program cannot be imported as modules by their bare names
    command = [sys.executable, "-P", str(Path(__file__).parent / "engine" / "__main__.py")]
    with log.open("ab") as words:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=words)
    answers: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    listener = threading.Thread(target=forward_messages, args=(process, answers), daemon=True)
    result: dict[str, Any] | None = None
    assert process.stdin is not None and process.stdout is not None
    try:
        with suppress(BrokenPipeError):  # the process failed at once
            process.stdin.write(json.dumps({"job": job, **arguments}).encode() + b"\n")
            process.stdin.flush()  # it stays open: its end tells the process that this one has ended
        listener.start()
        result = await_result(answers, progress)
        code = process.wait()
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        if listener.ident is not None:
            listener.join()
        process.stdout.close()
        with suppress(BrokenPipeError):  # what the process did not read
            process.stdin.close()
    if result is None:
        how = f"was ended by signal {-code}" if code < 0 else f"failed with code {code}"
        raise DatasetError(
            f"COLMAP's {job} {how}: see the last lines of {log}; reduce --max-features or "
            "--max-image-size, or run the command again"
        )
    return result


def await_result(
    answers: queue.SimpleQueue[dict[str, Any]], progress: Callable[[int], None]
) -> dict[str, Any] | None:
    """Forward a job's progress until it ends; return its result, or None if it has none.

    Args:
        answers: The job's messages.
        progress: Called with the amount done; also, now and then, while the job reports nothing.
    """
    done = 0
    while True:
        try:
            answer = answers.get(timeout=BEAT)
        except queue.Empty:
            progress(done)
            continue
        if "done" not in answer:
            return answer.get("result")
        done = answer["done"]
        progress(done)


def forget_matches(database: Path) -> None:
    """Remove all matches from the database; features stay.

    Args:
        database: COLMAP's database. If it does not exist, nothing is done.

    Raises:
        DatasetError: the database cannot be modified.
    """
    _change(database, [("DELETE FROM matches", ()), ("DELETE FROM two_view_geometries", ())])


def forget_features(database: Path, names: Sequence[str]) -> None:
    """Remove the features of some photos from the database; photos and cameras stay.

    Args:
        database: As for `forget_matches`.
        names: The photos.

    Raises:
        DatasetError: the database cannot be modified.
    """
    which = "image_id IN (SELECT image_id FROM images WHERE name = ?)"
    tables = ("keypoints", "descriptors")
    _change(database, [(f"DELETE FROM {table} WHERE {which}", (name,)) for table in tables for name in names])


def _change(database: Path, statements: Sequence[tuple[str, tuple[str, ...]]]) -> None:
    if not database.is_file():
        return
    try:
        with closing(sqlite3.connect(database)) as writer, writer:
            for statement, values in statements:
                writer.execute(statement, values)
    except sqlite3.Error as error:
        raise _unchangeable(database, error) from None


def limit_features(database: Path, most: int) -> None:
    """Keep each photo's features of the largest scales; COLMAP's own limit keeps whole scale levels.

    COLMAP skips the finest levels only while the remaining ones exceed the limit, and counts positions, some of which
        become two features with two orientations: a limit of 2,000 gave 3,500.

    Args:
        database: COLMAP's database, before matching.
        most: Most features per photo.

    Raises:
        DatasetError: the database cannot be modified.
    """
    tables = (("keypoints", np.float32), ("descriptors", np.uint8))
    try:
        with closing(sqlite3.connect(database)) as writer, writer:
            many = writer.execute("SELECT image_id FROM keypoints WHERE rows > ?", (most,)).fetchall()
            for (image,) in many:
                kept = np.arange(most)
                for table, kind in tables:
                    query = f"SELECT rows, cols, data FROM {table} WHERE image_id = ?"
                    rows, columns, data = writer.execute(query, (image,)).fetchone()
                    values = np.frombuffer(data, kind).reshape(rows, columns)
                    if table == "keypoints":
                        a, b, c, d = values[:, 2:6].T.astype(np.float64)  # shape: scale times rotation
                        kept = np.sort(np.argsort(-np.abs(a * d - b * c), kind="stable")[:most])
                    change = f"UPDATE {table} SET rows = ?, data = ? WHERE image_id = ?"
                    writer.execute(change, (most, values[kept].tobytes(), image))
    except sqlite3.Error as error:
        raise _unchangeable(database, error) from None


def _unchangeable(database: Path, error: sqlite3.Error) -> DatasetError:
    return DatasetError(
        f"{database}: cannot be modified ({error}); remove {database.parent / 'stages.json'} and "
        f"{database}, or choose another folder"
    )


def forward_messages(process: subprocess.Popen[bytes], answers: queue.SimpleQueue[dict[str, Any]]) -> None:
    """Forward a process's messages, and report its end; the last line of one that was killed may be incomplete."""
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if line.endswith(b"\n"):
                answers.put(json.loads(line))
    finally:
        answers.put({"ended": True})
