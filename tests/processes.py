"""Processes that start fast, because they are forked from a process that has imported the package.

Importing torch and the commands takes several seconds of CPU time, and a test that kills a run thirteen times would
import them thirteen times. multiprocessing's fork server imports them once per process that runs tests. The fork
server runs without the shape-checking hook, and its children end or are killed like any other program.
"""

import multiprocessing
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

CONTEXT = multiprocessing.get_context("forkserver" if hasattr(os, "fork") else "spawn")
if hasattr(os, "fork"):
    CONTEXT.set_forkserver_preload(["processes", "photos", "gsplat_edu.cli.main", "gsplat_edu.cli.train"])


def _run(code: str, words: Sequence[str], threads: int, out: Path, err: Path) -> None:
    """Run a program in this process as `python -c CODE WORDS` would, with its output in two files."""
    for path, number in ((out, 1), (err, 2)):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, number)
        os.close(file)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv = ["-c", *words]
    import torch

    import photos

    torch.set_num_threads(threads)
    photos.keep()
    exec(compile(code, "program", "exec"), {"__name__": "__main__"})


class Program:
    """A Python program that runs in its own process.

    Args:
        code: The program.
        words: Its arguments, sys.argv[1:].
        folder: Where to write the output. The next program with the same folder overwrites it.
        threads: Number of threads of torch and the kernels.
    """

    def __init__(self, code: str, words: Sequence[object], folder: Path, threads: int = 1) -> None:
        self._out, self._err = folder / "stdout.txt", folder / "stderr.txt"
        words = [str(word) for word in words]
        self.process = CONTEXT.Process(target=_run, args=(code, words, threads, self._out, self._err))
        self.process.start()

    @property
    def runs(self) -> bool:
        return self.process.is_alive()

    def said(self) -> str:
        """Return what the program has written to stdout so far."""
        return self._out.read_text() if self._out.exists() else ""

    def send(self, number: int) -> None:
        os.kill(self.process.pid, number)

    def ended(self, patience: float = 300.0) -> tuple[int, str, str]:
        """Wait for the end; return the exit code (negative for a signal), stdout and stderr."""
        self.process.join(patience)
        assert not self.process.is_alive(), "the program did not end in time"
        return self.process.exitcode, self._out.read_text(), self._err.read_text()
