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
# # 11 - Tiles
#
# The naive kernel of [chapter 10](10_the_naive_kernel.ipynb) is right, and its time is a constant times
# pixels times splats. Here is what a pixel gets for it: on the left how many splats it reads, in the
# middle how many of them are above the floor where it is, on the right the image that comes of it.
#
# > **Needs.** A clone of the repository and a C++ compiler, with which the page builds kernels of `benchmarks/ladder`.
# > Triton and wgpu, two packages that `make course` installs, run the kernels for GPUs.

# %%
import os
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.patches import Ellipse, Rectangle

from gsplat_edu import _native, sphere_shell
from gsplat_edu.base.constants import ALPHA_MIN, DILATION, T_STOP, TILE
from gsplat_edu.data.synthetic import sphere_cameras
from gsplat_edu.engine.passes import LIMITS

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "benchmarks" / "ladder").is_dir())
LADDER = ROOT / "benchmarks" / "ladder"
sys.path.insert(0, str(ROOT / "benchmarks"))
from ladder import forward, gpu, oracle, splats

# GSPLAT_EDU_BUDGET=reduced: fewer splats where time is measured.
SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
EDGE, TIMED = (64, (30, 300, 2000)) if SHORT else (128, (30, 100, 300, 1000, 3000, 10_000, 30_000))
torch.set_num_threads(1)
print(f"budget: {EDGE} px, at most {TIMED[-1]} splats in a timing{' (reduced)' if SHORT else ''}")

cloud = splats.projected(sphere_cameras(128)[8], *sphere_shell())
rows, columns = np.mgrid[: cloud.H, : cloud.W]
mattered = np.zeros((cloud.H, cloud.W), int)
for i in range(cloud.count):
    dx, dy = columns - cloud.means2d[i, 0], rows - cloud.means2d[i, 1]
    A, B, C = cloud.conics[i]
    mattered += cloud.opacities[i] * np.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy) >= ALPHA_MIN
print(
    f"a pixel reads {cloud.count} splats; {mattered.mean():.1f} matter on average, {mattered.max()} at most"
)
assert mattered.max() < cloud.count / 10

fig, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
reads = np.full(mattered.shape, cloud.count)
for ax, counts, title in ((axes[0], reads, "splats read"), (axes[1], mattered, "splats above the floor")):
    shown = ax.imshow(
        np.maximum(counts, 0.5), norm="log", vmin=0.5, vmax=cloud.count, interpolation="nearest"
    )
    ax.set(title=title, xticks=[], yticks=[])
fig.colorbar(shown, ax=axes[:2], label="splats (none is drawn as a half)")
axes[2].imshow(forward.naive(cloud).image.clip(0, 1), interpolation="nearest")
axes[2].set(title="the image", xticks=[], yticks=[])
plt.show()

# %% [markdown]
# The left picture has one colour, and the corners of the middle one are empty. A pixel cannot know its
# splats without looking at all of them; but a splat knows its pixels, since it is an ellipse of known
# size. So let the splats say where they are wanted.
#
# ## A list for every tile
#
# A list for every pixel would be longer than the work itself. Neighbours want nearly the same splats, so they share
# one: the image is cut into squares, [*tiles*](../docs/GLOSSARY.md#tile), and each splat is entered into the list of
# every tile that its box of three standard deviations meets (Kerbl et al. 2023). Such an entry, one splat in one
# tile, is a [*pair*](../docs/GLOSSARY.md#pair): what an image costs will be counted in pairs. How large should a tile
# be? Let a box be $b$ pixels wide, and fall anywhere on tiles of width $t$. Along one axis its first pixel falls into
# a tile, and each of the other $b - 1$ starts a new one with probability $1 / t$. So a box meets
#
# $$n(t) = \left(1 + \frac{b - 1}{t}\right)^2$$
#
# tiles on average, and if all pixels of a tile evaluate their list, a splat is evaluated
# $n(t) \, t^2 = (t + b - 1)^2$ times. Small tiles mean long lists, large tiles mean wasted evaluations.
#
# > **Predict.** Tiles from 4 to 128 px are tried. Which makes the shortest lists, which the fewest evaluations? Can
# > one size have both?

