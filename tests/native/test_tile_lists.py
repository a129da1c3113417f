"""The lists of tiles, which are found twice for large Gaussians: once to count them, once to write them."""

import numpy as np
import pytest
import torch

from gsplat_edu import _native
from gsplat_edu.ops.lenses import native_camera
from gsplat_edu.scene.camera import Camera
from native.test_boundary import settings

SIZE, AWAY = 512, 1000.0
"""Side of the image, px, and distance, at which a pixel is as wide as a world unit."""


def tile_lists(dtype, columns, shape):
    """Return the lists of all tiles, for copies of a large Gaussian whose means have these columns, px, in order."""
    rng, count = np.random.default_rng(shape), len(columns)
    means = np.tile([0.0, rng.uniform(200, 300), AWAY], (count, 1))
    means[:, 0] = columns
    turn = rng.uniform(0, np.pi / 2)
    rows = {
        "means": means,
        "quats": np.tile([np.cos(turn), 0, 0, np.sin(turn)], (count, 1)),
        "log_scales": np.tile(np.log([rng.uniform(30, 90), rng.uniform(5, 30), 1.0]), (count, 1)),
        "logit_opacities": np.full(count, 2.0),
        "sh0": np.zeros((count, 1, 3)),
        "sh_rest": np.zeros((count, 0, 3)),
    }
    scene = _native.Scene(**{name: torch.tensor(values, dtype=dtype) for name, values in rows.items()})
    camera = Camera(np.eye(3), np.zeros(3), AWAY, AWAY, 0.0, 0.0, SIZE, SIZE)
    bounds = ((-np.inf, np.inf),) * 2
    kind = _native.FrameF32 if dtype == torch.float32 else _native.FrameF64
    frame = kind(
        scene=scene,
        camera=native_camera(camera, bounds, False),
        settings=settings(),
        needed=None,
        threads=1,
    )
    begin = torch.empty((SIZE // 16) ** 2 + 1, dtype=torch.int64)
    ids = torch.empty(frame.num_pairs, dtype=torch.int64)
    frame.tile_lists(begin=begin, ids=ids)
    assert begin[0] == 0 and begin[-1] == len(ids)
    return [part.numpy() for part in torch.tensor_split(ids, begin[1:-1])]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_large_gaussian_is_written_to_the_tiles_that_it_was_counted_in(isa, dtype):
    """Means lie ever closer to columns at which a Gaussian enters or leaves a tile, down to neighbouring numbers.

    There a rounding decides, and two copies of the search that round differently find different tiles: a place of a
    list would then keep what was in memory before. All depths are equal, so every list has its Gaussians in order.
    """
    step = np.float32 if dtype == torch.float32 else np.float64
    for shape in range(6):
        columns = np.linspace(200, 216, 257)
        for _ in range(6 if dtype == torch.float32 else 14):
            lists = tile_lists(dtype, columns, shape)
            held = np.zeros((len(lists), len(columns)), dtype=bool)
            for tile, ids in enumerate(lists):
                assert ((ids >= 0) & (ids < len(columns))).all() and (np.diff(ids) > 0).all(), tile
                held[tile, ids] = True
            crossed = np.flatnonzero((held[:, 1:] != held[:, :-1]).any(axis=0))
            assert len(crossed) > 5
            fine = [np.linspace(columns[i], columns[i + 1], 9, dtype=step) for i in crossed]
            columns = np.unique(np.concatenate(fine).astype(step)).astype(np.float64)
