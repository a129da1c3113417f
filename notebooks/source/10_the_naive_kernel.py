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
# # 10 - The naive kernel
#
# [Chapter 09](09_train_in_3d.ipynb) trained a toy, and each of its iterations took so long that training
# anything else was out of the question. A dense renderer evaluates every splat at every pixel. It does so
# in whole arrays: for each step of the formula one array of pixels times splats is written, and read back
# by the next step. Before anything is made clever it is worth knowing what the plainest possible program
# costs. So here is the time of one image, on one thread, and what became of all those evaluations.
#
# > **Needs.** A clone of the repository and a C++ compiler, with which the page builds kernels of `benchmarks/ladder`.
# > Triton and wgpu, two packages that `make course` installs, run the kernels for GPUs.

# %%
import importlib.util
import os
import sys
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from gsplat_edu import _native, render_gaussians, sphere_shell
from gsplat_edu.base.constants import ALPHA_MIN
from gsplat_edu.data.synthetic import sphere_cameras
from gsplat_edu.render.torch.render import render_t

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "benchmarks" / "ladder").is_dir())
sys.path.insert(0, str(ROOT / "benchmarks"))
from ladder import forward, gpu, oracle, splats

# GSPLAT_EDU_BUDGET=reduced: a quarter of the pixels, fewer splats where time is measured.
SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
EDGE, LARGEST = (64, 1000) if SHORT else (128, 3000)
torch.set_num_threads(1)
print(f"budget: {EDGE} px, at most {LARGEST} splats in a timing{' (reduced)' if SHORT else ''}")

camera, shell = sphere_cameras(EDGE)[8], sphere_shell()
cloud = splats.projected(camera, *shell)
evaluations = cloud.count * cloud.pixels


def processor_seconds(action, rounds=3):
    """Best of several: time on the processor, which other programs on this machine do not lengthen."""
    took = []
    for _ in range(rounds):
        start = time.process_time()
        action()
        took.append(time.process_time() - start)
    return min(took)


single = [torch.tensor(array, dtype=torch.float32) for array in shell]
with torch.no_grad():
    dense_seconds = processor_seconds(lambda: render_t(*single, camera))
print(f"{cloud.count} splats, {cloud.pixels} pixels: {evaluations:,} evaluations for one image")
print(
    f"the dense renderer, float32: {1e3 * dense_seconds:.0f} ms, {1e9 * dense_seconds / evaluations:.1f} ns each"
)

# %%
rows, columns = np.mgrid[: cloud.H, : cloud.W]
log_alpha = np.empty((cloud.count, cloud.H, cloud.W), np.float32)
for i in range(cloud.count):
    dx, dy = columns - cloud.means2d[i, 0], rows - cloud.means2d[i, 1]
    A, B, C = cloud.conics[i]
    log_alpha[i] = np.log(cloud.opacities[i]) - 0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy
above = log_alpha >= np.log(ALPHA_MIN)
share = above.mean()
print(f"above the floor of 1/255: {above.sum():,} evaluations, {100 * share:.2f} %")
assert share < 0.05

fig, (image_ax, histogram_ax) = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
image_ax.imshow(render_gaussians(camera, *shell)[0].clip(0, 1), interpolation="nearest")
image_ax.set(title="the image", xticks=[], yticks=[])
edges = np.linspace(-9, 0, 91)
decades = np.maximum(log_alpha / np.log(10), -8.95)
histogram_ax.hist(decades[~above], edges, color="#bbbbbb", label="thrown away")
histogram_ax.hist(decades[above], edges, color="#d55e00", label="above the floor")
histogram_ax.set(
    title="every alpha that was computed for it",
    xlabel="alpha, power of ten (the first bar: -8.9 and below)",
    ylabel="evaluations",
    yscale="log",
)
histogram_ax.legend()
plt.show()

