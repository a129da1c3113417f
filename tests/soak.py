"""Train for a few hundred iterations and print the resident memory after each as JSON, for train/test_memory.py.

    python soak.py CASE FOLDER

It runs in its own process, because memory that other tests left in the heap could hide or imitate growth.
"""

import json
import os
import sys
from pathlib import Path

import numpy as np

from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.render.backends import load_backend
from gsplat_edu.scene.rig import orbit_camera
from gsplat_edu.scene.views import View
from gsplat_edu.train.compose import Start, training
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.events import StepEvent
from gsplat_edu.train.initialize import from_points

ITERATIONS = 240
SIZES = {"one": [(320, 240)], "mixed": [(320, 240), (240, 320), (304, 304), (360, 200)]}
"""(W, H) of the photos, in rotation."""

CASES = {
    # name: sizes of the photos, masks, kept in memory, random background, strategy
    "RGBA on white, adc": ("one", False, True, False, "adc"),
    "RGBA and masks of mixed sizes, read again, mcmc": ("mixed", True, False, False, "mcmc"),
    "RGBA over random colours, read again, adc": ("mixed", False, False, True, "adc"),
}


def views(sizes, masked):
    """Make photos of a soft disc with transparent surroundings."""
    rng = np.random.default_rng(0)
    for i in range(12):
        W, H = SIZES[sizes][i % len(SIZES[sizes])]
        camera = orbit_camera(0.5 * i, 0.2, min(W, H), 1.2 * min(W, H), 3.0)
        camera = type(camera)(camera.R, camera.eye, camera.fx, camera.fy, W / 2, H / 2, H, W)
        v, u = np.mgrid[:H, :W]
        away = np.hypot(u - W / 2, v - H / 2) / (0.4 * min(W, H))
        image = 128 + 100 * np.sin(u[..., None] / (9, 14, 23) + i) + rng.normal(size=(H, W, 3))
        alpha = (255 * np.clip(4 * (1.1 - away), 0, 1)).astype(np.uint8)
        mask = away < 1.3 if masked else None
        yield View(camera, image.astype(np.uint8), alpha=alpha, mask=mask, name=f"{i:02d}.png")


def main(case, folder):
    sizes, masked, kept, any_color, strategy = CASES[case]
    points = np.random.default_rng(1).uniform(-0.6, 0.6, (400, 3))
    write_transforms(folder, list(views(sizes, masked)), points, 0.5 + 0.5 * points)
    settings = DataSettings(
        test_every=0, background=None if any_color else (1.0, 1.0, 1.0), image_memory=2**30 if kept else 0
    )
    dataset = load_dataset(folder, settings)
    dataset.preload()
    config = TrainConfig().changed(
        iterations=ITERATIONS,
        strategy=strategy,
        background=(1.0, 1.0, 1.0),
        random_background=any_color,
        max_gaussians=600,
        densify_start=20,
        densify_every=40,
        densify_stop=200,
        mcmc_stop=200,
        reset_every=100,
    )
    start = from_points(dataset.points, dataset.colors, config)
    resident, page = [], os.sysconf("SC_PAGE_SIZE")

    def measure(trainer, event):
        if isinstance(event, StepEvent):
            resident.append(int(Path("/proc/self/statm").read_text().split()[1]) * page)

    begin = Start(start, extent=1.0)
    training(config, dataset, load_backend("cpu"), begin, callbacks=[measure]).run()
    print(json.dumps(resident))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
