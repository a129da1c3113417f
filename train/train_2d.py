"""Fit a picture with 2D splats: chapter 08 with the budget on the command line.

    python train/train_2d.py --image photo.jpg --splats 500 --iters 600 --size 128 --out out/image.png

Writes the picture beside its target, and the curves of loss and PSNR. The work is done in `gsplat_edu.fit2d`; this
script reads the picture and prints the log.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.files import check_writable
from gsplat_edu.base.printing import say
from gsplat_edu.base.validation import whole_number
from gsplat_edu.cli.running import run_command
from gsplat_edu.evaluate.figures import save_figure
from gsplat_edu.evaluate.images import save_png, side_by_side
from gsplat_edu.fit2d.fit import Fit2D, Fit2DSettings, Step2D, fit_2d, shrunk_photo
from gsplat_edu.fit2d.splats import random_splats_2d
from gsplat_edu.options.parser import OneLineParser
from gsplat_edu.options.values import whole_number_text
from gsplat_edu.photos.decoding import decode
from gsplat_edu.scene.photo import Photo

LOG_EVERY = 50

PHOTO = Path(mpl.get_data_path()) / "sample_data" / "grace_hopper.jpg"
"""Portrait of Grace Hopper by the US Navy, in the public domain; matplotlib includes it."""

LARGEST = {"--splats": 100_000, "--iters": 1_000_000, "--size": 4096, "--seed": 2**63 - 1}
"""Upper bounds of the options. Beyond the first three, a fit would take weeks."""

SHOWN = 512
"""Small pictures are enlarged by a whole factor to a longer side of about this, px."""

BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Fit2DOptions:
    """Options of the fit.

    Args:
        image: The picture's file.
        splats: Number of splats.
        iters: Number of steps.
        size: Longer side to which the picture is downscaled, px.
        seed: Seed of the initial splats.
        out: A .png for target and fit side by side; the curves are written beside it.

    Raises:
        ArgumentError: an option is out of range, or `out` is unusable; the message names the flag.
    """

    image: Path
    splats: int
    iters: int
    size: int
    seed: int
    out: Path

    def __post_init__(self) -> None:
        """Check the ranges and the files' names."""
        for flag, largest in LARGEST.items():
            whole_number(flag, getattr(self, flag[2:]), 0 if flag == "--seed" else 1, largest)
        if not self.image.is_file():
            reason = "is a folder" if self.image.is_dir() else "does not exist"
            raise ArgumentError(f"--image: {self.image} {reason}; give an image file")
        if self.out.suffix.lower() != ".png":
            raise ArgumentError(f"--out: {str(self.out)!r} must end in .png; the curves are named after it")
        for path in (self.out, self.curves):
            if path.resolve() == self.image.resolve():
                raise ArgumentError(f"--out: {path} is the picture itself; choose another name")

    @property
    def curves(self) -> Path:
        """The file of the curves."""
        return self.out.with_name(f"{self.out.stem}_curves.png")


def read_target(options: Fit2DOptions) -> np.ndarray:
    """Read the picture, composited over black and downscaled.

    Raises:
        ArgumentError: the file is not an image.
    """
    try:
        pixels, alpha = decode(options.image)
    except DatasetError as error:
        raise ArgumentError(f"--image: {str(error).split(';')[0]}; give another file") from None
    if alpha is not None:
        pixels = np.asarray(Photo(pixels, alpha).over(BLACK))
    return shrunk_photo(pixels, options.size)


def log(step: Step2D) -> None:
    """Print a line every 50 iterations."""
    if step.iteration % LOG_EVERY == 0:
        print(f"iter {step.iteration:4d}  MSE {step.loss:.6f}  PSNR {step.psnr:.2f} dB", flush=True)


def curves_figure_2d(fit: Fit2D) -> Figure:
    """Plot the error, on a logarithmic scale, and the PSNR."""
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    loss_axes, psnr_axes = figure.subplots(1, 2)
    loss_axes.semilogy(fit.losses)
    loss_axes.set(title="loss", xlabel="iteration", ylabel="mean squared error")
    psnr_axes.plot(fit.psnrs)
    psnr_axes.set(title="the same error as PSNR", xlabel="iteration", ylabel="PSNR, dB")
    for axes in (loss_axes, psnr_axes):
        axes.grid(alpha=0.3)
    return figure


def train(options: Fit2DOptions) -> None:
    """Fit the picture and write the two files."""
    target = read_target(options)
    for path in (options.out, options.curves):
        check_writable("--out", path)
    height, width = target.shape[:2]
    say(f"{options.image.name}: {width}x{height} px, {options.splats} splats")
    start = random_splats_2d(options.splats, height, width, np.random.default_rng(options.seed))
    began = time.perf_counter()
    fit = fit_2d(target, start, Fit2DSettings(options.iters), [log])
    seconds = time.perf_counter() - began
    enlarged = max(1, SHOWN // max(height, width))
    pair = (image.repeat(enlarged, axis=0).repeat(enlarged, axis=1) for image in (target, fit.image))
    save_png(options.out, side_by_side(list(pair)))
    save_figure(options.curves, curves_figure_2d(fit))
    per_iteration = f"{1e3 * seconds / options.iters:.1f} ms/iter"
    print(f"{options.iters} iters in {seconds:.1f} s -> {per_iteration}")
    print(f"PSNR: start {fit.psnrs[0]:.2f} -> end {fit.psnrs[-1]:.2f} dB")
    say(f"wrote {options.out}, {options.curves}")


def build_parser() -> OneLineParser:
    """Build the parser of the command line."""
    parser = OneLineParser(
        prog="train_2d.py",
        description="Fit a picture with 2D splats, every gradient written by hand in NumPy.",
        epilog="example: python train/train_2d.py --splats 100 --iters 100 --size 64 --out out/quick.png",
    )
    parser.add_argument(
        "--image",
        type=Path,
        metavar="FILE",
        default=PHOTO,
        help="picture to fit (default: the portrait of Grace Hopper that comes with matplotlib)",
    )
    for flag, default, text in (
        ("--splats", 500, "number of splats"),
        ("--iters", 600, "iterations"),
        ("--size", 128, "longer side to which the picture is downscaled, px"),
        ("--seed", 8, "seed of the initial splats"),
    ):
        number = f"{text} (default: {default})"
        parser.add_argument(flag, type=whole_number_text, metavar="N", default=default, help=number)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="X.png",
        default=Path("out/image.png"),
        help="figure to write, picture beside fit; X_curves.png is written beside it (default: %(default)s)",
    )
    parser.add_argument("--debug", action="store_true", help="print the traceback of an error")
    return parser


def main(given: list[str] | None = None) -> int:
    """Read the command line and fit.

    Args:
        given: The arguments; those of the process if None.
    """
    options = vars(build_parser().parse_args(given))
    debug = options.pop("debug")
    return run_command("train_2d.py", lambda: train(Fit2DOptions(**options)), debug)


if __name__ == "__main__":
    sys.exit(main())
