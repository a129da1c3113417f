"""Pairs of pixels and Gaussians against gsplat's rules, applied one by one, and their compositing."""

import math

import pytest
import torch

import gsplat_witness
from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.compat import gsplat as ours

W, H, TILE = 23, 18, 4
GRID = math.ceil(W / TILE), math.ceil(H / TILE)


def screen(count=60, opaque=False):
    """Projected Gaussians in two images, and their lists of tiles; opaque ones end many pixels."""
    tensors = {name: t.detach() for name, t in gsplat_witness.scene(count=count).items()}
    given = (tensors["means"], None, tensors["quats"], tensors["scales"] * (3 if opaque else 1))
    radii, means2d, depths, conics, _ = ours.fully_fused_projection(
        *given, tensors["viewmats"], tensors["Ks"], W, H
    )
    opacities = tensors["opacities"].repeat(2, 1)
    opacities = 0.9 + 0.1 * opacities if opaque else opacities
    _, ids, rows = ours.isect_tiles(means2d, radii, depths, TILE, *GRID)
    offsets = ours.isect_offset_encode(ids, 2, *GRID)
    return means2d, conics, opacities, offsets, rows


def contributions(means2d, conics, opacities, offsets, rows):
    """gsplat's loop over the list of each pixel: a dictionary of (Gaussian, weight), and transmittances."""
    N, starts, found, left = means2d.shape[1], [*offsets.flatten().tolist(), len(rows)], {}, {}
    for image in range(2):
        for pixel in range(W * H):
            y, x = divmod(pixel, W)
            tile = (image * GRID[1] + y // TILE) * GRID[0] + x // TILE
            T, own = 1.0, []
            for g in rows[starts[tile] : starts[tile + 1]].tolist():
                u, v = means2d[image, g % N].tolist()
                A, B, C = conics[image, g % N].tolist()
                dx, dy = x + 0.5 - u, y + 0.5 - v
                alpha = min(
                    0.999,
                    float(opacities[image, g % N])
                    * math.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy),
                )
                if alpha < 1 / 255:
                    continue
                if T * (1 - alpha) <= 1e-4:
                    break
                own.append((g % N, alpha * T))
                T *= 1 - alpha
            found[image, pixel], left[image, pixel] = own, T
    return found, left


@pytest.mark.parametrize("opaque", [False, True])
def test_contributors_are_those_of_gsplats_rules(opaque):
    """Products of at most 60 factors: 1e-13 is above 60 roundings."""
    given = screen(opaque=opaque)
    wanted, left = contributions(*given)
    assert any(T < 1e-3 for T in left.values()) is opaque
    size = (W, H, TILE)
    gaussians, pixels, images = ours.rasterize_to_indices_in_range(
        0, 1000, torch.ones(2, H, W, dtype=torch.float64), *given[:3], *size, *given[3:]
    )
    pairs = [(image, pixel, g) for (image, pixel), own in wanted.items() for g, _ in own]
    assert list(zip(images.tolist(), pixels.tolist(), gaussians.tolist(), strict=True)) == pairs
    counts, alphas = ours.rasterize_num_contributing_gaussians(*given, *size)
    assert counts.dtype == torch.int32 and counts.flatten().tolist() == [len(own) for own in wanted.values()]
    torch.testing.assert_close(
        1 - alphas.flatten(), torch.tensor(list(left.values()), dtype=torch.float64), rtol=0, atol=1e-13
    )
    ids, weights = ours.rasterize_contributing_gaussian_ids(*given, *size, counts)
    top, strongest = ours.rasterize_top_contributing_gaussian_ids(*given, *size, 3)
    K = int(counts.max())
    assert ids.shape == weights.shape == (2, H, W, K) and K > 3 and ids.dtype == torch.int32
    for (image, pixel), own in wanted.items():
        y, x = divmod(pixel, W)
        best = sorted(sorted(range(len(own)), key=lambda k, own=own: -own[k][1])[:3])
        for mine, shares, pairs in (
            (ids[image, y, x], weights[image, y, x], own),
            (top[image, y, x], strongest[image, y, x], [own[k] for k in best]),
        ):
            n = len(pairs)
            assert mine.tolist() == [g for g, _ in pairs] + [-1] * (len(mine) - n)
            assert all(abs(float(s) - w) < 1e-13 for s, (_, w) in zip(shares, pairs, strict=False))
            assert not bool(shares[n:].any())


