# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 12 - The backward pass
#
# [Chapter 11](11_tiles.ipynb) draws fast. [Chapter 09](09_train_in_3d.ipynb) learns, with gradients that were
# borrowed from autograd. Autograd can differentiate anything because it writes down everything: each intermediate
# result stays until the way back needs it. How much is that for the dense renderer?
#
# > **Needs.** A clone of the repository and a C++ compiler, with which the page builds kernels of `benchmarks/ladder`.
# > Triton and wgpu, two packages that `make course` installs, run the kernels for GPUs.

# %%
import functools
import os
import sys
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from gsplat_edu.base.constants import ALPHA_MAX, T_STOP
from gsplat_edu.data.synthetic import sphere_cameras, sphere_capture
from gsplat_edu.ops.losses import l1
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.scene.views import View
from gsplat_edu.train import Start, Views, course, training
from gsplat_edu.train.initialize import random_ball
from gsplat_edu.train.optimizer import Adam

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "benchmarks" / "ladder").is_dir())
sys.path.append(str(ROOT / "benchmarks"))

from ladder import backward, forward, gpu, oracle, splats, tape

SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
SIZE, CAP, ITERATIONS = (64, 800, 300) if SHORT else (128, 1600, 800)
print(f"budget: {ITERATIONS} iterations, {SIZE} px, at most {CAP} splats{' (reduced)' if SHORT else ''}")
DENSE, KERNELS = (functools.partial(render, backend=name) for name in ("torch", "cpu"))
camera = sphere_cameras(SIZE)[8]
numbers = [50, 100, 200, 400] + ([] if SHORT else [800])
clouds = [random_ball(n, torch.Generator().manual_seed(12)).trainable() for n in numbers]
measured = [tape.kept_bytes(lambda c=c: DENSE(c, camera).image.abs().mean()) for c in clouds]
for n, kept in zip(numbers, measured, strict=True):
    print(f"{n:5d} splats: {kept / 1e6:7.1f} MB kept")
each = measured[-1] / (numbers[-1] * SIZE * SIZE)
assert np.allclose(np.divide(measured, numbers), each * SIZE * SIZE, rtol=0.02)
print(f"{each:.1f} bytes for every pixel and splat; a million of both: {each:.1f} TB")
assert each > 8

fig, ax = plt.subplots(figsize=(6, 3), layout="constrained")
ax.plot([0, *numbers], [0, *(kept / 1e6 for kept in measured)], "o-")
ax.set(title="what autograd keeps for one image", xlabel="number of splats", ylabel="memory, MB")
plt.show()

# %% [markdown]
# It grows with pixels times splats, and almost all of it is for pixels that a splat does not reach. A kernel keeps
# next to nothing: it computes the values again on the way back. One pixel is enough to see how.
#
# ## One pixel
#
# Along a ray, near to far, $T_{i+1} = T_i (1 - \alpha_i)$ and the colour is $\hat c = \sum_i T_i \alpha_i c_i +
# T_\infty b$ with the background $b$. Raise $\alpha_i$ by a little: the splat itself shows more, and everything
# behind it less, by the factor $1 - \alpha_i$ that all of it contains:
#
# $$ \frac{\partial \hat c}{\partial \alpha_i} = T_i c_i - \frac{1}{1 - \alpha_i} \Bigl( \sum_{j > i} T_j \alpha_j c_j +
# T_\infty b \Bigr) . $$
#
# So the way back needs $T_i$ and what is behind. The textbook keeps $T_\infty$ and walks back to front: what is
# behind adds up on the way, and $T_i = T_{i+1} / (1 - \alpha_i)$ comes back by dividing (Kerbl et al. 2023). In exact
# arithmetic. In float32, this is what the division finds, through layers of opacity 0.99, of the $T_1 = 1$ it began
# with:
#
# > **Predict.** A float32 has a precision of 24 bits, and holds nothing much below $10^{-45}$. Behind how many layers
# > of opacity 0.99 does the division find nothing any more?


# %%
def walk_back(alpha, layers, first=1.0):
    T, alpha = np.float32(first), np.float32(alpha)
    for _ in range(layers):
        T = T - T * alpha
    for _ in range(layers):
        T = T / (np.float32(1) - alpha)
    return float(T / np.float32(first))