# %%
rng = np.random.default_rng(11)
round_ones = splats.scene(20_000, 4096)
sigma_squared = splats.SIGMA**2 + DILATION
# The radius of the reference renderer, whose root has a floor for round splats, and its box: 2 r + 2 pixels.
radius = np.ceil(3 * np.sqrt(sigma_squared + np.sqrt(0.1)))
box = 2 * radius + 2
first = np.floor(round_ones.means2d.astype(float)) - radius
inner = ((first > 0) & (first + box < 4096 - 128)).all(axis=1)
tile_edges = 2 ** np.arange(2, 8)
list_length, walked = [], []
for edge in tile_edges:
    met = ((first[inner] + box - 1) // edge - first[inner] // edge + 1).prod(axis=1)
    predicted = (1 + (box - 1) / edge) ** 2
    # A mean of n draws is off by its standard deviation / sqrt(n); five of them are never seen.
    assert abs(met.mean() - predicted) < 5 * met.std() / np.sqrt(inner.sum())
    list_length.append(met.mean()), walked.append(met.mean() * edge**2)
    print(f"tiles of {edge:3d} px: {list_length[-1]:6.2f} list entries a splat (predicted {predicted:6.2f}), "
          f"{walked[-1]:6.0f} evaluations")  # fmt: skip

fig, (entries_ax, walked_ax) = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
smooth = np.linspace(4, 128, 300)
for ax, points, line, title, label in (
    (entries_ax, list_length, (1 + (box - 1) / smooth) ** 2, "what the lists cost", "entries a splat"),
    (walked_ax, walked, (smooth + box - 1) ** 2, "what the pixels cost", "evaluations a splat"),
):
    ax.loglog(smooth, line, "k", linewidth=0.8, label="formula")
    ax.loglog(tile_edges, points, "o", color="#d55e00", label="counted")
    ax.axvline(TILE, color="#0072b2", linestyle=":", label=f"{TILE} px")
    ax.set(title=f"{title}, boxes of {box:.0f} px", xlabel="tile, px", ylabel=label)
    ax.legend()
plt.show()

# %% [markdown]
# Sixteen lies between: a splat of this size has fewer than four entries, and evaluates about four times
# its box. It has a second merit, which the end of this page will use. And the lists name the pixels that
# are evaluated for nothing: whoever draws a tile can clip each splat's box to it.
#
# ## Sorted once
#
# Every list has to be in order of depth. The splats are: they were sorted once, all together. What is
# needed is a distribution into lists that keeps the order. That takes no comparison at all. Walk along
# the splats once and count how many entries each tile will have. The list of tile $k$ then begins where
# all lists before it end,
#
# $$\mathrm{begin}_k = \sum_{j < k} \mathrm{count}_j,$$
#
# a [*prefix sum*](../docs/GLOSSARY.md#prefix-sum). Walk along the splats a second time, near to far, and put each
# entry at the next free place of its tile. Whoever comes first is nearer. This is a counting sort; it takes time
# proportional to the number of entries. The alternative that the field began with makes a key of tile and depth for
# every entry and sorts the keys. Both give the same lists:

# %%
corner = np.floor(cloud.means2d).astype(int)
low = np.clip(corner - 4, 0, None) // TILE
high = np.clip(corner + 5, None, cloud.W - 1) // TILE
across = -(-cloud.W // TILE)
duplicates = [
    (y * across + x, i)
    for i in range(cloud.count)
    for y in range(low[i, 1], high[i, 1] + 1)
    for x in range(low[i, 0], high[i, 0] + 1)
]
length = np.bincount([k for k, _ in duplicates], minlength=across * across)
begin = np.concatenate([[0], np.cumsum(length)])
free, lists = begin[:-1].copy(), np.empty(len(duplicates), int)
for k, i in duplicates:
    lists[free[k]] = i
    free[k] += 1

depth_rank = rng.permutation(len(duplicates))  # the other way has no order to start from
keys = np.array([(k << 32) + i for k, i in duplicates])[depth_rank]
assert np.array_equal(lists, np.sort(keys) & 0xFFFFFFFF)
assert all((np.diff(lists[begin[k] : begin[k + 1]]) > 0).all() for k in range(across * across))
print(f"{cloud.count} splats make {len(duplicates)} entries: {len(duplicates) / cloud.count:.2f} each")
print((LADDER / "lists.h").read_text().split("\n\n", 3)[3])

# %% [markdown]
# ## Stop when it is dark
#
# Light that has passed many splats is gone. Once $T$ is below $10^{-4}$ at every pixel of a tile, whatever
# is still to come can change no channel by more than $10^{-4}$ times its brightest colour, which is a
# fortieth of a step of an 8-bit image, and the tile is finished. One pixel that still sees the sky keeps
# its tile alive. The kernel with lists, boxes and this stop is the second rung of the ladder:

# %%
text = (LADDER / "tiled.cpp").read_text()
print(text[text.index('extern "C"') :])

# %%
deep = splats.scene(12_000, 64, seed=1)
plain, dark = forward.naive(deep), forward.tight(deep)
assert np.abs(plain.image - dark.image).max() < T_STOP + 1e-5  # colours are at most 1; the rest is rounding
print(f"{deep.count} splats on {deep.W} px: {plain.counts.mattered:,} above the floor")
print(f"drawn before the tile is dark: {dark.counts.mattered:,}")
print(f"steps of an 8-bit image that the stop can cost: {T_STOP * 255:.4f}")
assert dark.counts.mattered < plain.counts.mattered / 2

# %% [markdown]
# ## Boxes of oblique ellipses
#
# How good is the box? It is a square as wide as the longest axis, and for a splat that is long, thin and
# oblique it is mostly empty. Nor does three sigma mean anything to a pixel. What means something is the
# floor: alpha is at least 1/255 exactly where
#
# $$A \, dx^2 + 2 B \, dx \, dy + C \, dy^2 \le K, \qquad K = 2 \ln(255 \, o),$$
#
# an ellipse that shrinks with the opacity $o$ and does not exist for a splat that is too faint. In a row
# of pixels $dy$ is fixed, and this is a quadratic inequality in $dx$:
#
# $$dx = \frac{-B \, dy \pm \sqrt{A K - (A C - B^2) \, dy^2}}{A}$$
#
# No pixel outside is above the floor, and none inside is below it. Against brute force:

# %%
oblique = splats.scene(300, 96, seed=2, stretch=8.0)
pixels = np.arange(96)
touched, missed = 0, 0
for (u, v), (A, B, C), o in zip(
    oblique.means2d.astype(float), oblique.conics.astype(float), oblique.opacities.astype(float), strict=True
):
    dx, dy = pixels - u, pixels[:, None] - v
    alpha = o * np.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy)
    root = A * 2 * np.log(o / ALPHA_MIN) - (A * C - B * B) * dy * dy
    half, middle = np.sqrt(np.maximum(root, 0)) / A, -B / A * dy
    within = (root >= 0) & (np.abs(dx - middle) <= half)
    touched, missed = touched + within.sum(), missed + (within != (alpha >= ALPHA_MIN)).sum()
print(f"{touched} pixels above the floor, {missed} on which formula and brute force disagree")
assert missed == 0

# %%
stretches = (1, 2, 4, 8, 16)
boxed, exact = [], []
for stretch in stretches:
    sample = splats.scene(4000, 512, seed=stretch, stretch=stretch)
    boxed.append(forward.tiled(sample).counts.pairs / 4000)
    exact.append(forward.tight(sample).counts.pairs / 4000)
    print(f"axes 1 : {stretch:2d}  tiles met by the box {boxed[-1]:6.2f}, by the ellipse {exact[-1]:5.2f}")
assert exact[-1] < boxed[-1] / 3

turn = np.array([[1, -1], [1, 1]]) / np.sqrt(2)
covariance = turn @ np.diag([130.0, 3.0]) @ turn.T + DILATION * np.eye(2)
one = splats.from_cov2d([[46.0, 43.0]], covariance[None], [[1.0, 1.0, 1.0]], [0.5], (96, 96))
alpha = 1 - forward.naive(one).transmittance
tile_met = alpha.reshape(6, TILE, 6, TILE).max(axis=(1, 3)) > 0
variances = np.linalg.eigvalsh(covariance)[::-1]
long, thin = 2 * np.sqrt(2 * np.log(0.5 / ALPHA_MIN) * variances)
reach = np.ceil(3 * np.sqrt(variances[0]))
near, far = ((np.array([43, 46]) + sign * reach).clip(0, 95) // TILE for sign in (-1, 1))
boxed_tiles = int((far - near + 1).prod())
assert (tile_met.sum(), boxed_tiles) == (forward.tight(one).counts.pairs, forward.tiled(one).counts.pairs)

fig, (tile_ax, count_ax) = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
tile_ax.imshow(np.where(alpha > 0, alpha, np.nan), cmap="viridis", interpolation="nearest", zorder=1)
for y, x in np.argwhere(tile_met):
    tile_ax.add_patch(
        Rectangle((16 * x - 0.5, 16 * y - 0.5), 16, 16, color="#e69f00", alpha=0.35, lw=0, zorder=0)
    )
square = Rectangle((46 - reach, 43 - reach), 2 * reach, 2 * reach, fill=False, linewidth=1.5, label="its box")
tile_ax.add_patch(square)
tile_ax.add_patch(Ellipse((46, 43), long, thin, angle=45, fill=False, color="#0072b2", label="alpha = 1/255"))
tile_ax.set(title=f"tiles met: {tile_met.sum()} by the ellipse, {boxed_tiles} by the box")
tile_ax.set(xlabel="x, px", ylabel="y, px", xlim=(-0.5, 95.5), ylim=(95.5, -0.5))
tile_ax.set(xticks=np.arange(0, 96, 16) - 0.5, xticklabels=range(0, 96, 16))
tile_ax.set(yticks=np.arange(0, 96, 16) - 0.5, yticklabels=range(0, 96, 16))
tile_ax.grid(linewidth=0.6)
tile_ax.legend(loc="lower left")
count_ax.plot(stretches, boxed, "o-", color="#000000", label="box of three sigma")
count_ax.plot(stretches, exact, "o-", color="#d55e00", label="ellipse")
count_ax.set(title="list entries, same area, random directions", xlabel="ratio of the axes")
count_ax.set(ylabel="tiles a splat", ylim=(0, None))
count_ax.legend()
plt.show()

# %% [markdown]
# The kernel that asks the ellipse instead of the box is the third rung, `tight.cpp`. It evaluates what
# matters and next to nothing else, so there is no work left to save. What is left is to do it faster.
#
# ## A row of sixteen
#
# A processor adds eight or sixteen numbers as fast as one, if they lie side by side and want the same
# thing. The pixels of a row of a tile do: `dy` is the same for all of them, and `dx` is the same in every
# row of the tile. With the exponent in base 2,
#
# $$p = \left(\log_2 o + a \, dx^2\right) + dy \left(b \, dx + c \, dy\right),$$
#
# the first bracket and $b \, dx$ are two vectors that are made once for a splat and a tile, and each row costs two
# multiply-adds for $p$. Sixteen floats, one in each [lane](../docs/GLOSSARY.md#lane), are one register of AVX-512,
# two of AVX2 and four of NEON, which is the second merit of tiles of sixteen: a row is a whole number of registers on
# each.
#
# The price is that a row is evaluated whole, or not at all. And `exp` of the C library takes one number.
# But a float *is* a power of two with a fraction attached: split $p = n + f$ with $n$ the nearest integer,
# take $2^f$ from a polynomial and add $n$ to the bits of the exponent.

# %%
text = (LADDER / "simd.cpp").read_text()
print(text[text.index("// 2^p") : text.index("static bool dark")])

# %%
coefficients = [1.33952915e-3, 9.67037690e-3, 5.55033013e-2, 2.40222633e-1, 6.93147182e-1, 1.0]
assert all(f"{c:.8e}".replace("e-0", "e-") in text for c in coefficients[:-1]), "those of the source above"
fraction = np.linspace(-0.5, 0.5, 100_001, dtype=np.float32)
value = np.zeros_like(fraction)
for c in coefficients:
    value = value * fraction + np.float32(c)
relative = value / np.exp2(fraction.astype(float)) - 1
print(
    f"the polynomial is off by {np.abs(relative).max():.1e}, {np.abs(relative).max() * 2**24:.1f} roundings"
)
assert np.abs(relative).max() < 5e-7

# %% [markdown]
# ## The ladder
#
# Every rung draws what the reference renderer draws, given the same rule for extents and for stopping, to
# within the tolerance that [chapter 10](10_the_naive_kernel.ipynb) derived. The top one is the package's
# own: [gsplat_edu.render.cpu](../src/gsplat_edu/render/cpu/render.py) hands tensors to kernels that do what these
# rungs do. They add what does not fit on a page, such as asking memory for the next splats in the list
# while the present ones are drawn, or a copy for each instruction set.

# %%
odd = splats.scene(400, 61, seed=7, stretch=3.0)._replace(H=43)
bound, _ = oracle.tolerance(odd, conics_again=True)
for rung in forward.RUNGS:
    extent = "box3sigma" if rung == "tiled" else "exact"
    expected, _ = oracle.oracle(odd, extent=extent, stop="none" if rung == "naive" else "tile")
    rendered = forward.RUNGS[rung](odd)
    difference = np.abs(rendered.image - expected)
    assert (difference <= bound).all()
    print(f"{rung:8} equals the reference ({extent}): at most {difference.max():.1e}")

milliseconds, work = {}, {}
for rung in forward.RUNGS:
    for number in TIMED:
        if rung == "naive" and number > 3000:
            continue  # its time is known: a constant times the product
        seconds, rendered = forward.seconds(rung, splats.scene(number, EDGE), enough=0.3)
        milliseconds[rung, number], work[rung, number] = 1e3 * seconds, rendered.counts
MOST_TIMED = max(number for rung, number in milliseconds if rung == "naive")

print(f"\n{MOST_TIMED} splats of 2 px on {EDGE} x {EDGE} pixels, one thread")
print("rung            ms  times naive    entries  evaluated    mattered (package: not counted)")
for rung in forward.RUNGS:
    took, did = milliseconds[rung, MOST_TIMED], work[rung, MOST_TIMED]
    gain = milliseconds["naive", MOST_TIMED] / took
    print(f"{rung:8} {took:9.3f} {gain:12.0f} {did.pairs:10} {did.evaluated:10} {did.mattered:11}")
assert milliseconds["naive", MOST_TIMED] > 3 * milliseconds["tiled", MOST_TIMED]
assert milliseconds["naive", MOST_TIMED] > 10 * milliseconds["simd", MOST_TIMED]

# %%
COLORS = dict(zip(forward.RUNGS, ("#000000", "#0072b2", "#56b4e9", "#e69f00", "#d55e00"), strict=True))
fig, (time_ax, gain_ax) = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
for rung, color in COLORS.items():
    known = [n for n in TIMED if (rung, n) in milliseconds]
    time_ax.loglog(known, [milliseconds[rung, n] for n in known], "o-", color=color, label=rung)
    both = [n for n in known if ("naive", n) in milliseconds]
    gains = [milliseconds["naive", n] / milliseconds[rung, n] for n in both]
    gain_ax.loglog(both, gains, "o-", color=color, label=rung)
time_ax.set(title=f"the ladder, {EDGE} x {EDGE} px, one thread", xlabel="splats", ylabel="ms an image")
gain_ax.set(title="times as fast as naive", xlabel="splats", ylabel="ratio")
time_ax.legend()
plt.show()

# %% [markdown]
# The two lines in the middle come from not looking, the two below them from looking at sixteen pixels at
# once. With few splats the package pays for its preparations; with many the early stop begins to bend
# the lines. Note the table's column of evaluations: the fourth rung evaluates more than the third, and
# takes less time. The count was the right guide until the work was a row instead of a pixel.
#
# ## Where the time goes now
#
# The unit is an entry now, a pair of splat and tile. Its bytes: a record of nine floats; the tile's pixels stay
# in the nearest cache. Its operations are those of its rows: 18 with AVX-512, ten of them for the power of two. The
# rung above takes half as many again; the package about ten, since it multiplies the power of one row to get the next.

# %%
number = MOST_TIMED  # so few that no tile goes dark: every entry is drawn
rate = max(_native.fma_rate() for _ in range(3))
for rung in ("simd", "package"):
    pairs = work[rung, number].pairs
    nanoseconds = 1e6 * milliseconds[rung, number] / pairs
    print(f"{rung:8} {number} splats, {pairs} pairs: {nanoseconds:.0f} ns each, the time of "
          f"{nanoseconds * 1e-9 * rate:.0f} vector multiply-adds")  # fmt: skip
did = work["simd", number]
row_count = did.evaluated / TILE / did.pairs
print(f"rows a pair {row_count:.1f}, vector instructions a pair about {18 * row_count:.0f}, bytes a pair 36")
print(f"evaluations that mattered, of those in a row of sixteen: {100 * did.mattered / did.evaluated:.0f} %")

# %% [markdown]
# Thirty-six bytes for more than a hundred instructions: it is not the bandwidth of memory that binds. But
# many more independent multiply-adds fit into the same time. The difference is waiting: each step of a
# row needs the one before, and a list jumps about in memory. The package waits and computes less; that is its lead.
#
# ## The same on a GPU
#
# A GPU takes the same steps, and each has to be spread over thousands of invocations. Counting is easy: one
# [invocation](../docs/GLOSSARY.md#invocation) counts the tiles of one splat. In a prefix sum every number needs all the
# numbers before it. Inside a workgroup that can be arranged. Its invocations share [*workgroup
# memory*](../docs/GLOSSARY.md#workgroup-memory), a few kilobytes beside the arithmetic, and a
# [*barrier*](../docs/GLOSSARY.md#barrier) is a line that none of them crosses before all have reached it. With 256
# invocations, eight rounds do it. In each, an invocation adds the number 1, 2, 4, ... places before its own:

# %%
ENGINE = ROOT / "src" / "gsplat_edu" / "engine"
text = (ENGINE / "scan.wgsl").read_text()
print(text[text.index("fn scan_threads") : text.index("@compute")])

# %% [markdown]
# Between workgroups there is no barrier, and none may wait for another, which perhaps has not begun. So a longer sum
# takes three passes: each workgroup adds up a block of counts, one workgroup scans the blocks' sums, and each
# workgroup scans its block from there. "The next free place" of a list would again be an order of arrival. Instead each
# splat writes its pairs into its own places, and a stable sort by tile brings them together, near ones first.
#
# Then a workgroup takes a tile, and an invocation a pixel. All 256 pixels want the same splats, so they fetch 64 of
# them at a time into workgroup memory, and memory is read once for each tile instead of once for each pixel:

# %%
text = (ENGINE / "composite.wgsl").read_text()
print(text[text.index("fn load_splat") : text.index("    if (lane == 0u) {\n        done")])

if not gpu.available():
    print(gpu.where(), "- so the kernels above did not run")
else:
    drawn = gpu.Tiled(odd)
    expected, _ = oracle.oracle(odd, stop="tile")
    share = (np.abs(drawn.image - expected) / (oracle.tolerance(odd, wgsl=True)[0] + 1e-30)).max()
    print(f"ran on {gpu.where()}: {len(drawn.lists.splat)} pairs in {len(drawn.lists.begin) - 1} tiles")
    print(f"against the reference: largest difference {share:.3f} of its pixel's tolerance")
    near_to_far = [(np.diff(part) > 0).all() for part in np.split(drawn.lists.splat, drawn.lists.begin[1:-1])]
    assert share <= 1 and all(near_to_far)
print(f"bytes of a batch of 64 splats {64 * 48}, promised {LIMITS['max-compute-workgroup-storage-size']}")

# %% [markdown]
# Why not a larger batch? A core of a GPU hides the wait for memory by having other work at hand: while one
# [subgroup](../docs/GLOSSARY.md#subgroup) waits, another computes. The share of the subgroups that a core has room for
# and really holds is its [*occupancy*](../docs/GLOSSARY.md#occupancy). Registers and workgroup memory are divided among
# them, so a workgroup that takes twice the memory may leave half as many to switch to.
#
# ## The next failure
#
# All of this draws. To train, every splat needs its gradient: a sum over all the pixels that it touches,
# in all its tiles. Forward, a pixel gathers from many splats and nobody else writes to it. Backward, many
# pixels add to one splat, and tiles are drawn at the same time. The usual tool for this is the atomic
# addition, which waits in line where many add to the same place. And it adds in the order in which they
# happen to come. Random numbers, in place of the contributions of one splat's pixels, in a few orders:

# %%
contributions = rng.normal(size=5000).astype(np.float32)
sums = {float(np.cumsum(rng.permutation(contributions), dtype=np.float32)[-1]) for _ in range(20)}
print(f"20 orders, {len(sums)} different sums, from {min(sums):.7f} to {max(sums):.7f}")
print(f"exact to the last digit shown: {contributions.astype(float).sum():.7f}")
assert len(sums) > 5
assert max(sums) - min(sums) < 2 * 5000 * 2.0**-24 * np.abs(contributions).sum()

# %% [markdown]
# None of them is wrong, and no two runs of a training would be alike. A backward pass that is fast, and
# gives the same bits twice, will have to be arranged differently.