def test_packed_inputs_name_rows():
    means2d, conics, opacities, offsets, rows = screen()
    flat = [t.flatten(0, 1) for t in (means2d, conics, opacities)]
    plain = ours.rasterize_top_contributing_gaussian_ids(
        means2d, conics, opacities, offsets, rows, W, H, TILE, 2
    )
    packed = ours.rasterize_top_contributing_gaussian_ids(*flat, offsets, rows, W, H, TILE, 2)
    shift = torch.tensor([0, means2d.shape[1]]).view(2, 1, 1, 1)
    assert torch.equal(packed[0], torch.where(plain[0] < 0, plain[0], plain[0] + shift.int()))
    assert torch.equal(packed[1], plain[1])


def test_accumulate_in_ranges_is_rasterize_to_pixels():
    """In batches, as gsplat's torch rasteriser does it: values and gradients to 1e-9, as in test_gsplat_pinhole.py."""
    # No pixel ends, because the next batch would not know it.
    means2d, conics, opacities, offsets, rows = screen(count=300)
    colors = torch.randn(2, 300, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    splats = [means2d, conics, 0.1 * opacities, colors]
    splats = [t.requires_grad_() for t in splats]
    means2d, conics, opacities, colors = splats
    image, alpha = torch.zeros(2, H, W, 4, dtype=torch.float64), torch.zeros(2, H, W, 1, dtype=torch.float64)
    steps = 0
    for step in range(100):
        T = 1.0 - alpha
        ids = ours.rasterize_to_indices_in_range(
            step, step + 1, T[..., 0], means2d, conics, opacities, W, H, TILE, offsets, rows
        )
        if not len(ids[0]):
            break
        shown, opaque = ours.accumulate(means2d, conics, opacities, colors, *ids, W, H)
        image, alpha, steps = image + T * shown, alpha + T * opaque, steps + 1
    assert steps >= 3 and float(alpha.detach().max()) < 0.999
    wanted = ours.rasterize_to_pixels(means2d, conics, colors, opacities, W, H, TILE, offsets, rows)
    g = torch.Generator().manual_seed(2)
    weights = [torch.randn(t.shape, generator=g, dtype=torch.float64) for t in wanted]
    gradients = []
    for pair in ((image, alpha), wanted):
        loss = sum((w * t).sum() for w, t in zip(weights, pair, strict=True))
        gradients.append(torch.autograd.grad(loss, splats))
    for one, other in zip((image, alpha, *gradients[0]), (*wanted, *gradients[1]), strict=True):
        assert float(other.detach().abs().max()) > 0
        assert float((one - other).detach().abs().max()) <= 1e-9 * max(1.0, float(other.detach().abs().max()))


def test_accumulate_of_no_pair_is_empty():
    means2d, conics, opacities, _, _ = screen()
    none = torch.zeros(0, dtype=torch.int64)
    image, alpha = ours.accumulate(means2d, conics, opacities, means2d, none, none, none, W, H)
    assert image.shape == (2, H, W, 2) and not bool(image.any()) and not bool(alpha.any())


def test_wrong_arguments_are_named():
    given = screen()
    with pytest.raises(ShapeError, match="^opacities: "):
        ours.rasterize_num_contributing_gaussians(given[0], given[1], given[2][:1], *given[3:], W, H, TILE)
    with pytest.raises(ShapeError, match="^tile_offsets: has"):
        ours.rasterize_num_contributing_gaussians(*given[:3], given[3][:1], given[4], W, H, TILE)
    with pytest.raises(ShapeError, match="^num_contributing_gaussians: has shape"):
        ours.rasterize_contributing_gaussian_ids(*given, W, H, TILE, torch.ones(2, 3, dtype=torch.int32))
    with pytest.raises(ArgumentError, match="^num_depth_samples: "):
        ours.rasterize_top_contributing_gaussian_ids(*given, W, H, TILE, 0)
    with pytest.raises(ArgumentError, match="^pixel_ids: has to be from 0"):
        ours.accumulate(*given[:3], given[0], *(torch.full((1,), k) for k in (0, W * H, 0)), W, H)