found = np.array([walk_back(0.99, n) for n in range(1, 31)])
opaque = 1 - np.logspace(-1, -6.5, 23)
errors = [max(abs(walk_back(alpha, 1, T) - 1) for T in np.linspace(0.3, 0.99, 50)) for alpha in opaque]
print("recovered of 1:", ", ".join(f"{found[n - 1]:.4f} behind {n} layers" for n in (10, 20, 22, 24)))
assert found[23] == 0 and abs(found[9] - 1) < 1e-4 and (errors < 2 * 2.0**-23 / (1 - opaque)).all()
fig, (left, right) = plt.subplots(1, 2, figsize=(11, 3.2), layout="constrained")
left.plot(range(1, 31), found, "o-")
left.set(title="recovered by dividing, layers of 0.99", xlabel="layers", ylabel="the first T, should be 1")
right.loglog(1 - opaque, errors, "o", label="largest of 50 rays")
right.loglog(1 - opaque, 2.0**-23 / (1 - opaque), "k--", label="eps over 1 - alpha")
right.axvline(1 - ALPHA_MAX, color="tab:red", label="the clamp")
right.set(title="one nearly opaque layer", xlabel="1 - alpha", ylabel="relative error of the recovered T")
right.legend()
plt.show()

# %% [markdown]
# On the right: $T - T\alpha$ rounds by half an eps of $T$, not of what is left, so a layer costs eps over $1 -
# \alpha$, and one that is opaque to the last bit leaves $0/0$. That is what the clamp of alpha is for. On the left:
# after 23 layers the transmittance is below the smallest float, and nothing comes back from zero, not even for the
# first splat, which all the light passes. So the walk has to start where each pixel stopped, a second number to keep.
#
# ## The same, near to far
#
# Nothing has to be recovered if the way back is walked in the order of the way there: $T_i$ comes out as it did then,
# to the bit. What is behind is then what has not been subtracted yet. For a loss with $g = \partial L / \partial \hat
# c$ keep one scalar, all of the image's share that is still to come:
#
# $$ r = g \cdot \hat c \quad\text{at first, and at each splat}\quad r \leftarrow r - T_i \alpha_i \, (g \cdot c_i),
# \qquad \frac{\partial L}{\partial \alpha_i} = T_i \, (g \cdot c_i) - \frac{r}{1 - \alpha_i} . $$
#
# $\hat c$ contains the background, so $r$ does, to the end.


# %%
def pixel(alphas, colors, background):
    T = np.concatenate([[1.0], np.cumprod(1 - alphas)])
    return (T[:-1] * alphas) @ colors + T[-1] * background


def pixel_gradient(alphas, colors, background, g, dtype=np.float64):
    T, r, out = dtype(1), dtype(g @ pixel(alphas, colors, background)), []
    for alpha, cg in zip(alphas.astype(dtype), (colors @ g).astype(dtype), strict=True):
        w = T * alpha
        r = r - w * cg
        out.append(T * cg - r / (dtype(1) - alpha))
        T = T - w
    return np.array(out)


rng = np.random.default_rng(12)
alphas, colors = rng.uniform(0, 0.99, 12), rng.uniform(size=(12, 3))
background, g = rng.uniform(size=3), rng.normal(size=3)
steps = 1e-3 * np.eye(12)
moved = [[g @ pixel(alphas + sign * n, colors, background) for n in steps] for sign in (1, -1)]
error = np.abs(pixel_gradient(alphas, colors, background, g) - np.subtract(*moved) / 2e-3).max()
print(f"against finite differences: {error:.1e}")
assert error < 1e-11  # linear in each alpha: only rounding is left, some eps over a step of 1e-3

largest = 0
for _ in range(500):
    a, c = np.append(rng.uniform(0, 0.99, 11), 0.99), rng.uniform(size=(12, 3))
    a, c, g = (x.astype(np.float32).astype(float) for x in (rng.permutation(a), c, rng.normal(size=3)))
    lost = pixel_gradient(a, c, background, g, np.float32) - pixel_gradient(a, c, background, g)
    largest = max(largest, np.abs(lost).max() / (12 * 2.0**-23 * np.abs(g).sum() / (1 - a.max())))