# %% [markdown]
# The tall bar on the left holds nearly everything, and note the logarithmic axis: a splat is a few pixels
# wide and the image is not. Two things are wrong, then. The arrays cost memory traffic that the formula
# does not ask for, and most of the evaluations were not asked for either. This chapter removes the first.
# It leaves the second in place on purpose, because a kernel that is obviously right is needed before one
# that is fast: every kernel that follows will be compared with it.
#
# ## One pixel reads every splat
#
# A [*kernel*](../docs/GLOSSARY.md#kernel) is the program that one pixel, or one small group of pixels, runs. Turn the
# loops around. Where the dense renderer takes one operation and applies it to all pixels and splats, the kernel takes
# one pixel, and lets it walk along the splats from near to far with four numbers in its hands: the transmittance $T$
# and three channels of colour.
#
# $$\alpha_i = \min\left(0.99,\; o_i \, e^{-\frac{1}{2}(A \, dx^2 + C \, dy^2) - B \, dx \, dy}\right)$$
#
# $$w_i = T \alpha_i, \qquad \mathrm{image} \mathrel{+}= w_i c_i, \qquad T \mathrel{-}= w_i$$
#
# These four numbers live in registers. Nothing else is ever written but the finished pixel. Projection
# and sort happened before: a kernel is given splats on the screen, with their *conics* $(A, B, C)$, the
# three numbers of the inverse of the dilated covariance. The whole of it, in C++:

# %%
LADDER = ROOT / "benchmarks" / "ladder"
print((LADDER / "naive.cpp").read_text())

# %% [markdown]
# The line with `continue` is the floor. The last lines of the loop count, because a count does not
# depend on how busy the machine is. The page compiles this with the C++ compiler of the machine and
# calls it through `ctypes`; inside the package the same step is made once, at installation, and
# [gsplat_edu.ops.kernels](../src/gsplat_edu/ops/kernels.py) is what every call goes through.
#
# ## Is it right?
#
# It computes in float32 and the reference in float64, so "equal" needs a number. Let
# $\epsilon = 2^{-24}$ be the largest relative error of one operation. The exponent is a sum of terms which
# may cancel; each of them goes through fewer than ten operations, so the exponent is off by at most
# $10 \, \epsilon P$ with
#
# $$P = \tfrac{1}{2}(A \, dx^2 + C \, dy^2) + |B \, dx \, dy|.$$
#
# The exponential turns this absolute error into a relative one of alpha. It adds a few roundings of its
# own, for which $24 \, \epsilon$ is generous. Call the sum $d$. Transmittance is a product of factors
# $1 - \alpha$, each of which is off, relatively, by $d \, \alpha / (1 - \alpha)$ and a rounding, and the image is
# a sum of $T \alpha c$. Carried along beside the image this gives every pixel a tolerance of its own. Where an
# alpha is within $d$ of the floor, rounding decides whether it counts at all: there its whole
# contribution goes into the tolerance. That is `oracle.tolerance`, and the reference renderer, given
# exactly these splats, is `oracle.oracle`.

# %%
drawn = forward.naive(cloud)
expected, expected_t = oracle.oracle(cloud)
bound, bound_t = oracle.tolerance(cloud)
difference = np.abs(drawn.image - expected)
print(f"kernel against reference: at most {difference.max():.1e}, median tolerance {np.median(bound):.1e}")
print(f"largest difference, as a share of its pixel's tolerance: {(difference / (bound + 1e-30)).max():.3f}")
assert (difference <= bound).all()
assert (np.abs(drawn.transmittance - expected_t) <= bound_t).all()
assert np.median(bound) < 1e-4

# What was counted agrees with the histogram, up to alphas that rounding puts on the other side of the floor.
near_floor = np.abs(log_alpha - np.log(ALPHA_MIN)) < 1e-4
assert drawn.counts.evaluated == evaluations
assert abs(drawn.counts.mattered - above.sum()) <= near_floor.sum()

