"""Are --max-memory and --time-limit kept, and how accurate is the forecast?

    python benchmarks/limits.py [CAPTURE] [--memory SIZE ...] [--time TIME ...] [--smoke] [--out FILE.json]

Runs `gsplat-edu train CAPTURE` (default: snowmiku97 in $GSPLAT_EDU_DATA or ../shared/data, or else a procedural
capture) in its own process, once for each limit (default: 1GiB, 2GiB, 2m, 4m), and measures its peak RSS by wait4,
its wall time, and the forecast it printed. Runs with a memory limit get options that split every Gaussian as often as
possible, so that they reach the chosen cap and use the memory. Needs Linux, where ru_maxrss is in KiB.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from captures import capture

COMMAND = "import sys; from gsplat_edu.cli.main import main; sys.exit(main())"

FILLING = "--strategy adc --iterations 300 --no-rescale --set sh_every=20 --set densify_start=10 --set densify_every=20"
FILLING += (
    " --set densify_stop=250 --set reset_every=0 --set grad_threshold=2e-6 --eval-every 200 --save-every 100"
)
"""Options that grow a scene to its cap in a few hundred iterations, without regard to its quality."""

UNITS = {"h": 3600.0, "min": 60.0, "s": 1.0}
SIZES = {"MiB": 2.0**20, "GiB": 2.0**30}


def train(folder: Path, limit: list[str]) -> dict[str, Any]:
    """Train with one limit; return the measurements and the forecast."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "run"
        words = [sys.executable, "-c", COMMAND, "train", str(folder), "--out", str(out), *limit]
        with (Path(scratch) / "said.txt").open("w+") as said:
            # A child's peak includes its parent's memory at the start, so this process keeps its own small.
            actions = [(os.POSIX_SPAWN_DUP2, said.fileno(), descriptor) for descriptor in (1, 2)]
            began = time.perf_counter()
            child = os.posix_spawn(words[0], words, os.environ, file_actions=actions)
            _, status, usage = os.wait4(child, 0)
            seconds = time.perf_counter() - began
            said.seek(0)
            text = said.read()
        code = os.waitstatus_to_exitcode(status)
        if code:
            raise SystemExit(f"limits.py: the training failed with exit code {code}: {text.strip()[-500:]}")
        metrics = json.loads((out / "metrics.json").read_text())
        config = json.loads((out / "config.json").read_text())
    return {
        "limit": " ".join(limit[:2]),
        "seconds": seconds,
        "processor_seconds": usage.ru_utime + usage.ru_stime,
        "peak_rss": 1024 * usage.ru_maxrss,
        "forecast": forecast(text),
        "said": [line for line in text.splitlines() if "forecast" in line or "chosen" in line],
        "iterations": [config["train"]["iterations"], metrics["iterations"]],
        "max_gaussians": config["train"]["max_gaussians"],
        "num_gaussians": metrics["num_gaussians"],
        "resolution": config["data"]["resolution"],
        "test_psnr": metrics["test"]["psnr"],
        "ms": 1e3 * metrics["seconds"] / metrics["iterations"],
    }


def forecast(text: str) -> dict[str, float | None]:
    """Parse the printed forecast: seconds, and bytes with the maximum number of Gaussians."""
    duration = re.search(r"forecast: time: about ((?:\d+ (?:h|min|s) ?)+)", text)
    sizes = re.findall(r"up to ([\d.e+]+) (MiB|GiB)", text)
    seconds = None
    if duration:
        seconds = sum(float(n) * UNITS[unit] for n, unit in re.findall(r"(\d+) (h|min|s)", duration[1]))
    return {"seconds": seconds, "peak_rss": float(sizes[-1][0]) * SIZES[sizes[-1][1]] if sizes else None}


def line(found: dict[str, Any]) -> str:
    """Return a run as one row of the table."""
    expected, gib = found["forecast"], 2.0**30
    return (
        f"{found['limit']:20} {found['seconds']:7.1f} s (forecast {expected['seconds'] or 0:.0f})  "
        f"{found['peak_rss'] / gib:6.3f} GiB (forecast {(expected['peak_rss'] or 0) / gib:.3f})  "
        f"{found['iterations'][1]} of {found['iterations'][0]} iterations at {found['ms']:.1f} ms, "
        f"{found['num_gaussians']} Gaussians, cap {found['max_gaussians']}, resolution {found['resolution']}, "
        f"test {found['test_psnr']:.2f} dB"
    )


def main() -> None:
    """Train under every limit, print the rows and write the JSON."""
    made = argparse.ArgumentParser(description="Check memory and time limits from outside the process.")
    made.add_argument("capture", nargs="?", type=Path)
    made.add_argument("--memory", nargs="*", metavar="SIZE", help="memory limits (default: 1GiB 2GiB)")
    made.add_argument("--time", nargs="*", metavar="TIME", help="time limits (default: 2m 4m)")
    made.add_argument("--out", type=Path, help="JSON file to write")
    made.add_argument("--smoke", action="store_true", help="one tiny training per kind of limit")
    arguments = made.parse_args()
    default = (["1GiB"], ["1h"]) if arguments.smoke else (["1GiB", "2GiB"], ["2m", "4m"])
    memory, times = (
        usual if given is None else given
        for given, usual in zip((arguments.memory, arguments.time), default, strict=True)
    )
    short = ["--iterations", "20"] if arguments.smoke else []
    limits = [["--max-memory", size, *FILLING.split(), *short] for size in memory]
    limits += [["--time-limit", duration, *short] for duration in times]
    rows = []
    with capture(arguments.capture, arguments.smoke) as folder:
        for limit in limits:
            before = os.getloadavg()[0]
            rows.append(train(folder, limit) | {"load": [before, os.getloadavg()[0]]})
            load = rows[-1]["load"]
            print(line(rows[-1]) + f", load {load[0]:.1f} to {load[1]:.1f}", flush=True)
    import hardware  # imported late, because torch's memory would count as the children's

    hardware.report({"capture": folder.name, "runs": rows}, arguments.out)


if __name__ == "__main__":
    main()