print(f"float32, 500 rays of 12 layers: worst error {largest:.3f} of what rounding may do")
assert largest < 1

# %% [markdown]
# It is not free. $r$ begins with the whole pixel: each of the $n$ subtractions may lose half an eps of the largest
# $|r|$, at most $\sum_k |g_k|$ for colours up to one, and dividing by $1 - \alpha$ makes it a hundred times that at
# the clamp. Where the other walk works it is the more exact one. Near to far buys the same lists, the same stop, the
# same bits of $T$.
#
# ## One splat
#
# The rest is local: $\alpha = o\, e^{p}$, $p = -\frac12 (A\,dx^2 + C\,dy^2) - B\,dx\,dy$, $dx = x - u$. With $h =
# \alpha\, \partial L/\partial\alpha$, zero where alpha was clamped, every gradient is a sum over pixels of $h$ times
# a derivative of $p$:
#
# $$ \frac{\partial L}{\partial u} = A \sum h\,dx + B \sum h\,dy, \qquad
# \frac{\partial L}{\partial A} = -\tfrac12 \sum h\,dx^2, \qquad \frac{\partial L}{\partial B} = -\sum h\,dx\,dy,
# \qquad \frac{\partial L}{\partial o} = \frac1o \sum h , $$
#
# and so on for $v$ and $C$. Six moments of $h$ and three sums $\sum w g$ for the colour are all that a pixel ever
# adds to. It gets cheaper: $dx$ does not depend on the row. So a kernel sums $h$, $h\,dy$, $h\,dy^2$ down the rows
# and multiplies by $dx$ and $dx^2$ once, at the end, a column at a time.


# %%
def by_moments(leaves, g, H, W):
    """The gradients again, by hand: r for all pixels at once, then moments, the factors dx last."""
    with torch.no_grad():
        image, (alphas, T, dx, dy) = tape.dense_image(*leaves, H, W)
        (A, B, C), (colors, opacities) = leaves[1].unbind(1), leaves[2:]
        cg = torch.einsum("nc,hwc->nhw", colors, g)
        r = (g * image).sum(-1) - torch.cumsum(T * alphas * cg, dim=0)
        h = torch.where(alphas < ALPHA_MAX, alphas * (T * cg - r / (1 - alphas)), 0.0)
        down = torch.stack([(h * dy**k).sum(1) for k in range(3)])  # over rows: (3, N, W)
        along = [(down * dx[:, 0] ** k).sum(2) for k in range(3)]  # and along them: (3, N)
        (m, my, myy), (mx, mxy, _), (mxx, _, _) = along
        means = torch.stack([A * mx + B * my, B * mx + C * my], dim=1)
        conics = torch.stack([-mxx / 2, -mxy, -myy / 2], dim=1)
        return means, conics, torch.einsum("nhw,hwc->nc", T * alphas, g), m / opacities


cloud = splats.scene(300, 48, seed=5)
cloud.opacities[::3] = 1  # some alphas are clamped
g = torch.tensor(rng.normal(size=(48, 48, 3)).astype(np.float32)).double()
leaves, reference, alphas, T = tape.autograd_gradients(cloud, g)
hand = by_moments(leaves, g, cloud.H, cloud.W)
print(f"{(alphas == ALPHA_MAX).sum()} alphas are clamped, {(alphas == 0).sum()} below the floor")
assert (alphas == ALPHA_MAX).any() and (alphas == 0).any()
for name, mine, theirs in zip(cloud._fields, hand, reference, strict=False):
    error = float((mine - theirs).abs().max() / theirs.abs().max())
    print(f"{name:10} by hand against autograd, float64: {error:.1e} of the largest")
    assert error < 1e-12  # eps, some dozen layers, over 1 - 0.99

# %% [markdown]
# ## Where the sums go
#
# A splat lies in several tiles, and tiles are worked on at the same time. `benchmarks/ladder/backward.cpp` walks each
# tile near to far as above, and has two answers to where the nine sums of a pair of tile and splat go.
#
# `atomics` adds them to the splat's own nine numbers, which all its tiles share. The addition is indivisible, so
# nothing is lost; but float32 addition is not associative, and the order is the order of arrival. `slots` gives each
# pair a [*slot*](../docs/GLOSSARY.md#slot), nine numbers of its own. The slots of a splat lie side by side and are
# added up afterwards in the order of its tiles, whoever wrote them and when. What slots buy is the bits.