fig, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
axes[0].imshow(drawn.image.clip(0, 1), interpolation="nearest")
axes[0].set(title="the kernel, float32", xticks=[], yticks=[])
axes[1].imshow(expected.clip(0, 1), interpolation="nearest")
axes[1].set(title="the reference, float64", xticks=[], yticks=[])
shown = axes[2].imshow(difference.max(axis=2) * 2**24, cmap="viridis", interpolation="nearest")
axes[2].set(title="difference", xticks=[], yticks=[])
fig.colorbar(shown, ax=axes[2], label="units of 2^-24")
plt.show()

# %% [markdown]
# The two pictures differ by a few units in the last place of a float32.
#
# ## What it should cost: a roofline by hand
#
# A [roofline](../docs/GLOSSARY.md#roofline) is a picture of two limits. A processor does two things at limited rates:
# arithmetic, and moving bytes. A program that needs $F$ operations and $M$ bytes cannot take less time than
# $F / \mathrm{peak}$, nor less than $M / \mathrm{bandwidth}$. Their ratio $F / M$, the [*arithmetic
# intensity*](../docs/GLOSSARY.md#arithmetic-intensity), says which of the two limits matters. Both numerators can be
# counted with a pencil.
#
# Every evaluation does two subtractions, nine operations for the exponent, a product with the opacity, a
# minimum, and two comparisons, with the floor and for the loop: 15, beside one exponential, which is about
# another 10. Every one that is above the floor adds 8. Every evaluation reads a mean, a conic and an opacity,
# six floats, and those above the floor a colour; a pixel is written once.
#
# The two rates are measured here and now: vector multiply-adds that wait for nothing, and a copy of an
# array that fits no cache.

# %%
counts = drawn.counts
operations = (15 + 10) * counts.evaluated + 8 * counts.mattered
assert counts.bytes == 24 * counts.evaluated + 12 * counts.mattered + 16 * cloud.pixels
compulsory = 36 * cloud.count + 16 * cloud.pixels

lanes = {"v4": 16, "v3": 8}.get(_native.isa(), 4)
peak = 2 * lanes * max(_native.fma_rate() for _ in range(3))
block, target = np.ones((2, 2**24), np.float32)
bandwidth = 2 * block.nbytes / processor_seconds(lambda: np.copyto(target, block), rounds=5)
naive_seconds, _ = forward.seconds("naive", cloud)

print(f"peak {peak / 1e9:.0f} GFLOP/s on one thread ({lanes} lanes), bandwidth {bandwidth / 1e9:.0f} GB/s")
print(f"operations {operations / 1e6:,.0f} million: at peak {1e3 * operations / peak:.1f} ms")
print(
    f"bytes, were every read from memory {counts.bytes / 1e6:,.0f} million: {1e3 * counts.bytes / bandwidth:.1f} ms"
)
print(
    f"bytes, each splat from memory once {compulsory / 1e6:.2f} million: {1e3 * compulsory / bandwidth:.3f} ms"
)
print(f"measured {1e3 * naive_seconds:.0f} ms, {operations / naive_seconds / 1e9:.1f} GFLOP/s")
assert 36 * cloud.count < 2**18 and operations / compulsory > 100

# %%
intensities = np.logspace(-2, 4, 200)
fig, ax = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
ax.loglog(
    intensities, np.minimum(peak, bandwidth * intensities) / 1e9, "k", label="roof: nothing is above it"
)
ax.loglog(
    intensities, np.minimum(peak / lanes, bandwidth * intensities) / 1e9, "k:", label="roof of one lane"
)
rate = operations / naive_seconds / 1e9
ax.plot(operations / counts.bytes, rate, "o", color="#0072b2", label="naive, were it to read from memory")
ax.plot(operations / compulsory, rate, "o", color="#d55e00", label="naive, reading from cache")
ax.set(title="the roofline of one thread", xlabel="operations per byte of memory", ylabel="GFLOP/s")
ax.legend()
plt.show()

