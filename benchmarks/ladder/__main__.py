"""What does each rung of the ladder gain, and how does that depend on the number of splats?

    python benchmarks/ladder [--smoke] [--out FILE.json]

Round splats of 2 px on 256 x 256 pixels, opacities 0.1 to 0.99, float32, one thread. Times are CPU times of the
process, the best of several rounds. The kernels themselves count how often they evaluate a splat at a pixel.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import hardware

from gsplat_edu.base.errors import BackendUnavailableError
from ladder import forward
from ladder.splats import scene

SIZE, COUNTS = 256, (100, 1_000, 10_000, 100_000)
TRITON_SIZE, TRITON_COUNT = 64, 200


def measure(count: int, size: int, rounds: int) -> list[dict[str, float | str]]:
    """Measure every rung at one number of splats."""
    splats, rows = scene(count, size), []
    for rung in forward.RUNGS:
        seconds, rendered = forward.seconds(rung, splats, enough=1.0, rounds=rounds)
        row: dict[str, float | str] = {"rung": rung, "splats": count, "size": size, "ms": 1e3 * seconds}
        row["ns_per_pixel_splat"] = 1e9 * seconds / (splats.pixels * count)
        rows.append(row | rendered.counts._asdict())
    for row in rows:
        row["times_faster"] = float(rows[0]["ms"]) / float(row["ms"])
    return rows


def triton_row(smoke: bool) -> dict[str, float | str] | None:
    """Time the naive kernel in Triton and say where it ran; None if Triton is not installed."""
    if importlib.util.find_spec("triton") is None:
        return None
    from ladder.naive_triton import DEVICE, naive_triton, where

    size, count = (TRITON_SIZE, TRITON_COUNT) if DEVICE == "cpu" else (SIZE, 10_000)
    if smoke:
        size, count = 16, 10
    _, _, seconds = naive_triton(scene(count, size))
    return {"rung": "naive_triton", "where": where(), "splats": count, "size": size, "ms": 1e3 * seconds}


def main() -> int:
    """Measure, print the table, write the JSON."""
    arguments = hardware.parser("The ladder: naive to fast, forward.").parse_args()
    size, counts, rounds = (32, (10, 40), 1) if arguments.smoke else (SIZE, COUNTS, 7)
    try:
        rows = [row for count in counts for row in measure(count, size, rounds)]
    except BackendUnavailableError as error:
        print(error, file=sys.stderr)
        return 1
    triton = triton_row(arguments.smoke)
    hardware.report({"threads": 1, "rows": rows, "triton": triton}, arguments.out)
    print(f"one thread, {size} x {size} px; the package counts its pairs only")
    print("  splats rung           ms  ns/px-splat    times     pairs    evaluated     mattered")
    for row in rows:
        print(
            "{splats:8d} {rung:8} {ms:10.3f} {ns_per_pixel_splat:12.4f} {times_faster:8.0f}"
            " {pairs:9d} {evaluated:12d} {mattered:12d}".format(**row)
        )
    if triton:
        print("naive in Triton: {where}; {splats} splats, {size} px: {ms:.1f} ms".format(**triton))
    return 0


if __name__ == "__main__":
    sys.exit(main())
