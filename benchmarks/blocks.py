"""How do blocks change quality, memory and time, compared with one training of the whole capture?

    python benchmarks/blocks.py [CAPTURE] [--photos N] [--width PX] [--blocks N] [--iterations N] [--gaussians N]
                                [--keep FOLDER] [--smoke] [--out FILE.json]

Without CAPTURE, writes a procedural city (lab/captures/city.py) from the air. The capture is trained as a whole,
and in blocks. The coarse model takes `COARSE` of the iterations. The blocks share the others: each photo is visited
equally often in each of its blocks, and so often that as many pixels count in total as in the training of the whole.
(A photo that shows two cells is visited in both blocks, where the other cell's pixels neither count nor are drawn.)
Every eighth photo is held out. The strips lie along the cuts. The depth of the merged scene determines their pixels,
for both scenes, and their PSNR is that of all these pixels together. Other options go to all trainings.

Each command runs in a process of its own, whose processor time and peak memory are measured. The overhead is the
processor time of splitting (without the coarse training), of merging and writing, and of a local Dask cluster of two
workers whose tasks find their blocks finished, as a fraction of that of the coarse training and the blocks.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import hardware
import numpy as np

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.blocks.cluster import ClusterOptions, run_on_cluster
from gsplat_edu.blocks.merge import finished_blocks, merged
from gsplat_edu.blocks.plan import BlockPlan
from gsplat_edu.blocks.seams import pooled_psnr, strip_masks, strip_width
from gsplat_edu.blocks.split import SplitOptions, coarse_scene, split_capture
from gsplat_edu.blocks.task import block_options, pixels_of_block
from gsplat_edu.cli.running import run_command
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.evaluate.images import save_png, side_by_side
from gsplat_edu.evaluate.metrics import to_bytes
from gsplat_edu.io.ply import save_ply
from gsplat_edu.render.api import render
from gsplat_edu.runs.blocks_folder import BlocksFolder
from gsplat_edu.runs.dataset import run_dataset
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.source import open_source
from lab.captures.city import City, write_city

COMMAND = "import sys; from gsplat_edu.cli.main import main; sys.exit(main())"

CLUSTER = "import sys; sys.path.insert(0, sys.argv[1]); import blocks; blocks.schedule(sys.argv[2], int(sys.argv[3]))"

COARSE = 0.04
"""Fraction of all iterations for the coarse model."""


def measured(*words: object, code: str = COMMAND) -> tuple[float, float]:
    """Run a command in a process of its own; return its processor time, s, and its peak memory, MiB.

    Raises:
        ArgumentError: it failed.
    """
    process = subprocess.Popen([sys.executable, "-c", code, *map(str, words)], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise ArgumentError(f"{' '.join(map(str, words))}: ended with {process.returncode}; see above")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def schedule(folder: str, count: int) -> None:
    """Run the tasks of finished blocks on a local cluster of two workers."""
    run_on_cluster(Path(folder), range(count), ClusterOptions(workers=2))


def compared(whole: Path, merged: Path, pictures: Path | None) -> dict[str, Any]:
    """Return the scores of both scenes on the held-out views, over all pixels and along the cuts."""
    plan = BlockPlan.read(merged)
    dataset = run_dataset(RunFolder(merged).read_config())
    scenes = {"unsplit": open_source(whole), "blocks": open_source(merged)}
    settings = replace(scenes["blocks"].settings, depth=True)
    renderer = functools.partial(render, settings=settings, backend="cpu")
    cameras = [view.camera for view in dataset.test]
    masks = strip_masks(plan.area, plan.cores, scenes["blocks"].scene.gaussians, cameras, renderer)
    found: dict[str, Any] = {
        "strip width": 2 * strip_width(plan.area, plan.cores),
        "share of the strips": float(sum(mask.mean() for mask in masks) / len(masks)),
    }
    for name, folder in (("unsplit", whole), ("blocks", merged)):
        gaussians = scenes[name].scene.gaussians
        strips, rest = pooled_psnr(gaussians, dataset.test, masks, renderer, settings.background)
        metrics = RunFolder(folder).read_metrics()
        found[name] = {
            "PSNR": metrics["test"]["psnr"],
            "SSIM": metrics["test"]["ssim"],
            "PSNR along the cuts": strips,
            "PSNR elsewhere": rest,
            "Gaussians": metrics["num_gaussians"],
        }
    if pictures is not None:
        at = max(range(len(masks)), key=lambda i: float(masks[i].mean()))
        images = [to_bytes(renderer(scene.scene.gaussians, cameras[at]).image) for scene in scenes.values()]
        photo = to_bytes(dataset.test[at].image)
        strips = photo // 2 + 70 * masks[at][..., None].astype(np.uint8)
        save_png(pictures, side_by_side([*images, photo, strips]))
    return found


def measure(data: Path, folder: Path, given: Any) -> dict[str, Any]:  # noqa: ANN401
    """Train a capture as a whole and in blocks, and compare them."""
    coarse = round(COARSE * given.iterations)
    each = (given.iterations - coarse) // given.blocks
    recipe = [
        "--strategy",
        "fast",
        "--max-gaussians",
        given.gaussians,
        "--appearance",
        "none",
        "--sky",
        "none",
    ]
    recipe += ["--eval-every", given.iterations, "--save-every", "0", *given.words]
    whole, parts = folder / "whole", BlocksFolder(folder / "blocks")
    costs = {}
    if not (whole / "report.html").is_file():
        words = ["train", data, "--out", whole, "--iterations", given.iterations, *recipe]
        costs["unsplit"] = measured(*words)
    words = ["--blocks", given.blocks, "--iterations", max(each, 1), "--coarse-iterations", coarse]
    words += ["--min-views", given.min_views, *recipe]
    costs["coarse and split"] = measured("train", data, "--out", parts.path, "--until", "split", *words)
    plan, counted = shared_visits(parts, given.iterations - coarse)
    found = len(plan.blocks)
    for number in range(found):
        costs[f"block {number}"] = measured("block", parts.path, number)
    if not given.smoke:
        here = str(Path(__file__).resolve().parent)
        costs["cluster"] = measured(here, parts.path, found, code=CLUSTER)
    costs["merge and score"] = measured("merge", parts.path)
    seconds = {name: cost[0] for name, cost in costs.items()}
    seconds |= overheads(parts, SplitOptions(given.blocks, given.min_views))
    trained = (
        sum(seconds[name] for name in seconds if name.startswith(("block", "coarse"))) - seconds["splitting"]
    )
    return {
        "photos": sum(len(part) for part in _views(plan)),
        "iterations": {
            "unsplit": given.iterations,
            "coarse": coarse,
            "blocks": [block.iterations for block in plan.blocks],
        },
        "share of the pixels that counts": counted,
        "training views": [len(block.train) for block in plan.blocks],
        "processor seconds": seconds,
        "largest memory (MiB)": {name: cost[1] for name, cost in costs.items()},
        "overhead": (seconds["splitting"] + seconds["merging"] + seconds.get("cluster", 0.0)) / trained,
        "scores": compared(whole, parts.path, folder / "seam.png"),
    }


def shared_visits(parts: BlocksFolder, iterations: int) -> tuple[BlockPlan, list[float]]:
    """Give each block its length, so that the pixels that count are those of so many whole photos in all.

    Returns:
        The changed plan, and by block the share of its photos' pixels that counts.
    """
    plan, shares = BlockPlan.read(parts.path), []
    for number in range(len(plan.blocks)):
        options = block_options(parts, plan, number)
        dataset = load_dataset(options.data, options.data_settings)
        counted = pixels_of_block(parts, plan, number, options)
        shares.append(float(np.mean([counted.mask(view.camera).mean() for view in dataset.train])))
    visits = iterations / sum(
        share * len(block.train) for share, block in zip(shares, plan.blocks, strict=True)
    )
    lengths = [max(round(visits * len(block.train)), 1) for block in plan.blocks]
    changed = replace(
        plan,
        blocks=tuple(
            replace(block, iterations=length) for block, length in zip(plan.blocks, lengths, strict=True)
        ),
    )
    changed.write(parts.path)
    return changed, shares


def overheads(parts: BlocksFolder, split: SplitOptions) -> dict[str, float]:
    """Split and merge once more in this process; return the processor time of each, s, without the start of Python."""
    plan = BlockPlan.read(parts.path)
    one = block_options(parts, plan, 0)
    settings = replace(one.data_settings, train_views=None, test_views=())
    config = one.config.changed(max_gaussians=plan.recipe["train"]["max_gaussians"])
    with tempfile.TemporaryDirectory() as scratch:
        options = replace(
            one, out=Path(scratch), data_settings=settings, config=config, scene=None, resume=False
        )
        began = time.process_time()
        split_capture(options, coarse_scene(replace(options, out=parts.path)), split, lambda sentence: None)
        between = time.process_time()
        gaussians, _ = merged(parts, plan, finished_blocks(parts, plan))
        save_ply(Path(scratch) / "scene.ply", gaussians, plan.origin)
        return {"splitting": between - began, "merging": time.process_time() - between}


def _views(plan: BlockPlan) -> tuple[set[str], set[str]]:
    return (
        {name for block in plan.blocks for name in block.train},
        {name for block in plan.blocks for name in block.test},
    )


def main() -> int:
    """Read the command line and measure."""
    parser = hardware.parser("Blocks against one training of the whole: quality, memory and time.")
    parser.add_argument("capture", nargs="?", type=Path, help="capture (default: a procedural city)")
    for name, default, text in (
        ("photos", 1_500, "photos of the city"),
        ("width", 192, "their width, px"),
        ("blocks", 4, "number of blocks"),
        ("iterations", 30_000, "iterations in total"),
        ("gaussians", 150_000, "cap on the Gaussians of the whole scene"),
        ("min-views", 20, "fewest training views of a block"),
    ):
        parser.add_argument(f"--{name}", type=int, default=default, help=f"{text} (default: %(default)s)")
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="keep all runs and a picture of a seam here"
    )
    options, options.words = parser.parse_known_args()
    if options.smoke:
        options.capture, options.photos, options.width, options.gaussians = None, 32, 32, 2_000
        options.blocks, options.iterations, options.min_views = 2, 80, 4
        options.words = ["--set", "min_opacity=0.005"]

    def run() -> None:
        with tempfile.TemporaryDirectory() as scratch:
            folder = options.keep or Path(scratch)
            data = options.capture
            if data is None:
                data = folder / "city"
                write_city(data, City(options.photos, options.width))
            result = measure(data, folder, options)
            for name, value in result.items():
                print(f"{name}: {value}")
            hardware.report(result, options.out)

    return run_command("blocks.py", run, debug=False)


if __name__ == "__main__":
    sys.exit(main())
