import pytest
import torch

from gsplat_edu import ArgumentError
from gsplat_edu.ops import kernels

# Not `triton`, which is the name of this folder if the wheel is missing.
pytest.importorskip("triton.language", reason="triton is not installed")

from gsplat_edu.ops.adam import AdamNumbers
from gsplat_edu.render.cuda.adam import adam_triton

U = 2.0**-24
"""Half a unit in the last place of float32: the largest relative error of one rounding."""

RATE, B1, B2, EPS = 5e-3, 0.9, 0.999, 1e-8
STEPS = 20


def numbers(t):
    return AdamNumbers(RATE, B1, B2, EPS, 1 - B1**t, 1 - B2**t)


def gradients(shape, seed=0):
    """Return gradients of very different sizes, some always 0, some comparable to eps. No g² underflows."""
    generator = torch.Generator().manual_seed(seed)
    sizes = 10.0 ** torch.randint(-9, 3, shape, generator=generator)
    sizes[torch.rand(shape, generator=generator) < 0.1] = 0.0
    drawn = [sizes * torch.randn(shape, generator=generator) for _ in range(STEPS)]
    assert all(((g == 0) | (g.abs() > 1e-16)).all() for g in drawn)
    return drawn


def in_float64(start, all_gradients):
    """Return parameter and moments after the steps in float64, and the allowed error of float32 for each.

    |m| is bounded by M, the same mean of |g|. A step rounds each term of m in its factor, its product and the sum (3
    U) and in 1 - b (U), so m is off by 4 U t M after t steps. v is positive and has one more rounding, in g²: it is
    off by 5 U t v. A step has the error of m, half the error of v because of the root, and 8 roundings of factors,
    products, root, sum and quotient. Updating the parameter p rounds once, by U |p|. The bound adds 1/10 for higher
    orders.
    """
    p, m, v, M = start.double(), *torch.zeros(3, *start.shape, dtype=torch.float64)
    e_p = torch.zeros_like(p)
    for t, g in enumerate((g.double() for g in all_gradients), start=1):
        m, v, M = B1 * m + (1 - B1) * g, B2 * v + (1 - B2) * g * g, B1 * M + (1 - B1) * g.abs()
        c1, c2 = 1 - B1**t, 1 - B2**t
        below = (v / c2).sqrt() + EPS
        step = RATE * (m / c1) / below
        p = p - step
        e_p += RATE * (4 * U * t * M / c1) / below + step.abs() * (2.5 * t + 8) * U + U * p.abs()
    return (p, m, v), (1.1 * e_p, 1.1 * 4 * U * STEPS * M, 1.1 * 5 * U * STEPS * v)


def walk(step, start, all_gradients):
    tensors = start, torch.zeros_like(start), torch.zeros_like(start)
    for t, g in enumerate(all_gradients, start=1):
        step(*tensors, g, numbers(t))
    return tensors


def natively(parameter, m, v, gradient, numbers):
    names = ("parameter", "first", "second", "gradient")
    arrays = dict(zip(names, map(kernels.native_array, (parameter, m, v, gradient)), strict=True))
    kernels.kernel("adam_f", parameter.dtype)(**arrays, **numbers._asdict(), threads=1)


@pytest.mark.parametrize("shape", [(1,), (7, 3), (1500, 3), (2, 1024)])
def test_twenty_steps_match_float64(device, shape):
    """The sizes are below one block, above one block, and exactly two blocks."""
    start = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    drawn = gradients(shape)
    ours = walk(adam_triton, start.clone().to(device), [g.to(device) for g in drawn])
    truth, allowed = in_float64(start, drawn)
    assert (allowed[0] < 2e-3 * RATE * STEPS + 30 * U * truth[0].abs()).all()
    for a, b, e in zip(ours, truth, allowed, strict=True):
        assert ((a.cpu().double() - b).abs() <= e).all()
    if kernels.REASON is None:
        for a, b, e in zip(ours, walk(natively, start.clone(), drawn), allowed, strict=True):
            assert ((a.cpu() - b).abs() <= 2 * e).all()


def test_steps_match_torch(device):
    """torch's optimiser in float64 is a second reference."""
    start, drawn = torch.randn(40, generator=torch.Generator().manual_seed(2)), gradients((40,), seed=3)
    theirs = start.double().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=RATE, betas=(B1, B2), eps=EPS)
    for g in drawn:
        theirs.grad = g.double()
        optimizer.step()
    _, (allowed, _, _) = in_float64(start, drawn)
    parameter, _, _ = walk(adam_triton, start.clone().to(device), [g.to(device) for g in drawn])
    assert ((parameter.cpu().double() - theirs.detach()).abs() <= allowed).all()


def test_steps_are_reproducible_and_leave_neighbouring_memory_alone(device):
    drawn = [g.to(device) for g in gradients((1500,))]
    walks = []
    for _ in range(2):
        room = torch.full((3, 1600), 7.0, device=device)
        for t, g in enumerate(drawn, start=1):
            if t == 1:
                room[:, 50:1550] = 0.0
            adam_triton(*(row[50:1550] for row in room), g, numbers(t))
        walks.append(room)
    assert torch.equal(*walks)
    assert (walks[0][:, :50] == 7.0).all() and (walks[0][:, 1550:] == 7.0).all()


def test_zero_gradients_move_nothing(device):
    start = torch.randn(9, device=device)
    parameter, m, v = walk(adam_triton, start.clone(), [torch.zeros(9, device=device)] * 3)
    assert torch.equal(parameter, start) and not m.any() and not v.any()


def test_autograd_notices_the_step_and_gradients_may_be_strided(device):
    parameter = torch.zeros(5, 3, device=device, requires_grad=True)
    m, v = torch.zeros(5, 3, device=device), torch.zeros(5, 3, device=device)
    gradient = torch.randn(3, 5, device=device)
    before = parameter._version
    adam_triton(parameter, m, v, gradient.T, numbers(1))
    assert parameter._version > before
    other = torch.zeros(5, 3, device=device)
    adam_triton(other, torch.zeros_like(m), torch.zeros_like(v), gradient.T.contiguous(), numbers(1))
    assert torch.equal(parameter.detach(), other)


@pytest.mark.parametrize("shape", [(0,), (0, 3), (4, 0, 3)])
def test_an_empty_parameter_is_left_alone(device, shape):
    """At degree 0, sh_rest has the shape (N, 0, 3)."""
    empty = torch.zeros(shape, device=device)
    adam_triton(empty, empty.clone(), empty.clone(), empty.clone(), numbers(1))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU to wait for")
def test_a_step_does_not_synchronise(device):
    tensors = torch.zeros(4, 3000, device=device)
    adam_triton(*tensors, numbers(1))  # the first call compiles
    torch.cuda.set_sync_debug_mode("error")
    try:
        adam_triton(*tensors, numbers(2))
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.usefixtures("as_shipped")
def test_other_input_is_refused(device):
    p, m, v, g = torch.zeros(4, 4, 3, device=device)
    for arguments, names in (
        ((p.double(), m, v, g), "parameter"),
        ((p.T, m.T, v.T, g.T), "parameter"),
        ((p, m.half(), v, g), "m"),
        ((p, m, v[:3], g), "v"),
        ((p, m, v, g[:3]), "gradient"),
    ):
        with pytest.raises(ArgumentError, match=f"^{names}: "):
            adam_triton(*arguments, numbers(1))