# %%
met = (alphas.reshape(-1, 3, 16, 3, 16).amax((2, 4)) > 0).reshape(-1, 9)
number = np.where(met, np.cumsum(met).reshape(met.shape) - 1, np.nan)[:60]
fig, ax = plt.subplots(figsize=(11, 2.4), layout="constrained")
shown = ax.imshow(number.T, aspect="auto", interpolation="nearest")
fig.colorbar(shown, ax=ax, label="slot")
ax.set(
    title="a tile writes to its row, a splat adds up its column", xlabel="splat, near to far", ylabel="tile"
)
plt.show()

# %%
print("// Every pair" + (ROOT / "benchmarks/ladder/backward.cpp").read_text().split("// Every pair")[2])

# Both have to be right: within the rounding of r, n layers, and once more for the sums.
assert T[-1].reshape(3, 16, 3, 16).amax((1, 3)).min() > T_STOP  # no tile ends early: autograd's do not either
light = (T * alphas).sum(0) * g.abs().sum(-1)
each = torch.where(alphas > 0, alphas / (1 - alphas) * light, 0.0).sum((1, 2))
bound = 2 * int((alphas > 0).sum(0).max()) * 2.0**-23 * each
for name, rung in backward.RUNGS.items():
    found = torch.tensor(rung(cloud, forward.tight(cloud).image, g.numpy(), 2).opacities)
    share = float(((found - reference[3]).abs() * leaves[3].detach() / bound).max())
    print(f"{name:8} sum h: worst error {share:.4f} of what rounding may do")
    assert share < 1

many = splats.scene(*((2000, 128) if SHORT else (20_000, 512)), seed=12)
image = forward.tight(many).image
slope = rng.normal(size=image.shape).astype(np.float32)
arrivals = {backward.atomics(many, image, slope, threads=2).bits() for _ in range(20)}
print(f"atomics, two threads, 20 runs: {len(arrivals)} different results")
# That is luck, and not asserted. That three fixed orders of the same additions differ is not luck.
orders = [np.roll(np.arange(backward.num_tiles(many)), shift) for shift in (0, 7, 20)]
shared = {backward.atomics(many, image, slope, 1, order).bits() for order in orders}
print(f"atomics, one thread, three fixed orders of the tiles: {len(shared)} different results")
slotted = {backward.slots(many, image, slope, n, order).bits() for n in (1, 2, 3) for order in orders}
print(f"slots, these orders and 1, 2 and 3 threads: {len(slotted)} result")
assert len(shared) == 3 and len(slotted) == 1

# %% [markdown]
# ## The same on a GPU
#
# WGSL has no atomic addition of floats, and the engine's kernel, `engine/composite_backward.wgsl`, needs none. A
# workgroup takes a tile, and now an [invocation](../docs/GLOSSARY.md#invocation) owns a splat, whose sums stay in its
# registers. $T$ and $r$ of the pixels lie in [workgroup memory](../docs/GLOSSARY.md#workgroup-memory). A pixel has to
# meet its splats near to far, so they come one behind the other: at turn $i$, invocation $t$ takes pixel $i - t$,
# which invocation $t - 1$ has just left.

# %%
text = (ROOT / "src/gsplat_edu/engine/composite_backward.wgsl").read_text()
print(text[text.index("        var sums = Sums") : text.index("    for (var k = stop")].strip("\n"))
print((ROOT / "benchmarks/ladder/add_slots.wgsl").read_text().split("\n\n", 2)[2])

if not gpu.available():
    print(gpu.where(), "- so the kernels above did not run")
else:
    slot_sums = gpu.Tiled(cloud).backward(g.numpy())[1]
    found = torch.tensor(slot_sums[:, 4] / cloud.opacities)
    # Here an alpha may be off by d instead of eps; none in this scene is that near to the floor or the clamp.
    loose = bound * oracle.alpha_error(np.log(255), wgsl=True) / 2.0**-23
    share = float(((found - reference[3]).abs() * leaves[3].detach() / loose).max())
    print(f"ran on {gpu.where()}: sum h, worst error {share:.4f} of what rounding may do")
    assert share < 1 and slot_sums.tobytes() == gpu.Tiled(cloud).backward(g.numpy())[1].tobytes()

