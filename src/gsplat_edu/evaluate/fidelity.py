"""Whether a written scene still shows what was trained: the same cameras, both scenes, side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from gsplat_edu.camera import Camera
from gsplat_edu.evaluate.metrics import ImageScore, Renderer, score_image
from gsplat_edu.gaussians import Gaussians


def compare_scenes(
    source: Gaussians,
    written: Gaussians,
    cameras: Sequence[tuple[str, Camera]],
    render: Renderer,
    on_score: Callable[[ImageScore], None] | None = None,
) -> list[ImageScore]:
    """Render two scenes from the same cameras and score the second against the first.

    Args:
        source: What was to be written.
        written: What was read back.
        cameras: Name and camera of each comparison.
        render: Renders Gaussians from a camera.
        on_score: Is told of every score.

    Returns:
        A score per camera; both images clamped to 0..1. Equal ones have 100 dB.
    """
    scores = []
    for name, camera in cameras:
        with torch.no_grad():
            truth, image = (render(gaussians, camera).image for gaussians in (source, written))
        score = score_image(name, image, truth.clamp(0.0, 1.0))
        scores.append(score)
        if on_score is not None:
            on_score(score)
    return scores
