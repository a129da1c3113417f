"""Processes that start at once: forked from one that has imported the package.

Importing torch and the commands takes several seconds of a processor, and a test that kills a run thirteen times would
import them thirteen times. multiprocessing's fork server imports them once for each process that runs tests. It is a
process of its own, without the hook that checks shapes, and its children end, or are killed, as any other program.
"""

import multiprocessing
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["processes", "gsplat_edu.cli.main", "gsplat_edu.cli.train"])


def _run(code: str, words: Sequence[str], threads: int, out: Path, err: Path) -> None:
    """Run a program in this process as `python -c CODE WORDS` would, its output going into two files."""
    for path, number in ((out, 1), (err, 2)):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, number)
        os.close(file)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv = ["-c", *words]
    import torch

    torch.set_num_threads(threads)
    exec(compile(code, "program", "exec"), {"__name__": "__main__"})


class Program:
    """A Python program that runs in a process of its own.

    Args:
        code: The program.
        words: Its arguments, sys.argv[1:].
        folder: Where its output goes, into files that the next program there writes over.
        threads: torch's and the kernels' threads.
    """

    def __init__(self, code: str, words: Sequence[object], folder: Path, threads: int = 1) -> None:
        self._out, self._err = folder / "stdout.txt", folder / "stderr.txt"
        words = [str(word) for word in words]
        self.process = CONTEXT.Process(target=_run, args=(code, words, threads, self._out, self._err))
        self.process.start()

    @property
    def runs(self) -> bool:
        return self.process.is_alive()

    def send(self, number: int) -> None:
        os.kill(self.process.pid, number)

    def ended(self, patience: float = 120.0) -> tuple[int, str, str]:
        """Wait for the end; return the exit code, negative for a signal, and what was written to both streams."""
        self.process.join(patience)
        assert not self.process.is_alive(), "it hangs"
        return self.process.exitcode, self._out.read_text(), self._err.read_text()