# %% [markdown]
# ## The package's
#
# [The backend cpu](../src/gsplat_edu/render/cpu/render.py) does the same with vectors, adds up the slots and goes on,
# in one pass over the splats, through conic, covariance and projection to the raw parameters. To torch all of it is
# one function. In float64 it has to agree with autograd's way through the dense renderer, and it keeps two images
# where that kept the table above.
# [Adam](../src/gsplat_edu/train/optimizer.py)'s [step](../src/gsplat_edu/ops/adam.py) is one more pass over memory.

# %%
cloud = random_ball(60, torch.Generator().manual_seed(5)).map(lambda tensor: tensor.double())
cloud.log_scales.add_(torch.tensor(rng.normal(size=(60, 3)) * 0.3))  # turning a ball changes nothing
weights = torch.tensor(rng.normal(size=(SIZE, SIZE, 3)))
grads = {}
for name, way in (("dense", DENSE), ("kernels", KERNELS)):
    leaves = cloud.trainable()
    output = way(leaves, camera)
    (output.image * weights).sum().backward()
    grads[name] = {key: tensor.grad for key, tensor in leaves.tensors().items() if tensor.numel()}
assert output.transmittance.min() > T_STOP
for key, theirs in grads["dense"].items():
    error = float((grads["kernels"][key] - theirs).abs().max() / theirs.abs().max())
    print(f"{key:16} kernels against autograd, float64: {error:.1e} of the largest")
    assert error < 1e-10

# Written in torch, Adam goes through memory once for every operation; the package's once.
start = random_ball(5000, torch.Generator().manual_seed(6)).trainable()
before, slope = start.means.detach().numpy().astype(float), rng.normal(size=(5000, 3))
start.means.grad = torch.tensor(slope, dtype=torch.float32)
Adam(start.tensors(), {"means": 0.01}).step(start.tensors())
m, v = 0.1 * slope / (1 - 0.9), 0.001 * slope**2 / (1 - 0.999)  # both moments, freed of their start at zero
error = np.abs(start.means.detach().numpy() - (before - 0.01 * m / (np.sqrt(v) + 1e-8))).max()
print(f"Adam's first step: worst difference {error:.1e}")
assert error < 4 * 2.0**-23  # positions up to one, and a step of a hundredth

# %% [markdown]
# ## The camera's
#
# When the camera moves, every splat's mean, ellipse and colour change on the screen, so the camera's gradient is a sum
# over splats of what is there already. All formulas take $W (x - e)$: for the centre $e$ it is minus the sum over the
# means. A turn moves the means about the camera, and the covariances with them. Here a camera is off by two degrees
# and by two percent of its distance, and follows nothing but the gradient of
# [CameraTensors](../src/gsplat_edu/render/camera_tensors.py):

# %%
ball = random_ball(1500, torch.Generator().manual_seed(5)).map(lambda tensor: tensor.double())
ball.logit_opacities.add_(2)
near = sphere_cameras(128)[8]
seen, pose = KERNELS(ball, near).image, CameraTensors.of(near)
start = np.array([0.02, -0.02, 0.02, 0.03, 0.03, -0.04])  # a turn in radians, and a shift
twist, fits, off = torch.tensor(start).requires_grad_(), [], []


def descend():
    twist.grad = None
    loss = (KERNELS(ball, pose.moved(twist)).image - seen).square().mean()
    loss.backward()
    fits.append(loss.item())
    off.append(float(twist.detach().norm()) / np.linalg.norm(start))
    return loss


exact = {"tolerance_grad": 0, "tolerance_change": 0}
torch.optim.LBFGS([twist], max_iter=60, line_search_fn="strong_wolfe", **exact).step(descend)
print(f"{len(off)} gradients bring the pose back to {off[-1]:.0e} of what it was off")
assert off[-1] < 0.05
fig, ax = plt.subplots(figsize=(6, 3), layout="constrained")
ax.semilogy(off, label="error of the pose")
ax.semilogy(np.array(fits) / fits[0], label="loss")
ax.set(title="a pose descends", xlabel="number of gradients", ylabel="share of that at first")
ax.legend()
plt.show()

