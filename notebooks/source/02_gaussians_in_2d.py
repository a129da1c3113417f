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
# # 02 - Gaussians in two dimensions
#
# [Chapter 01](01_points.ipynb) gave its points an extent, and the extent had a rim. Below, a disc moves across
# a picture by fractions of a pixel. How much light it puts into the picture should not depend on where it is.
# It does, and it changes in jumps.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

from gsplat_edu import ALPHA_MIN, DILATION
from gsplat_edu.scene.gaussian_math import opacity_compensation

SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
DRAWN, SPOTS = (20_000, 41) if SHORT else (400_000, 161)
print(f"budget: {DRAWN} samples, {SPOTS} places{' (reduced)' if SHORT else ''}")

rng = np.random.default_rng(2)
places = np.linspace(-1.0, 1.0, SPOTS)
pixel_x, pixel_y = np.meshgrid(np.arange(-12.0, 13.0), np.arange(-12.0, 13.0))

discs = [(pixel_x - place) ** 2 + pixel_y**2 <= 2.3**2 for place in places]
fig, axes = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained")
for ax, i in zip(axes, (SPOTS // 2, 13 * SPOTS // 20), strict=False):
    ax.imshow(discs[i], cmap="gray", interpolation="nearest")
    ax.set(title=f"a disc of radius 2.3 px at {places[i]:.1f}", xticks=[], yticks=[])
    ax.axis((6.5, 17.5, 17.5, 6.5))
axes[2].plot(places, [disc.sum() for disc in discs], drawstyle="steps-mid")
axes[2].axhline(np.pi * 2.3**2, color="black", linestyle=":", label="its area")
axes[2].set(
    title="light of the disc", xlabel="column of its centre (px)", ylabel="sum (pixels)", ylim=(0, 24)
)
axes[2].legend()
plt.show()

# %% [markdown]
# ## A footprint without a rim
#
# We want a function of the offset from the centre: 1 in the middle, falling smoothly to nothing far away. Many
# functions do that, so ask for one thing more. To evaluate it quickly for a whole image it should separate into
# a factor for the columns and one for the rows, $g(x)\,g(y)$; and since a round blob must not reveal the
# directions of the grid, the product may depend on $r^2 = x^2 + y^2$ alone. Take logarithms, with $g(x) =
# e^{\eta(x^2)}$ and $\eta(0) = 0$:
#
# $$\eta(x^2) + \eta(y^2) = \eta(x^2 + y^2).$$
#
# A continuous function that turns sums into sums is a multiple of its argument. So there is one family, and no other:
#
# $$g(r) = e^{-r^2 / 2\sigma^2}.$$
#
# The number in the exponent is written so that $\sigma$ is the standard deviation, in pixels. The same question
# for the disc and the Gaussian: how much light is there, and how far is the picture from the one at offset 0?

# %%
bells = [np.exp(-((pixel_x - place) ** 2 + pixel_y**2) / (2 * 1.6**2)) for place in places]
fig, axes = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
for shapes, style in ((np.float64(discs), "steps-mid"), (np.array(bells), "default")):
    lights, misses = shapes.sum(axis=(1, 2)), ((shapes - shapes[SPOTS // 2]) ** 2).sum(axis=(1, 2))
    for ax, values in zip(axes, (lights, misses), strict=True):
        ax.plot(places, values, drawstyle=style)
        ax.set_xlabel("column of the centre (px)")
axes[0].set(title="light", ylabel="sum (pixels)", ylim=(0, 24))
axes[1].set(title="a loss with a slope", ylabel="squared difference")
axes[1].legend(["disc", "Gaussian"])
plt.show()
# The Gaussian came last. Its picture ends at some seven sigma, where it is down to exp(-24).
assert np.ptp(lights) < 1e-9 and np.all(np.diff(misses[: SPOTS // 2 + 1]) < 0)

# %% [markdown]
# ## Wide here, narrow there
#
# A round blob is a bad brush for an edge. Take a round one and pull it: each point $q$ of it goes to
# $p = A\,q$ with some matrix $A$. The value at $p$ is what was at $q = A^{-1}p$, so the exponent becomes
#
# $$|A^{-1}p|^2 = p^\top (A A^\top)^{-1} p = p^\top \Sigma^{-1} p, \qquad \Sigma = A A^\top,$$
#
# and the [footprint](../docs/GLOSSARY.md#footprint) of a splat with its centre at $\mu$ is
#
# $$g(p) = \exp\left(-\tfrac{1}{2}\,(p-\mu)^\top \Sigma^{-1} (p-\mu)\right).$$
#
# $\Sigma$ is the [covariance](../docs/GLOSSARY.md#covariance): if $q$ is drawn from a round Gaussian of variance 1,
# the mean of $p p^\top$ is $A A^\top$. It is symmetric, so it has perpendicular eigenvectors, and along one with
# eigenvalue $\lambda$ the exponent is $-s^2 / 2\lambda$: a bell of standard deviation $\sqrt{\lambda}$. The contours
# are ellipses with these axes. What is evaluated is never $\Sigma$ but its inverse, the
# [*conic*](../docs/GLOSSARY.md#conic), three numbers:
#
# $$\Sigma^{-1} = \frac{1}{\det\Sigma}
# \begin{pmatrix} \Sigma_{yy} & -\Sigma_{xy} \\ -\Sigma_{xy} & \Sigma_{xx} \end{pmatrix}.$$

# %%
pull = np.array([[3.0, 1.5], [0.5, 1.2]])
leaning = pull @ pull.T


def footprint(cov2d, x, y):
    """Evaluate the splat at offsets from its centre; peak 1."""
    (xx, xy), (_, yy) = cov2d
    conic_xx, conic_xy, conic_yy = np.array([yy, -xy, xx]) / (xx * yy - xy * xy)
    return np.exp(-0.5 * (conic_xx * x * x + conic_yy * y * y) - conic_xy * x * y)


def sampling_error(cov2d):
    """Return the standard deviation of a sample covariance: sqrt((S_ii S_jj + S_ij²) / n)."""
    return np.sqrt((np.outer(np.diag(cov2d), np.diag(cov2d)) + cov2d**2) / DRAWN)


samples = rng.normal(size=(DRAWN, 2)) @ pull.T
sampled = samples.T @ samples / DRAWN
assert np.all(np.abs(sampled - leaning) < 5 * sampling_error(leaning))
assert np.isclose(footprint(leaning, *pull @ [0.6, 0.8]), np.exp(-0.5), rtol=1e-12)  # |q| = 1
print("A A' =", leaning.tolist(), " from samples:", sampled.round(2).tolist())

# %% [markdown]
# > **Why this bound.** The covariance of $n$ samples is itself random, and `sampling_error` is its standard
# > deviation. A normal number strays five of them from its mean about once in two million draws. So if the assertion
# > fails, the formula is wrong and not the luck.
#
# ## Three numbers that are not always an ellipse
#
# A splat will be found by changing its numbers a little, again and again. The plain way is to keep the
# three of $\Sigma$ and to change those. Take the ellipse above and push its off-diagonal entry.

# %%
fine_x, fine_y = np.meshgrid(np.linspace(-8, 8, 161), np.linspace(-8, 8, 161))
pushed = [leaning + extra * np.array([[0.0, 1.0], [1.0, 0.0]]) for extra in (0.0, 0.75, 1.35)]
fig, axes = plt.subplots(1, 3, figsize=(11.5, 3.7), layout="constrained")
for ax, cov2d in zip(axes, pushed, strict=True):
    values = np.clip(footprint(cov2d, fine_x, fine_y), 0, 2)
    picture = ax.imshow(values, extent=(-8.05, 8.05, 8.05, -8.05), cmap="cividis", vmin=0, vmax=2)
    lengths, directions = np.linalg.eigh(cov2d)
    for arm in (directions * np.sqrt(np.maximum(lengths, 0.0))).T:
        ax.plot([-arm[0], arm[0]], [-arm[1], arm[1]], color="white", linewidth=1.5)
    title = f"xy = {cov2d[0, 1]:.2f}, eigenvalues {lengths[0]:.2f}, {lengths[1]:.2f}"
    ax.set(title=title.replace("-", "\N{MINUS SIGN}"), xlabel="x (px)", ylabel="y (px)")
fig.colorbar(picture, ax=axes, label="value of the splat, cut at 2")
plt.show()
peaks = [footprint(cov2d, fine_x, fine_y).max() for cov2d in pushed]
print("largest value in the picture:", [f"{peak:.3g}" for peak in peaks])
assert peaks[0] == 1.0 and peaks[2] > 1e3

# %% [markdown]
# In the middle the ellipse has all but become a line. One small push further an eigenvalue is negative: along that
# axis the exponent grows, the contours are hyperbolas, and what should have been a blob is brightest at infinity.
# The border is where $\Sigma_{xy}^2 = \Sigma_{xx}\Sigma_{yy}$, and a step on the three numbers can cross it.
#
# So do not store $\Sigma$. Store $A$, in whatever form, and multiply. For any direction $w$
#
# $$w^\top A A^\top w = |A^\top w|^2 \ge 0,$$
#
# so no entry of $A$, wherever it is pushed, can make an eigenvalue negative.

# %%
triples = rng.normal(size=(10_000, 3))
free = np.stack([triples[:, [0, 1]], triples[:, [1, 2]]], axis=1)
product = (factors := rng.normal(size=(10_000, 2, 2))) @ factors.transpose(0, 2, 1)
proper = [(np.linalg.eigvalsh(matrices)[:, 0] > -1e-12).mean() for matrices in (free, product)]
print(f"covariances among 10,000: symmetric {100 * proper[0]:.1f} %, A A' {100 * proper[1]:.0f} %")
assert proper[1] == 1.0 and proper[0] < 0.5

# %% [markdown]
# ## Why the peak is 1
#
# Statistics divides a Gaussian by its integral. In the coordinates $q$ that is
# $\int e^{-x^2/2}dx \int e^{-y^2/2}dy = 2\pi$, and $p = Aq$ makes areas larger by
# $|\det A| = \sqrt{\det\Sigma}$:
#
# $$\int g \, dp = 2\pi\sqrt{\det\Sigma}.$$
#
# Divided by it, a larger splat would be fainter, and a wall of big splats transparent. Without the division the
# value at the centre is the opacity there, whatever the size. The integral is the total amount of paint, and a
# sum over pixels should equal it.

# %%
mass = 2 * np.pi * np.sqrt(np.linalg.det(leaning))
wide_x, wide_y = np.meshgrid(np.arange(-40.0, 41.0), np.arange(-40.0, 41.0))
summed = footprint(leaning, wide_x - 0.3, wide_y + 0.2).sum()
print(f"2 pi sqrt(det) = {mass:.6f}, sum over pixels {summed:.6f}")
# A sum over a grid counts the frequencies 2 pi k of the bell to its mass. Its spectrum at the four nearest ones
# is at most exp(-2 pi² lambda_min) of the mass; twice that covers those behind them.
assert abs(summed / mass - 1) < 8 * np.exp(-2 * np.pi**2 * np.linalg.eigvalsh(leaning)[0])

# %% [markdown]
# ## Narrower than a pixel
#
# The tolerance in that check is a warning. It is tiny when the narrowest axis is a pixel wide. Each pixel takes the
# value at one place, and a splat can be so narrow that it lies between all of these places. In one dimension the sum
# over pixels at $k$ of a bell at $x$ can be written with the bell's frequencies
# ([Poisson](../docs/GLOSSARY.md#poisson-summation)'s summation):
#
# $$\sum_k e^{-(k-x)^2/2\sigma^2} = \sqrt{2\pi}\,\sigma
# \left(1 + 2\sum_{m \ge 1} e^{-2\pi^2 m^2\sigma^2} \cos 2\pi m x\right).$$
#
# Why only these waves? One with $m$ whole periods from a pixel to the next has the same value at every pixel, so that
# the pixels cannot tell it from a constant; all others cancel in the sum. The 1 is what should be there. The rest is
# what the position does to it: it grows quickly below $\sigma = 1$.
#
# > **Predict.** Five round splats, the narrowest a tenth of a pixel wide and the widest one pixel, move along a line.
# > For which of them does the light depend on where they are? A variance of 0.3 is then added to each: for which does
# > it still?

# %%
titles = ("sampled as it is", f"after adding {DILATION} px², vertical axis enlarged 200 times")


def light(width, added):
    """Sum a round splat over the pixels as it moves along (x, x / 2), against its mass."""
    variance = width**2 + added
    splats = [footprint(variance * np.eye(2), pixel_x - place, pixel_y - 0.5 * place) for place in places]
    return np.sum(splats, axis=(1, 2)) / (2 * np.pi * variance)


fig, axes = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
for width, style in zip((0.1, 0.2, 0.3, 0.6, 1.0), ("-", "--", "-.", ":", "-"), strict=True):
    before, after = light(width, 0.0), light(width, DILATION)
    for ax, curve, title in zip(axes, (before, after), titles, strict=True):
        ax.plot(places, curve, style, label=f"sigma {width:.1f} px")
        ax.set(title=title, xlabel="column of the centre (px)", ylabel="sum over pixels / mass")
    print(f"sigma {width:.1f} px: peak to peak {np.ptp(before):.4f} before, {np.ptp(after):.4f} after")
    # Two axes, each 1 plus or minus 2 exp(-2 pi² variance): peak to peak at most 8 of these, and a tenth more
    # for their product and the next frequencies.
    assert np.ptp(after) < 1.1 * 8 * np.exp(-2 * np.pi**2 * (width**2 + DILATION))
    assert np.ptp(before) > 1 or width > 0.3
axes[0].set(ylim=(0, 4))
axes[1].set(ylim=(0.99, 1.01))
axes[0].legend()
plt.show()

# %% [markdown]
# > **Why this bound.** Behind the dilation the variance is at least $0.3$. The first wave then has the strength
# > $2 e^{-2\pi^2 \cdot 0.3}$, half a percent; in the next one the exponent is four times as large, which leaves
# > nothing that would show.
#
# On the left the splats of a fifth of a pixel and less are there and gone again: several times too bright when a
# pixel happens to be at the centre, dark in between. Many of them glitter. On the right are the same, repaired.
#
# ## The fix: no splat narrower than a pixel
#
# A pixel of a camera is no point either. It gathers light from an area. Say it gathers with a bell of variance
# $\delta$; then what it sees of a splat is not the splat but its *convolution* with that bell. And a
# convolution is what happens to densities when independent random numbers are added. Variances of sums add,
# and a sum of Gaussians is Gaussian, so
#
# $$\Sigma \longrightarrow \Sigma + \delta I, \qquad \delta = 0.3.$$
#
# By the formula above this $\delta$ leaves a ripple of $2e^{-2\pi^2\delta}$ in one dimension. A smaller one
# would flicker, a larger one would blur everything. The value is that of the code of Kerbl et al. (2023), and
# stands once, in [gsplat_edu.base.constants](../src/gsplat_edu/base/constants.py).

# %%
added_up = samples + rng.normal(size=(DRAWN, 2)) * np.sqrt(DILATION)
dilated = leaning + DILATION * np.eye(2)
assert np.all(np.abs(added_up.T @ added_up / DRAWN - dilated) < 5 * sampling_error(dilated))
print(f"ripple left in one dimension: {2 * np.exp(-2 * np.pi**2 * DILATION):.4f}")

# %% [markdown]
# ## What it costs
#
# A convolution spreads light and adds none. The line above was about normalised bells; ours have peak 1, before and
# after. So the [dilated](../docs/GLOSSARY.md#dilation) splat is larger *and* as bright in the middle, and paints
#
# $$\frac{2\pi\sqrt{\det(\Sigma + \delta I)}}{2\pi\sqrt{\det\Sigma}}$$
#
# times what it should. For large splats that is 1. For small ones it grows without bound: everything that is
# far away gets fat and bright. The repair is in the same formula. Multiply the opacity by the inverse of that factor,
#
# $$\frac{o'}{o} = \sqrt{\frac{\det\Sigma}{\det(\Sigma + \delta I)}},$$
#
# as Mip-Splatting (Yu et al. 2024) does. In the package it is `opacity_compensation`, in
# [gsplat_edu.scene.gaussian_math](../src/gsplat_edu/scene/gaussian_math.py).

# %%
MODES = ("as it is", "dilated", "dilated, compensated")


def draw(cov2d, mode, x, y):
    """Draw a splat in one of three ways: as it is, dilated, dilated and compensated."""
    factor = opacity_compensation(cov2d) if mode == MODES[2] else 1.0
    return factor * footprint(cov2d if mode == MODES[0] else cov2d + DILATION * np.eye(2), x, y)


rho = np.sqrt(np.linalg.det(leaning) / np.linalg.det(dilated))
assert np.isclose(rho, opacity_compensation(leaning), rtol=1e-12, atol=0)
sigmas = np.geomspace(0.05, 2.5, 25)
within = (np.arange(16) + 0.5) / 16 - 0.5  # positions inside a pixel
energy = {mode: [] for mode in MODES}
for mode in MODES:
    for sigma in sigmas:
        splats = [draw(sigma**2 * np.eye(2), mode, pixel_x - x, pixel_y - y) for x in within for y in within]
        energy[mode].append(np.sum(splats, axis=(1, 2)) / (2 * np.pi * sigma**2))

fig, ax = plt.subplots(figsize=(6.6, 4), layout="constrained")
for mode, mark, size in zip(MODES, ("x", "s", "."), (11, 6, 6), strict=True):
    low, high, mean = (f(energy[mode], axis=1) for f in (np.min, np.max, np.mean))
    ax.fill_between(sigmas, np.maximum(low, 1e-2), high, alpha=0.25)
    ax.plot(sigmas, mean, mark, markersize=size, label=f"{mode}: mean, range over positions")
ax.set(title="how much a splat paints, against what it should", xscale="log", yscale="log", ylim=(1e-2, 3e2))
ax.set(xlabel="standard deviation of the splat (px)", ylabel="sum over pixels / mass")
ax.legend()
plt.show()

# The ripple of both axes; the splats here are narrow enough for the 25 pixels, to five standard deviations.
ripple = 1.1 * 4 * np.exp(-2 * np.pi**2 * DILATION)
assert np.abs(np.array(energy[MODES[2]]) - 1).max() < ripple
assert np.abs(np.array(energy["dilated"]) / (1 + DILATION / sigmas[:, None] ** 2) - 1).max() < ripple

# %% [markdown]
# As they are, splats paint the right amount *on average*, which helps no single one. The same in a picture: a fan of
# thin blades, in its own size in the first column, then from further and further away. Overlapping light is added.

# %%


def fan_picture(edge, mode):
    """Draw 16 blades around the middle of an image whose edge is given in pixels."""
    zoom = edge / 64
    x, y = np.meshgrid(np.arange(edge) - edge / 2 + 0.37, np.arange(edge) - edge / 2 + 0.37)
    image = np.zeros((edge, edge))
    for angle in np.arange(16) * 2 * np.pi / 16 + 0.1:
        along = np.array([np.cos(angle), np.sin(angle)])
        blade = zoom**2 * (0.6**2 * np.eye(2) + 4.5**2 * np.outer(along, along))
        image += 0.9 * draw(blade, mode, x - 14 * zoom * along[0], y - 14 * zoom * along[1])
    return image


fans = {mode: [fan_picture(edge, mode) for edge in (64, 16, 8)] for mode in MODES}
fig, axes = plt.subplots(3, 3, figsize=(7, 7.4), layout="constrained")
for row, mode in zip(axes, MODES, strict=True):
    for ax, picture in zip(row, fans[mode], strict=True):
        ax.imshow(picture, cmap="gray", vmin=0, vmax=0.9, interpolation="nearest")
        ax.set(title=f"{mode}\n{len(picture)} px", xticks=[], yticks=[])
plt.show()
means = {mode: np.array([picture.mean() for picture in fans[mode]]) for mode in MODES}
for mode in MODES:
    print(f"{mode:22s} mean of the picture at 64, 16, 8 px:", means[mode].round(4))
assert means["dilated"][2] > 3 * means["dilated"][0]
assert np.abs(means[MODES[2]] / means[MODES[2]][0] - 1).max() < ripple

# %% [markdown]
# The course renders without the compensation, as the paper does; it is an option of the renderer, `antialiased`.
# Opacities that were found under one rule are wrong under the other.
#
# ## How far a splat reaches
#
# A Gaussian is nowhere zero. Without an end every splat would have to be evaluated at every pixel. An image has steps
# of 1/255, and what changes a pixel by less than one step need not be drawn. With opacity $o$ its
# [*alpha*](../docs/GLOSSARY.md#alpha) is $o\,g$, and
#
# $$\alpha = o\,e^{-m^2/2} \ge \frac{1}{255} \quad\Longleftrightarrow\quad m^2 = d^\top\Sigma^{-1}d \le 2\ln(255\,o),$$
#
# an ellipse that reaches $\sqrt{2\ln(255\,o)}$ standard deviations. Its bounding box has the half extents
# $\sqrt{2\ln(255\,o)\,\Sigma_{xx}}$ and $\sqrt{2\ln(255\,o)\,\Sigma_{yy}}$, because $x = a^\top q$, with $a$
# the first row of $A$, is at most $|a|\,|q|$, and $|a|^2 = \Sigma_{xx}$. The usual choice is 3 standard
# deviations, whatever the opacity.

# %%
for opacity in (0.99, 0.353, 0.05):
    reach = np.sqrt(2 * np.log(opacity / ALPHA_MIN))
    left = opacity * np.exp(-4.5) / ALPHA_MIN
    print(f"opacity {opacity:5.3f}: reach {reach:.2f} sigma, alpha at 3 sigma {left:.2f} / 255")

step = 0.02
grid_x, grid_y = np.meshgrid(np.arange(-14, 14, step), np.arange(-8, 8, step))
alpha = 0.8 * footprint(leaning, grid_x, grid_y)
alive = alpha >= ALPHA_MIN
reach = np.sqrt(2 * np.log(0.8 / ALPHA_MIN) * np.diag(leaning))
found = np.array([np.abs(grid_x[alive]).max(), np.abs(grid_y[alive]).max()])
assert np.all(found <= reach) and np.all(reach - found < 2 * step)  # the grid may miss the tip by a step
share_lost = 1 - alpha[alive].sum() * step**2 / (0.8 * mass)
print(f"half extents: derived {reach.round(2)}, counted {found.round(2)} px; light lost {share_lost:.4f}")
# Outside m the integral is exp(-m²/2) of the whole, which at this m is 1 / (255 o). Counting cells along the rim
# errs by at most its length (8 extents at most) times a cell's edge times the alpha there.
assert abs(share_lost - ALPHA_MIN / 0.8) < 8 * reach.max() * step * ALPHA_MIN / (0.8 * mass)

# %% [markdown]
# Opaque splats reach further than 3 standard deviations, and a box of that size cuts them above the floor; faint
# ones end long before it. The share of light that the floor takes is $1/(255\,o)$ exactly. The NumPy renderer of
# this course can do both, the fast renderers of later chapters do the exact extent.
#
# ## The next failure
#
# A splat of this chapter is smooth, can lean, does not flicker and ends somewhere. It is still a mark on a picture.
# Below, a flat round patch is seen from the front and then more and more from the side, under the first splat.

# %%
patch = rng.normal(size=(400, 2))
angles = np.linspace(0.0, 2 * np.pi, 100)
fig, axes = plt.subplots(1, 3, figsize=(10, 3.6), layout="constrained")
for ax, degrees in zip(axes, (0, 50, 80), strict=True):
    across = patch[:, 0] * np.cos(np.radians(degrees))
    ax.plot(across, patch[:, 1], ".", markersize=3, label="the patch, from there")
    ax.plot(2 * np.cos(angles), 2 * np.sin(angles), linewidth=2, label="the splat, two sigma")
    ax.set(title=f"{degrees} degrees", xlabel="x (px)", ylabel="y (px)", aspect="equal")
    ax.axis((-4, 4, 4, -4))
axes[0].legend()
plt.show()
print(f"variance across at 80 degrees: patch {np.var(across):.3f}, splat 1")
assert np.var(across) < 0.05

# %% [markdown]
# Its three numbers would have to be found again for every picture, and for one that nobody has taken there is no way
# to find them. The blob has to be put where the thing is: into the world, with an extent in three directions. What
# it looks like from anywhere must follow from that. This is [chapter 03](03_gaussians_in_3d.ipynb).