# %% [markdown]
# All splats of the toy together are smaller than the second cache of nearly any processor of today,
# so after the first pixel they come from there, and the intensity is that of the right-hand point. Memory
# is not the limit. Arithmetic is not either, quite: the kernel works on one number at a time, where the
# processor could take a whole vector, and each exponential waits in line. The dotted line is the roof of
# a program of single numbers. That gap is worth something, and chapter 11 will take it. But look at what
# else the count says. At *peak* the operations of this toy would take the time printed above, a time that
# is only good for a toy. The count itself is too large, and no compiler makes it smaller.
#
# ## What it costs
#
# > **Predict.** The dense renderer in torch and the kernel make the same evaluations. Which is faster, and by how
# > much? And where between them is the NumPy reference, a Python loop with a box around each splat?

# %%
numpy_seconds = processor_seconds(lambda: render_gaussians(camera, *shell), rounds=2)
exact_seconds = processor_seconds(lambda: oracle.oracle(cloud), rounds=2)
for name, seconds in (
    ("dense torch, float32, every splat at every pixel", dense_seconds),
    ("naive C++, float32, every splat at every pixel", naive_seconds),
    ("NumPy reference, float64, 3-sigma boxes", numpy_seconds),
    ("NumPy reference, float64, exact extents", exact_seconds),
):
    print(f"{name:50} {1e3 * seconds:8.1f} ms {dense_seconds / seconds:8.2f} times as fast as dense torch")

# %% [markdown]
# The kernel and the dense renderer do the same evaluations. What lies between them is traffic: arrays
# written and read back against four numbers in registers, set against vectors, which torch uses and this
# kernel does not. The last two lines are a warning. They are Python, one splat at a time, in twice the
# precision; what they do have is a box around each splat, outside of which they do not look. A compiled
# language is a constant factor. The box is not.
#
# ## The same kernel in Triton
#
# A GPU runs thousands of pixels at once. In Triton (Tillet et al. 2019) the unit is a block of pixels that
# executes one program: every variable below holds one number per pixel of the block, a load of one splat
# is shared by all of them, and the loop is the same loop. There is no
# `continue`, since pixels of a block cannot go different ways; a weight of zero does the same. The
# package's own [composite kernel](../src/gsplat_edu/render/cuda/composite.py) begins as this one does.

# %%
source = (LADDER / "naive_triton.py").read_text()
print(source[source.index("@triton.jit") : source.index("def where")].strip())

# %% [markdown]
# Where there is no GPU Triton interprets the source: each operation becomes one of NumPy on the whole
# block. This checks that the kernel is right and says nothing about how fast it is, so the scene is small.

# %%
small = splats.scene(40, 24, seed=4, stretch=3.0)
if importlib.util.find_spec("triton") is None:
    print("triton is not installed here; the kernel above did not run")
else:
    from ladder import naive_triton

    block_image, block_t, block_seconds = naive_triton.naive_triton(small)
    expected, expected_t = oracle.oracle(small)
    bound, bound_t = oracle.tolerance(small)
    print(f"ran on: {naive_triton.where()}")
    print(f"{small.count} splats, {small.pixels} pixels in {1e3 * block_seconds:.1f} ms")
    print(f"against the reference: at most {np.abs(block_image - expected).max():.1e}")
    assert (np.abs(block_image - expected) <= bound).all() and (np.abs(block_t - expected_t) <= bound_t).all()

# %% [markdown]
# ## The same kernel in WGSL
#
# WGSL is the shading language of WebGPU: browsers run it, and so does Python with the package wgpu. The package's
# backend `webgpu` is written in it. An [*invocation*](../docs/GLOSSARY.md#invocation), one run of the kernel with its
# own registers, is one pixel. Invocations start in groups, here of 64, and a group runs on one core of the GPU: a
# [*workgroup*](../docs/GLOSSARY.md#workgroup). This kernel needs nothing from its neighbours, so the 64 is arbitrary.