# %% [markdown]
# That is the best case: photos without noise, and a camera that sees the whole ball. Other balls stop at a percent of
# the error: where the rims of splats, at the floor of alpha, cross pixels, the loss is rough.
#
# ## The same training, again
#
# The run of chapter 09, capture, cloud, seed, schedule and all, on one thread. Only the renderer differs.

# %%
torch.set_num_threads(1)
capture, config = sphere_capture(SIZE), course.course_config(ITERATIONS, 9, CAP)
truth = torch.tensor(capture.held_out.image)


def whole_run(views):
    generator = torch.Generator().manual_seed(9)
    cloud = random_ball(400, generator)
    begin = Start(cloud, extent=course.EXTENT, generator=generator)
    job = training(config, Views(views), load_backend("cpu"), begin)
    return cloud, job, job.run()


def held_out(gaussians):
    with torch.no_grad():
        image = KERNELS(gaussians, capture.held_out.camera).image
        return image, float(l1(image, truth))


began = time.process_time()
cloud, trainer, result = whole_run(capture.train)
whole_seconds = time.process_time() - began
(_, at_first), (learned, at_last) = held_out(cloud), held_out(trainer.gaussians)
print(f"{ITERATIONS} iterations: held-out L1 {at_first:.4f} -> {at_last:.4f}")
assert at_last < 0.3 * at_first


def iterations(way, count, scene):
    """Return milliseconds of the processor for each, which others who want it do not lengthen; and the losses."""
    chosen = course.course_config(count, 9, CAP).changed(strategy="none")
    job = training(chosen, Views(capture.train), load_backend(way), Start(scene, extent=course.EXTENT))
    begin = time.process_time()
    found = job.run().losses
    return 1e3 * (time.process_time() - begin) / count, found


fast, slow = (
    min(iterations(w, n, trainer.gaussians)[0] for _ in range(3)) for w, n in (("cpu", 20), ("torch", 1))
)
print(
    f"{len(trainer.gaussians)} splats: a dense iteration takes the processor {slow / fast:.0f} times as long"
)
assert slow > (5 if SHORT else 50) * fast

fig, axes = plt.subplots(1, 3, figsize=(13, 3.4), layout="constrained", width_ratios=[2, 1, 1])
at = whole_seconds / ITERATIONS * np.arange(1, ITERATIONS + 1)
axes[0].loglog(at, result.losses, linewidth=0.8, label=f"kernels, all {ITERATIONS} iterations")
early, falls = iterations("torch", 5, cloud)  # from the same start
assert abs(falls[0] / result.losses[0] - 1) < 1e-3  # but for the kernels' early stop
axes[0].loglog(early / 1e3 * np.arange(1, 6), falls, "o-", color="tab:red", label="dense, 5 of them")
axes[0].set(
    title="the same training by two renderers",
    xlabel="processor time, s",
    ylabel="L1 of the iteration's view",
)
axes[0].legend()
for ax, shown, title in zip(axes[1:], (learned, truth), ("held out, learned", "the truth"), strict=True):
    ax.imshow(np.clip(shown.numpy(), 0, 1), interpolation="nearest")
    ax.set(title=title, xticks=[], yticks=[])
plt.show()

# %% [markdown]
# ## The next failure
#
# So far the photos came without noise, each with a camera that is exact to the last bit. How much hangs on that? A
# camera turned by two and a half degrees sees its image a twentieth of the width away. Shift every photo by up to
# so much, each its own way, and train again.

# %%
moved = [
    View(v.camera, np.roll(v.image, rng.integers(-SIZE // 20, SIZE // 20 + 1, 2), (0, 1)))
    for v in capture.train
]
_, worse = held_out(whole_run(moved)[1].gaussians)
print(f"held-out L1 with cameras that are off: {worse:.4f}, with the right ones {at_last:.4f}")
assert worse > 1.2 * at_last

# %% [markdown]
# A phone gives photos and no cameras, and [chapter 14](14_photos_to_scene.ipynb) begins with a folder of photos. One
# debt comes first: the derivatives of this page end on the screen, at the conic, and from there "the package goes on".
# [Chapter 13](13_back_to_the_parameters.ipynb) goes on by hand, link by link, back to the numbers of the file.
