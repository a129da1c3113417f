"""What does a training iteration of a real capture cost, stage by stage?

    python benchmarks/train_step.py [CAPTURE] [--out FILE.json]

CAPTURE is a folder with images/ and a COLMAP model in sparse/0 whose cameras are PINHOLE (default: snowmiku97 in
$GSPLAT_EDU_DATA or ../shared/data). Gaussians start at the model's points: SH degree 3, opacity 0.1, scales by the
mean distance to three neighbours. One iteration: render at full size, 0.8 L1 + 0.2 (1 - SSIM) against the uint8
photo, backward, Adam. Medians over 20 views.
"""

from __future__ import annotations

import os
import statistics
import struct
import time
from pathlib import Path

import hardware
import numpy as np
import torch
from matplotlib.image import imread

from gsplat_edu import C0, Camera, quat_to_R
from gsplat_edu.gaussians import Gaussians
from gsplat_edu.losses import l1_ssim
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.train.optimizer import Adam

STAGES = ("project", "sort", "intersect", "composite", "composite_backward", "project_backward")
RATES = {
    "means": 1.6e-4,
    "quats": 1e-3,
    "log_scales": 5e-3,
    "sh0": 2.5e-3,
    "sh_rest": 1.25e-4,
    "logit_opacities": 5e-2,
}
PINHOLE = 1


class Reader:
    """Little-endian numbers from a COLMAP file."""

    def __init__(self, path: Path) -> None:
        self.data, self.at = path.read_bytes(), 0

    def take(self, layout: str) -> tuple[float, ...]:
        """Read numbers by struct's letters."""
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += struct.calcsize("<" + layout)
        return values

    def skip(self, size: int) -> None:
        """Leave bytes out."""
        self.at += size

    def word(self) -> str:
        """Read up to a zero byte."""
        end = self.data.index(b"\0", self.at)
        text, self.at = self.data[self.at : end].decode(), end + 1
        return text


def read_cameras(model: Path) -> list[tuple[str, Camera]]:
    """Read names and cameras; COLMAP puts the centre of the first pixel at (0.5, 0.5), we put it at (0, 0)."""
    file, intrinsics = Reader(model / "cameras.bin"), {}
    for _ in range(file.take("Q")[0]):
        identity, kind, W, H = file.take("IiQQ")
        if kind != PINHOLE:
            raise SystemExit(f"{model}: camera {identity} is not PINHOLE; this benchmark takes no other")
        intrinsics[identity] = (*file.take("4d"), H, W)
    file, cameras = Reader(model / "images.bin"), []
    for _ in range(file.take("Q")[0]):
        _, *pose = file.take("I7d")
        fx, fy, cx, cy, H, W = intrinsics[file.take("I")[0]]
        name = file.word()
        file.skip(24 * file.take("Q")[0])
        R = quat_to_R(pose[:4])
        cameras.append((name, Camera(R, -R.T @ np.array(pose[4:]), fx, fy, cx - 0.5, cy - 0.5, H, W)))
    return cameras


def read_points(model: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions, and colours from 0 to 1."""
    file, rows = Reader(model / "points3D.bin"), []
    for _ in range(file.take("Q")[0]):
        _, *row = file.take("Q3d3B")
        rows.append(row)
        _, track = file.take("dQ")
        file.skip(8 * track)
    table = np.array(rows)
    return table[:, :3], table[:, 3:] / 255.0


def start(points: np.ndarray, colors: np.ndarray) -> Gaussians:
    """Put a Gaussian on every point."""
    means = torch.tensor(points, dtype=torch.float32)
    nearest = torch.cat(
        [torch.cdist(part, means).topk(4, largest=False).values[:, 1:] for part in means.split(1024)]
    )
    scales = nearest.square().mean(dim=1).sqrt().clamp(min=1e-7)
    count = len(means)
    return Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=scales.log()[:, None].repeat(1, 3),
        sh0=torch.tensor((colors - 0.5) / C0, dtype=torch.float32)[:, None],
        sh_rest=torch.zeros(count, 15, 3),
        logit_opacities=torch.full((count,), -2.1972246),
    ).trainable()


def measure(folder: Path, views: int = 20) -> dict[str, list[float]]:
    """Take an iteration at each of the views; return the milliseconds of every stage."""
    model = folder / "sparse" / "0"
    cameras = sorted(read_cameras(model))
    gaussians = start(*read_points(model))
    optimizer, settings = Adam(gaussians, RATES, eps=1e-15), RenderSettings(depth=False)
    found: dict[str, list[float]] = {
        name: [] for name in (*STAGES, "loss", "Adam", "rest", "iteration", "pairs")
    }
    for k in range(views + 3):
        name, camera = cameras[k * len(cameras) // (views + 3)]
        photo = torch.tensor(imread(folder / "images" / Path(name).name))
        t0 = time.perf_counter()
        output = render(gaussians, camera, settings=settings, backend="cpu")
        frame, t1 = output.image.grad_fn.frame, time.perf_counter()
        loss = l1_ssim(output.image, photo)
        t2 = time.perf_counter()
        loss.backward()
        t3 = time.perf_counter()
        optimizer.step(gaussians)
        t4 = time.perf_counter()
        if k < 3:
            continue
        for stage, seconds in zip(STAGES, frame.seconds, strict=True):
            found[stage].append(1e3 * seconds)
        named = sum(frame.seconds) + (t2 - t1) + (t4 - t3)
        for stage, seconds in (
            ("loss", t2 - t1),
            ("Adam", t4 - t3),
            ("rest", t4 - t0 - named),
            ("iteration", t4 - t0),
        ):
            found[stage].append(1e3 * seconds)
        found["pairs"].append(output.num_pairs or 0)
    return found


def main() -> None:
    """Measure, print the table, write the JSON."""
    made = hardware.parser("A training iteration of a capture, stage by stage.")
    data = Path(os.environ.get("GSPLAT_EDU_DATA", "../shared/data"))
    made.add_argument("capture", nargs="?", type=Path, default=data / "snowmiku97")
    arguments = made.parse_args()
    if not (arguments.capture / "sparse" / "0" / "points3D.bin").exists():
        raise SystemExit(
            f"train_step.py: {arguments.capture} holds no COLMAP model in sparse/0; name another folder"
        )
    medians = {name: statistics.median(values) for name, values in measure(arguments.capture).items()}
    hardware.report({"capture": arguments.capture.name, "medians": medians}, arguments.out)
    raster = medians["composite"] + medians["composite_backward"]
    for name, value in medians.items():
        print(
            f"{name:20} {value:12.2f}"
            + ("" if name == "pairs" else f" ms {100 * value / medians['iteration']:6.1f} %")
        )
    print(f"outside composite and composite_backward: {100 * (1 - raster / medians['iteration']):.1f} %")


if __name__ == "__main__":
    main()
