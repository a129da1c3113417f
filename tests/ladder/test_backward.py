"""The backward rungs agree with autograd in float64, and slots give the same bits for any threads and order."""

import numpy as np
import pytest
import torch

from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN, T_STOP, TILE
from ladder import backward, forward, splats

EPS = 2.0**-23  # float32


def weights(cloud):
    """Return random weights g of the loss sum(g * image)."""
    return np.random.default_rng(1).normal(size=(cloud.H, cloud.W, 3)).astype(np.float32)


def dense(cloud, g):
    """Composite in float64 without tiles, boxes or stop; return autograd's gradients and the parts of the bounds."""
    leaves = [torch.tensor(array, dtype=torch.float64, requires_grad=True) for array in cloud[:4]]
    means2d, conics, colors, opacities = leaves
    y, x = torch.meshgrid(torch.arange(cloud.H).double(), torch.arange(cloud.W).double(), indexing="ij")
    dx, dy = x - means2d[:, 0, None, None], y - means2d[:, 1, None, None]
    A, B, C = conics[..., None, None].unbind(1)
    raw = opacities[:, None, None] * torch.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy)
    alphas = torch.where(raw < ALPHA_MIN, 0.0, torch.clamp(raw, max=ALPHA_MAX))
    T = torch.cumprod(torch.cat([torch.ones_like(alphas[:1]), 1 - alphas]), dim=0)
    image = torch.einsum("nhw,nc->hwc", T[:-1] * alphas, colors)
    (image * torch.tensor(g).double()).sum().backward()
    parts = [tensor.detach() for tensor in (raw, alphas, T, dx, dy)]
    return [leaf.grad for leaf in leaves], parts


def bounds(cloud, g, parts):
    """Bound the float32 error by n eps of a pixel's light over 1 - alpha in each h, with a factor of 4.

    Colours are at most 1, so a pixel's R starts at no more than sum_k |g_k| times the light that its n splats take.
    Each of n subtractions loses at most half an eps of that, and dL/dalpha contains R / (1 - alpha). The factor of 4
    covers T and the sums over pixels.
    """
    _, alphas, T, dx, dy = parts
    layers = int((alphas > 0).sum(0).max())
    strength = torch.tensor(np.abs(g)).double().sum(-1)
    light = (T[:-1] * alphas).sum(0) * strength
    h = 4 * layers * EPS * torch.where(alphas > 0, alphas / (1 - alphas) * light, 0.0)

    def moment(factor):
        return (h * factor.abs()).sum((1, 2))

    A, B, C = torch.tensor(cloud.conics).double().abs().unbind(1)
    means = torch.stack(
        [A * moment(dx) + B * moment(dy), B * moment(dx) + C * moment(dy)],
        dim=1,
    )
    conics = torch.stack([moment(dx * dx) / 2, moment(dx * dy), moment(dy * dy) / 2], dim=1)
    # In w g, each weight is a product of at most `layers` factors, and the pixels of its tiles are summed.
    colors = 4 * layers * EPS * (T[:-1] * alphas / (1 - alphas) * strength).sum((1, 2))
    return (
        means,
        conics,
        colors[:, None].expand(-1, 3),
        moment(torch.ones_like(dx)) / torch.tensor(cloud.opacities),
    )


def assert_clear_of_edges(parts):
    """Check that no alpha is so near the floor or the clamp that float32 and float64 are on different sides."""
    raw = parts[0]
    assert all(((raw / edge - 1).abs() > 20 * EPS).all() for edge in (ALPHA_MIN, ALPHA_MAX))


def assert_no_tile_stops(cloud, T):
    """Check that no tile stops, because the reference never does."""
    last = torch.zeros(-(-cloud.H // TILE) * TILE, -(-cloud.W // TILE) * TILE, dtype=torch.float64)
    last[: cloud.H, : cloud.W] = T[-1]
    tiles = last.reshape(last.shape[0] // TILE, TILE, last.shape[1] // TILE, TILE)
    assert tiles.amax((1, 3)).min() > T_STOP


@pytest.mark.parametrize("rung", backward.RUNGS.values(), ids=backward.RUNGS)
@pytest.mark.parametrize("opaque", [False, True])
@pytest.mark.parametrize("threads", [1, 2])
def test_a_rung_agrees_with_autograd(rung, opaque, threads):
    cloud = splats.scene(220, 52, seed=3, stretch=3.0)._replace(W=45)  # tiles are cut on the right and below
    if opaque:  # clamped opacities, behind which light is a difference of nearly equal numbers
        cloud.opacities[::4] = 1.0
    g = weights(cloud)
    reference, parts = dense(cloud, g)
    assert_clear_of_edges(parts)
    assert_no_tile_stops(cloud, parts[2])
    assert bool((parts[1] == ALPHA_MAX).any()) == opaque and (parts[1] == 0).any()
    found = rung(cloud, forward.tight(cloud).image, g, threads)
    for name, mine, theirs, bound in zip(
        found._fields, found, reference, bounds(cloud, g, parts), strict=True
    ):
        error = (torch.tensor(mine).double() - theirs).abs()
        assert (error <= bound).all(), f"{name}: {float((error / bound).max()):.2f} of the bound"
        # A wrong formula would exceed the bound.
        assert (theirs.abs() > 100 * bound).double().mean() > 0.2, name


def test_slots_give_the_same_bits_for_any_threads_and_order():
    cloud = splats.scene(3000, 128, seed=5)
    g, image = weights(cloud), forward.tight(cloud).image
    tiles = np.arange(backward.num_tiles(cloud))
    orders = [tiles, tiles[::-1], np.random.default_rng(0).permutation(tiles)]
    found = {
        backward.slots(cloud, image, g, threads, order).bits() for threads in (1, 2, 3) for order in orders
    }
    assert len(found) == 1


def test_atomic_sums_depend_on_the_order_of_the_tiles():
    """One thread adds the same numbers in two orders, so the test is deterministic."""
    cloud = splats.scene(3000, 128, seed=5)
    g, image = weights(cloud), forward.tight(cloud).image
    tiles = np.arange(backward.num_tiles(cloud))
    found = {backward.atomics(cloud, image, g, 1, order).bits() for order in (tiles, tiles, tiles[::-1])}
    assert len(found) == 2


def test_splats_behind_a_stopped_tile_get_no_gradient():
    """The backward pass ends at the splat at which the forward pass stopped."""
    cloud = splats.scene(40, 16, seed=7)
    wide = np.array([[1e-6, 0.0, 1e-6]] * 40, np.float32)
    cloud = cloud._replace(conics=wide, opacities=np.full(40, 0.9, np.float32))
    g = weights(cloud)
    drawn = forward.tight(cloud)
    assert drawn.transmittance.max() < T_STOP
    for rung in backward.RUNGS.values():
        gradient = rung(cloud, drawn.image, g)
        seen = int(np.count_nonzero(gradient.colors.any(axis=1)))
        assert 4 <= seen <= 6, "the tile stops at 0.1^4"
        assert not gradient.opacities[seen:].any() and not gradient.means2d[seen:].any()


def test_invalid_arguments_are_refused():
    cloud = splats.scene(4, 32)
    g = weights(cloud)
    with pytest.raises(ValueError, match="have to be"):
        backward.slots(cloud, g[:-1], g)
    with pytest.raises(ValueError, match="every tile once"):
        backward.slots(cloud, g, g, order=np.array([0, 0, 1, 2]))
