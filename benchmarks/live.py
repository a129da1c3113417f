"""By how much does a page that watches a training slow it down?

    python benchmarks/live.py [CAPTURE] [--from SCENE] [--resolution R] [--turns N] [--seconds S] [--smoke]
                              [--out FILE.json]

Trains with a live view. Alternately, for some seconds each, a headless Chromium shows an empty page or opens the
training's page again. Prints the iterations per second of each turn, and the median over neighbouring turns of the
lost fraction. Without a graphics processor, the page draws on the cores of the training, and other programs disturb
the rates. Therefore iterations per processor second of the training are printed as well, and on Linux the processor
time of the browser as a fraction of the training's.

--smoke requests states and snapshots without a browser.
"""

from __future__ import annotations

import os
import shutil
import statistics
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import hardware
from captures import capture

from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.cli.main import build_parser
from gsplat_edu.options.train import options_from
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.viewer.live import GRACE, LiveView
from gsplat_edu.viewer.snapshots import Broadcast

FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
SETTLING = GRACE + 3.0
"""Seconds before a turn without the page, after which the training forgets it."""


def browser_seconds() -> float:
    """Return the processor time of all descendants of this process, s; 0 without /proc."""
    parents, seconds = {}, {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:  # the process has ended
            continue
        parents[int(stat.parent.name)] = int(fields[1])
        seconds[int(stat.parent.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    below, found = {os.getpid()}, 0.0
    while children := {pid for pid, parent in parents.items() if parent in below} - below:
        below |= children
        found += sum(seconds[child] for child in children)
    return found


@contextmanager
def training(words: list[str], stop: threading.Event) -> Iterator[tuple[CaptureRun, LiveView]]:
    """Train in a thread of its own, with a live view."""
    run = CaptureRun(
        plan(options_from(build_parser(["train"]).parse_args(["train", *words])), Limits()).options
    )
    with LiveView(run, port=0) as view:
        broadcast = Broadcast(run, stop.is_set, [view])
        thread = threading.Thread(target=run.train, args=(stop.is_set, [broadcast.show]))
        thread.start()
        try:
            yield run, view
        finally:
            stop.set()
            thread.join()


@contextmanager
def page(smoke: bool) -> Iterator[Callable[[str], object]]:
    """Yield a function that opens an address in a headless Chromium, or with `smoke` only requests the page."""
    if smoke:
        yield lambda url: url.startswith("http") and urllib.request.urlopen(url, timeout=60).read()
        return
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
        tab = browser.new_page(viewport={"width": 1440, "height": 900})
        yield lambda url: tab.goto(url, wait_until="commit")
        browser.close()


def main() -> None:
    """Measure, print the turns and write the JSON."""
    parser = hardware.parser("Live view: what watching costs the training.")
    parser.add_argument("capture", type=Path, nargs="?")
    parser.add_argument("--from", dest="scene", type=Path)
    parser.add_argument("--resolution", default="1")
    parser.add_argument("--turns", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = parser.parse_args()
    settling, seconds, turns = SETTLING, arguments.seconds, arguments.turns
    if arguments.smoke:
        settling, seconds, turns = 0.0, 0.3, 2
    with ExitStack() as stack:
        folder = stack.enter_context(capture(arguments.capture, arguments.smoke))
        out = Path(stack.enter_context(TemporaryDirectory())) / "run"
        words = [
            str(folder),
            "--out",
            str(out),
            "--iterations",
            "1000000",
            "--eval-every",
            "0",
            "--save-every",
            "0",
        ]
        words += ["--resolution", arguments.resolution]
        words += [] if arguments.scene is None else ["--from", str(arguments.scene)]
        run, view = stack.enter_context(training(words, threading.Event()))
        show = stack.enter_context(page(arguments.smoke))
        rates: list[float] = []
        per_processor: list[float] = []
        busy: list[float] = []
        for turn in range(turns):
            if turn % 2 == 0:
                show("about:blank")
                time.sleep(settling)
            before, began = run.trainer.iteration, time.perf_counter()
            used, trained = browser_seconds(), time.process_time()
            if turn % 2:
                show(view.url)
            time.sleep(max(0.0, began + seconds - time.perf_counter()))
            taken, trained = time.perf_counter() - began, time.process_time() - trained
            rates.append((run.trainer.iteration - before) / taken)
            per_processor.append((run.trainer.iteration - before) / trained)
            busy.append((browser_seconds() - used) / trained)
        count = len(run.trainer.gaussians)
        print(f"{count} Gaussians at the end; the last scene shown is of iteration {view.shown()}")
    pairs = [1.0 - watched / alone for alone, watched in zip(rates[::2], rates[1::2], strict=False) if alone]
    lost = statistics.median(pairs) if pairs else 0.0
    found = {"rates": rates, "per_processor_second": per_processor, "browser": busy, "lost": lost}
    hardware.report({**found, "count": count}, arguments.out)
    for name, first in (("alone", 0), ("watched", 1)):
        for unit, values in (("s", rates), ("processor second", per_processor)):
            print(f"{name:>8}: {'  '.join(f'{rate:.2f}' for rate in values[first::2])} iterations/{unit}")
    shares = "  ".join(f"{100 * part:.1f} %" for part in busy[1::2])
    print(f" browser: {shares} of the training's processor time, watching")
    print(f"lost by watching: {100 * lost:.1f} % (median of {len(pairs)} pairs)")


if __name__ == "__main__":
    main()