# %%
print((LADDER / "naive.wgsl").read_text())

# %% [markdown]
# It is the C++ without the two outer loops, `continue` included. Yet here `continue` saves nothing unless all agree.
# The core executes a workgroup as [*subgroups*](../docs/GLOSSARY.md#subgroup) of, say, 32 invocations, which CUDA calls
# warps. All of a subgroup take the same instruction at the same time. While one of them blends, the other 31 wait.
#
# Its exponential may err more than that of C: WGSL allows $3 + 2|x|$ units in the last place, each of them two
# $\epsilon$. `tolerance(..., wgsl=True)` has room for it.

# %%
if not gpu.available():
    print(gpu.where(), "- so the kernel above did not run")
else:
    on_gpu, gpu_t = gpu.naive(cloud)
    bound, bound_t = oracle.tolerance(cloud, wgsl=True)
    expected, expected_t = oracle.oracle(cloud)
    print(f"ran on {gpu.where()}: {cloud.pixels} invocations in {-(-cloud.pixels // 64)} workgroups")
    print(f"against the reference: at most {np.abs(on_gpu - expected).max():.1e}")
    assert (np.abs(on_gpu - expected) <= bound).all() and (np.abs(gpu_t - expected_t) <= bound_t).all()

# %% [markdown]
# ## The law of the naive kernel
#
# Hardly anything in it depends on what is in the picture; only the exponential of a very negative number
# takes a little longer. So its time ought to be a constant times pixels times splats. If that is so,
# measured times lie on a line of slope 1 on logarithmic axes, whether it is the splats or the pixels that
# become more.

# %%
sizes, numbers = (48, EDGE) if SHORT else (64, 96, EDGE), (30, 100, 300, 1000, LARGEST)
measured = {}
for edge in sizes:
    for number in numbers:
        seconds, rendered = forward.seconds("naive", splats.scene(number, edge), enough=0.3, rounds=4)
        measured[edge, number] = seconds
        assert rendered.counts.evaluated == number * edge * edge
products = np.array([number * edge * edge for edge, number in measured], dtype=float)
times = np.array(list(measured.values()))
slope, intercept = np.polyfit(np.log(products), np.log(times), 1)
each = np.exp(np.mean(np.log(times / products)))
print(
    f"over {np.log10(products.max() / products.min()):.1f} decades: slope {slope:.3f}, {1e9 * each:.1f} ns each"
)
assert products.max() / products.min() > 30
assert 0.8 < slope < 1.2

fig, ax = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
for edge, color, marker in zip(sizes, ("#0072b2", "#d55e00", "#009e73"), "osd", strict=False):
    points = [(number * edge * edge, measured[edge, number]) for number in numbers]
    ax.loglog(*np.transpose(points), marker, color=color, label=f"{edge} x {edge} px")
ends = np.array([products.min(), products.max()])
ax.loglog(ends, np.exp(intercept) * ends**slope, "k", linewidth=0.8, label="fit")
ax.set(title="naive: time is a constant times the product", xlabel="pixels x splats", ylabel="seconds")
ax.legend()
plt.show()

# %% [markdown]
# ## The next failure
#
# The law is the failure. Follow the line to a photo of a telephone and a scene that deserves one:

# %%
photo, many = 4000 * 3000, 1_000_000
print(
    f"{photo / 1e6:.0f} million pixels, {many / 1e6:.0f} million splats: {each * photo * many / 86400:.1f} days"
)
assert each * photo * many > 3600

mattered_share = counts.mattered / counts.evaluated
print(f"reads that mattered: {counts.mattered:,} of {counts.evaluated:,}, {100 * mattered_share:.2f} %")
assert mattered_share < 0.05

# %% [markdown]
# That is one image. And of the reads behind it, next to none leave a trace in the picture. The pixel
# cannot know beforehand which splats will matter to it, because it looks at all of them alike. It needs
# a list that something else has made.
