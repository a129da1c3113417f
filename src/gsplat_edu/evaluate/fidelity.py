"""Compare a written scene with its source: render both from the same cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from gsplat_edu.evaluate.metrics import ImageScore, Renderer, score_image
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians


def compare_scenes(
    source: Gaussians,
    written: Gaussians,
    cameras: Sequence[tuple[str, Camera]],
    render: Renderer,
    on_score: Callable[[ImageScore], None] | None = None,
) -> list[ImageScore]:
    """Render two scenes from the same cameras and score the second against the first.

    Args:
        source: The scene before writing.
        written: The scene read back from the file.
        cameras: Name and camera of each comparison.
        render: Renders Gaussians from a camera.
        on_score: Called with each score.

    Returns:
        A score per camera; both images clamped to 0..1. Equal images have 100 dB.
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
