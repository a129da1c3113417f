"""Do two compilers give the native module the same speed and the same bits?

    python benchmarks/compilers.py FOLDER [FOLDER] [--capture CAPTURE] [--smoke] [--out FILE.json]

A FOLDER has a compiled module; for an unpacked wheel, it is WHEEL/gsplat_edu. The installed module is the default.
Each module runs in a process of its own with one thread. The processes take turns with the same training iterations
of a capture (as in train_step.py: render, 0.8 L1 + 0.2 (1 - SSIM), backward with Adam inside). The processor time of
a turn is measured, so other work on the machine hardly matters. The benchmark prints the median and the extremes over
the turns of the ratio of the two times, and the hashes of an image and of its gradients.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

TURNS, VIEWS = 12, 4


def load(folder: Path) -> None:
    """Use a module in place of the installed one."""
    (built,) = (path for path in folder.glob("_native*") if path.suffix in (".so", ".pyd"))
    spec = importlib.util.spec_from_file_location("gsplat_edu._native", built)
    assert spec is not None
    assert spec.loader is not None
    sys.modules["gsplat_edu._native"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["gsplat_edu._native"])


def serve(module: Path, capture: Path, views: int) -> None:
    """Print the hashes; then, for each line of input, train on some views and print the processor time, s."""
    load(module)
    import torch

    from gsplat_edu.base.buffers import reused_buffers
    from gsplat_edu.data.dataset import load_dataset
    from gsplat_edu.ops.losses import photo_loss
    from gsplat_edu.render.api import render
    from gsplat_edu.render.settings import RenderSettings
    from gsplat_edu.train.config import TrainConfig
    from gsplat_edu.train.initialize import from_points
    from gsplat_edu.train.optimizer import Adam, ParameterGroup
    from gsplat_edu.train.schedule import gaussian_groups

    torch.set_num_threads(1)
    dataset, config = load_dataset(capture), TrainConfig()
    dataset.preload()
    gaussians = from_points(dataset.points, dataset.colors, config).trainable()
    groups = gaussian_groups(config, 1.0) | {"means": ParameterGroup(0.0)}
    optimizer = Adam(gaussians.tensors(), groups)
    settings = RenderSettings(depth=False, jacobian_limit=config.jacobian_limit)

    def iteration(number: int, fused: bool) -> torch.Tensor:
        view = dataset.train[number % len(dataset.train)]
        photo = view.read()
        output = render(gaussians, view.camera, settings=settings, backend="cpu")
        in_backward = output.defer() if fused else None
        photo_loss(output.image, torch.from_numpy(photo.image), photo.mask, config.ssim_weight).backward()
        if fused:
            optimizer.step(gaussians.tensors(), in_backward)
        return output.image.detach()

    with reused_buffers():
        image = iteration(0, fused=False)
        kept = {"image": image, **{k: v.grad for k, v in gaussians.tensors().items() if v.grad is not None}}
        hashes = {k: hashlib.sha256(v.numpy().tobytes()).hexdigest()[:16] for k, v in kept.items()}
        for tensor in gaussians.tensors().values():
            tensor.grad = None
        iteration(1, fused=True)  # allocates buffers and touches their pages
        print(json.dumps(hashes), flush=True)
        for number, _ in enumerate(sys.stdin):
            start = time.process_time()
            for k in range(views):
                iteration(2 + number * views + k, fused=True)
            print(time.process_time() - start, flush=True)


def compare(folders: list[Path], capture: Path, turns: int, views: int) -> dict[str, object]:
    """Run two modules in turns; return their hashes, seconds per iteration and the ratio."""
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    programs = []
    for folder in folders:
        words = [sys.executable, __file__, "--serve", str(folder), str(capture), str(views)]
        programs.append(
            subprocess.Popen(words, env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        )

    def answer(program: subprocess.Popen[str]) -> str:
        assert program.stdout is not None
        line = program.stdout.readline()
        if not line:
            raise SystemExit(f"compilers: {program.args} ended early")
        return line

    def turn(program: subprocess.Popen[str]) -> float:
        assert program.stdin is not None
        print("go", file=program.stdin, flush=True)
        return float(answer(program)) / views

    hashes = [json.loads(answer(program)) for program in programs]
    seconds: list[list[float]] = [[], []]
    for number in range(turns):
        for which in (0, 1) if number % 2 == 0 else (1, 0):
            seconds[which].append(turn(programs[which]))
    for program in programs:
        program.communicate()
    ratios = [a / b for a, b in zip(*seconds, strict=True)]
    return {
        "modules": [str(folder) for folder in folders],
        "hashes": hashes,
        "differ": sorted(name for name in hashes[0] if hashes[0][name] != hashes[1][name]),
        "milliseconds": [1e3 * statistics.median(times) for times in seconds],
        "ratio": statistics.median(ratios),
        "ratios": ratios,
    }


def main() -> None:
    """Measure, print and write the JSON."""
    import hardware
    from captures import capture

    from gsplat_edu import _native

    parser = hardware.parser("The native module of two compilers: speed and bits.")
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER")
    parser.add_argument("--capture", type=Path)
    arguments = parser.parse_args()
    installed = Path(_native.__file__).parent
    folders = [*arguments.folders, installed, installed][:2]
    turns, views = (1, 1) if arguments.smoke else (TURNS, VIEWS)
    with capture(arguments.capture, arguments.smoke) as folder:
        found = compare(folders, folder, turns, views)
    hardware.report(found, arguments.out)
    first, second = found["milliseconds"]
    ratios = found["ratios"]
    print(f"processor time of an iteration: {first:.1f} ms and {second:.1f} ms")
    print(f"ratio {found['ratio']:.3f}, {min(ratios):.3f} to {max(ratios):.3f} over {len(ratios)} turns")
    print(f"other bits: {', '.join(found['differ']) or 'none'}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]))
    else:
        main()
