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
# # 06 - A colour that knows who is looking
#
# At the end of [chapter 05](05_sort_and_composite.ipynb) a glossy sphere had to be painted anew for every camera.
# That is no scene. A scene is a set of numbers that is fixed before anyone looks, and three of them per splat are one
# colour for all. This page first asks how good one colour can be, and then which numbers to add.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

from gsplat_edu import C0, eval_sh, orbit_camera, quat_to_R, render_gaussians, sh_basis, sphere_shell
from gsplat_edu.base.constants import SH_OFFSET
from gsplat_edu.scene.sh import num_coefficients, sh_rotation

SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
EDGE, SPLATS = (64, 1200) if SHORT else (128, 2500)
print(f"budget: {SPLATS} splats, images of {EDGE} px{' (reduced)' if SHORT else ''}")

means, cov3ds, body, opacities = sphere_shell(SPLATS, s_t=0.06 * np.sqrt(2500 / SPLATS))
body = 0.1 + 0.35 * body
SATIN, GLOSS = 4.0, 0.7
LAMP = np.array([-0.45, -0.6, -0.66]) / np.linalg.norm([-0.45, -0.6, -0.66])


def view_from(azimuth, elevation=-0.2):
    return orbit_camera(azimuth, elevation, EDGE, 1.17 * EDGE)


def directions_from(camera):
    """Unit vectors from the camera to the mean of every splat."""
    d = means - camera.eye
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


axes_of_gloss = LAMP - 2 * (means @ LAMP)[:, None] * means


def glossy(d):
    """Colour of every splat seen along d: its body's, and a lobe around the mirrored light."""
    return body + GLOSS * np.exp(SATIN * ((axes_of_gloss * d).sum(axis=-1) - 1))[..., None]


around = [view_from(a, e) for e in (-0.7, 0.0, 0.7) for a in np.arange(8) * np.pi / 4]
seen = np.array([((camera.eye - means) * means).sum(axis=-1) > 0 for camera in around])
from_all = np.array([glossy(directions_from(camera)) for camera in around])
constant = (seen[..., None] * from_all).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)[:, None]


def picture(camera, splat_colors):
    return render_gaussians(camera, means, cov3ds, splat_colors, opacities)[0]


camera = view_from(-0.45)
truth, best_constant = picture(camera, glossy(directions_from(camera))), picture(camera, constant)
fig, axes = plt.subplots(1, 3, figsize=(10.5, 3.5), layout="constrained")
for ax, image, title in zip(
    axes, (truth, best_constant), ("the glossy sphere", "one colour per splat"), strict=False
):
    ax.imshow(np.clip(image, 0, 1), interpolation="nearest")
    ax.set(title=title, xticks=[], yticks=[])
missing = axes[2].imshow(
    (truth - best_constant)[..., 1], cmap="PuOr", vmin=-0.6, vmax=0.6, interpolation="nearest"
)
axes[2].set(title="what is missing", xticks=[], yticks=[])
fig.colorbar(missing, ax=axes[2], label="difference, green channel")
plt.show()
assert np.abs(truth - best_constant).max() > 0.2

# %% [markdown]
# The constant is the mean over those of 24 cameras that stand in front of a splat, which no constant can beat in the
# sum of squares. The highlight has dissolved: a little of it is everywhere, and too much where none should be. So a
# splat needs a *function*: direction in, colour out. The direction is $d$, the unit vector from the camera to the
# mean, and there are three functions per splat, one for each of red, green and blue.

# %% [markdown]
# ## Polynomials on a sphere
#
# A function on the sphere has infinitely many values, and a splat should have few numbers. The smooth functions that
# cost least to evaluate are polynomials in the components $x, y, z$ of $d$. There are fewer of them than it seems,
# because $x^2 + y^2 + z^2 = 1$ makes many equal: $z^4$ is also $z^2 (1 - x^2 - y^2)$. How many are there up to
# degree $k$ that differ somewhere on the sphere? Evaluate all monomials at random directions and ask for the rank.
#
# > **Predict.** There are 20 monomials in three variables up to degree 3. How many of them are independent on the
# > sphere?

# %%
rng = np.random.default_rng(6)
random_dirs = rng.normal(size=(200, 3))
random_dirs /= np.linalg.norm(random_dirs, axis=1, keepdims=True)
for degree in range(4):
    powers = [(i, j, k) for i in range(4) for j in range(4) for k in range(4) if i + j + k <= degree]
    monomials = np.stack([np.prod(random_dirs**p, axis=-1) for p in powers], axis=-1)
    rank = np.linalg.matrix_rank(monomials)
    print(f"degree {degree}: {len(powers):2d} monomials, {rank:2d} of them independent on the sphere")
    assert rank == (degree + 1) ** 2 == num_coefficients(degree)

# %% [markdown]
# $(k + 1)^2$: one for degree 0, and three, five, seven more for the degrees after it. Any sixteen that span them would
# do. One choice is better than others. Measure functions by the integral over the sphere,
#
# $$\langle f, g \rangle = \int_{S^2} f\, g \; \mathrm{d}\Omega,$$
#
# and take functions $b_i$ with $\langle b_i, b_j \rangle = 1$ for $i = j$ and 0 otherwise. Then the best coefficients
# of any $f$ are $c_i = \langle f, b_i \rangle$, each found without the others, and a coefficient stays what it is when
# a degree is added. A training can begin with degree 0 and switch on the next ones later.
#
# The integral is exact as a sum. In $z$, take Gauss-Legendre nodes ($n$ of them are exact to degree $2n - 1$); around
# the axis, $m$ equal steps (exact to degree $m - 1$: a wave that fits fewer than $m$ times around sums to zero).
# Products of two polynomials of degree 3 have degree 6, so four nodes by seven steps, 28 directions, will do.


# %%
def sphere_nodes(n, m):
    """Directions and weights; the weights sum to the area, 4 pi."""
    z, w = np.polynomial.legendre.leggauss(n)
    azimuth = 2 * np.pi * np.arange(m) / m
    r = np.sqrt(1 - z**2)[:, None]
    nodes = np.stack(np.broadcast_arrays(r * np.cos(azimuth), r * np.sin(azimuth), z[:, None]), axis=-1)
    return nodes.reshape(-1, 3), np.repeat(w * 2 * np.pi / m, m)


nodes, weights = sphere_nodes(4, 7)
x, y, z = nodes.T
sixteen = [1 + 0 * x, y, z, x, x * y, y * z, z**2, x * z, x**2 - y**2]
sixteen += [
    y * (3 * x**2 - y**2),
    x * y * z,
    y * z**2,
    z**3,
    x * z**2,
    z * (x**2 - y**2),
    x * (x**2 - 3 * y**2),
]
harmonics = []
for polynomial in sixteen:
    explained = sum((weights * polynomial * b).sum() * b for b in harmonics)
    rest = polynomial - explained
    harmonics.append(rest / np.sqrt((weights * rest**2).sum()))
by_hand = np.stack(harmonics, axis=-1) * (-1.0) ** np.arange(16)

package = sh_basis(nodes)
gram = package.T @ (weights[:, None] * package)
coarse_nodes, coarse_weights = sphere_nodes(3, 7)
coarse = sh_basis(coarse_nodes).T @ (coarse_weights[:, None] * sh_basis(coarse_nodes))
print(f"Gram-Schmidt against sh_basis: {np.abs(by_hand - package).max():.1e}")
print(f"28 directions: orthonormal to {np.abs(gram - np.eye(16)).max():.1e}")
print(f"21 directions: orthonormal to {np.abs(coarse - np.eye(16)).max():.1e}, the sum is not exact any more")
print(f"the first is constant: {package[0, 0]:.6f} = 1 / (2 sqrt(pi)) = {C0:.6f}")
assert np.abs(by_hand - package).max() < 1e-13 and np.abs(gram - np.eye(16)).max() < 1e-13
assert np.abs(coarse - np.eye(16)).max() > 0.1

# %% [markdown]
# The loop above is Gram and Schmidt's: take a polynomial, remove what earlier ones explain, scale the rest to length
# one. It yields every constant of `sh_basis` in [gsplat_edu.scene.sh](../src/gsplat_edu/scene/sh.py) up to rounding,
# which for sums of 28 terms of order one is about $10^{-14}$; ten times that is asserted. Only the order and the signs
# are a convention: within a degree from $m = -l$ to $l$, and every second one of the sixteen negative. They are those
# of Kerbl et al.'s code, and a scene file means nothing without them. The functions are called real
# [spherical harmonics](../docs/GLOSSARY.md#spherical-harmonics).

# %%
polar, azimuth = np.meshgrid(np.linspace(0, np.pi, 60), np.linspace(-np.pi, np.pi, 120), indexing="ij")
chart = [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
chart = np.stack(chart, axis=-1)
fig, axes = plt.subplots(4, 7, figsize=(12, 4.6), layout="constrained")
for ax in axes.flat:
    ax.set_axis_off()
for i in range(16):
    degree = int(np.sqrt(i))
    ax = axes[degree, 3 + i - degree * (degree + 1)]
    lobes = ax.imshow(sh_basis(chart)[..., i], cmap="PuOr", vmin=-0.75, vmax=0.75)
    ax.set(title=f"b{i}, degree {degree}", xticks=[], yticks=[])
    ax.set_axis_on()
for ax in axes.flat:
    if not ax.get_title():
        ax.remove()
fig.colorbar(lobes, ax=list(fig.axes), label="value")
fig.suptitle("the 16 harmonics; azimuth from left to right, +z at the top and \N{MINUS SIGN}z at the bottom")
plt.show()

# %% [markdown]
# ## A lobe in sixteen numbers
#
# One splat's highlight is a lobe around an axis $a$: $f(d) = e^{\xi (a \cdot d - 1)}$ with a width of about
# $1/\sqrt{\xi}$ radians. Its coefficients are sixteen integrals. What a fit of degree $k$ leaves out follows from
# Pythagoras: $\|f - f_k\|^2 = \|f\|^2 - \sum_i c_i^2$. The lobe is no polynomial, so that the sum takes more
# directions, and so many terms may round to $10^{-12}$.

# %%
fine, fine_weights = sphere_nodes(80, 160)
fine_basis = sh_basis(fine)
print(f"{len(fine):,} directions")


def lobe(d, axis, sharpness):
    return np.exp(sharpness * (d @ axis - 1))


def coefficients_of(values):
    return fine_basis.T @ (fine_weights * values)


one = (axes_of_gloss @ [0.8, -0.5, 0.3]).argmax()  # its lobe is not at a pole of the chart
axis = axes_of_gloss[one]
values = lobe(fine, axis, SATIN)
c = coefficients_of(values)
root = np.sqrt(fine_weights)[:, None]
joint = np.linalg.lstsq(root * fine_basis, root[:, 0] * values, rcond=None)[0]
assert np.allclose(joint, c, rtol=0, atol=1e-12)
energy, misses = (fine_weights * values**2).sum(), []
for degree in range(4):
    k = num_coefficients(degree)
    left_out = (fine_weights * (values - fine_basis[:, :k] @ c[:k]) ** 2).sum()
    assert abs(left_out - (energy - (c[:k] ** 2).sum())) < 1e-12
    misses.append(np.sqrt(left_out / energy))
    print(f"degree {degree}: {k:2d} numbers, relative error {100 * misses[-1]:5.1f} %")
assert np.all(np.diff(misses) < -0.1)

# %% [markdown]
# Each degree costs more numbers than the one before. The first assertion fits all sixteen at once by least squares
# and finds what the integrals found one by one.
#
# ## The colour of a splat
#
# Two conventions turn harmonics into colour. A training starts from coefficients near zero, and zero should not be
# black: 0.5 is added. And a sum of waves can go below zero, which a colour cannot: it is cut off there.
#
# $$\mathrm{colour}(d) = \max\left(0,\; \sum_{i=0}^{15} b_i(d)\, c_i + 0.5\right)$$
#
# For a colour that is nowhere negative the cut can only help: it moves a wrong value towards the right one. The
# coefficients below follow from the lobe's, with the body's colour and the offset taken to $b_0$, whose constant value
# is `C0`.

# %%
node_dirs, node_weights = sphere_nodes(20, 40)
lobes_at_nodes = np.exp(SATIN * (axes_of_gloss @ node_dirs.T - 1))
gloss = GLOSS * (lobes_at_nodes * node_weights) @ sh_basis(node_dirs)
sh = np.repeat(gloss[:, :, None], 3, axis=2)
sh[:, 0] += (body - SH_OFFSET) / C0

d = directions_from(camera)
written_out = np.maximum(0, np.einsum("ni,nic->nc", sh_basis(d), sh) + 0.5)
assert np.allclose(eval_sh(3, sh, d), written_out, rtol=0, atol=1e-13)
exact_colors = glossy(d)
unfloored = np.einsum("ni,nic->nc", sh_basis(d), sh) + SH_OFFSET
assert np.all(np.abs(written_out - exact_colors) <= np.abs(unfloored - exact_colors))

cameras = [view_from(azimuth) for azimuth in (-1.1, -0.45, 0.2)]
on_chart = GLOSS * lobe(chart, axis, SATIN)
fig, axes = plt.subplots(4, 5, figsize=(12, 9.2), layout="constrained", height_ratios=[0.52, 1, 1, 1])
axes[0, 0].imshow(on_chart, cmap="magma", vmin=0, vmax=GLOSS)
axes[0, 0].set(title="gloss of one splat", xticks=[], yticks=[])
errors = np.zeros((3, 4))
for row, camera in enumerate(cameras):
    d = directions_from(camera)
    truth = picture(camera, glossy(d))
    azimuth = np.degrees(np.arctan2(camera.eye[0], -camera.eye[2]))
    axes[row + 1, 0].imshow(np.clip(truth, 0, 1), interpolation="nearest")
    title = f"truth, azimuth {azimuth:.0f} degrees".replace("-", "\N{MINUS SIGN}")
    axes[row + 1, 0].set(title=title, xticks=[], yticks=[])
    for degree in range(4):
        image = picture(camera, eval_sh(degree, sh, d))
        errors[row, degree] = np.abs(image - truth).mean()
        axes[row + 1, degree + 1].imshow(np.clip(image, 0, 1), interpolation="nearest")
        axes[row + 1, degree + 1].set(title=f"degree {degree}", xticks=[], yticks=[])
for degree in range(4):
    k = num_coefficients(degree)
    fitted = sh_basis(chart)[..., :k] @ gloss[one, :k]
    shown = axes[0, degree + 1].imshow(fitted, cmap="magma", vmin=0, vmax=GLOSS)
    axes[0, degree + 1].set(title=f"degree {degree}", xticks=[], yticks=[])
fig.colorbar(shown, ax=axes[0], label="gloss")
plt.show()
print("mean error of the three views, degrees 0 to 3:", *(f"{e:.4f}" for e in errors.mean(axis=0)))
assert np.all(np.diff(errors, axis=1) < 0) and errors[:, 3].max() < 0.2 * errors[:, 0].min()

# %% [markdown]
# One set of numbers, three cameras, and the highlight is where it belongs. Degree 1 knows the side that is brighter,
# degree 2 finds the place, degree 3 sharpens it.
#
# ## When the scene turns
#
# The coefficients describe functions of a direction in the world. Turn the scene by $R$ and they have to turn as
# well: the new function at $d$ is the old one at $R^\top d$. A rotated polynomial is a polynomial of the same degree,
# so each degree keeps to itself. Degree 0 stays. Degree 1 is a linear function, $C_1$ its harmonics' constant,
# $C_1\,(-c_1 y + c_2 z - c_3 x) = g \cdot d$, an arrow $g = C_1\,(-c_3, -c_1, c_2)$, and an arrow turns by $R$. The
# higher ones need small matrices; `sh_rotation` makes them.

# %%
R = quat_to_R([0.7, 0.2, -0.5, 0.3])
arrow = R @ np.array([-c[3], -c[1], c[2]])
turned_first = np.array([-arrow[1], arrow[2], -arrow[0]])
assert np.allclose(turned_first, sh_rotation(1, R) @ c[1:4], rtol=0, atol=1e-13)
again = coefficients_of(lobe(fine, R @ axis, SATIN))
turned_all = np.append(c[0], sh_rotation(3, R) @ c[1:])
print(f"turned coefficients against those of the turned lobe: {np.abs(turned_all - again).max():.1e}")
assert np.abs(turned_all - again).max() < 1e-12
levels = [slice(level**2, (level + 1) ** 2) for level in range(4)]
print("length of each degree:", *(f"{np.linalg.norm(c[level]):.4f}" for level in levels))
print("and after turning:    ", *(f"{np.linalg.norm(again[level]):.4f}" for level in levels))

# %% [markdown]
# ## What three degrees cannot do
#
# Sharpen the lobe. The integrals are as easy as before, and the fit is not.

# %%
MIRROR = 80.0
STROKES = dict(
    zip(range(4), (("#999999", ":"), ("#009e73", "-."), ("#d55e00", "--"), ("#0072b2", "-")), strict=True)
)
angle = np.radians(np.linspace(-180, 180, 361))
across = np.cross(axis, [0, 1, 0]) / np.linalg.norm(np.cross(axis, [0, 1, 0]))
great_circle = np.cos(angle)[:, None] * axis + np.sin(angle)[:, None] * across
fig, panels = plt.subplots(1, 3, figsize=(14, 3.8), layout="constrained")
for ax, sharpness in zip(panels, (SATIN, MIRROR, MIRROR), strict=True):
    values = lobe(fine, axis, sharpness)
    fitted = coefficients_of(values)
    ax.plot(np.degrees(angle), lobe(great_circle, axis, sharpness), color="black", label="the lobe")
    for degree, (color, dash) in STROKES.items():
        k = num_coefficients(degree)
        curve = sh_basis(great_circle)[:, :k] @ fitted[:k]
        ax.plot(np.degrees(angle), curve, dash, color=color, label=f"degree {degree}")
    ax.set(
        title=f"sharpness {sharpness:.0f}",
        xlabel="angle to the axis (degrees)",
        ylabel="gloss (1 at the peak)",
    )
    if ax is not panels[2]:
        share = (fitted**2).sum() / (fine_weights * values**2).sum()
        print(f"sharpness {sharpness:.0f}: degree 3 has {100 * share:.1f} % of the energy,", end=" ")
        print(f"peak {curve.max():.3f}, lowest {curve.min():.3f}")
panels[2].set(title="sharpness 80, the lowest part enlarged", ylim=(-0.04, 0.12))
panels[0].legend()
plt.show()
assert share < 0.25 and curve.max() < 0.3 and curve.min() < -0.05 * curve.max()

# %% [markdown]
# Sixteen numbers stand before a spike. The peak is a tenth of what it should be, the lobe is as wide as degree 3
# can make it and no narrower, and rings run around it, below zero and above, as far as the other side. It is
# what a Fourier series does to a pulse. How many degrees would do? Around its own axis a lobe needs one Legendre
# polynomial per degree, which makes the count easy.

# %%
t, w = np.polynomial.legendre.leggauss(200)
for sharpness in (SATIN, MIRROR):
    profile = np.exp(sharpness * (t - 1))
    moments = np.polynomial.legendre.legvander(t, 60).T @ (w * profile)
    energies = np.cumsum((np.arange(61) + 0.5) * moments**2) / (w * profile**2).sum()
    needed = int(np.argmax(energies > 0.98))
    print(
        f"sharpness {sharpness:.0f}: 98 % of the energy at degree {needed}, {(needed + 1) ** 2} numbers a channel"
    )
    assert (needed <= 3) == (sharpness == SATIN)

# %% [markdown]
# Nobody stores that. So what is reflected sharply will not be in the colours. Training has another way out, and takes
# it: splats *behind* the mirror, where the reflection seems to be.

# %% [markdown]
# ## The next failure
#
# What does a splat cost now?

# %%
parts = {
    "mean": 3,
    "quaternion": 4,
    "scales": 3,
    "opacity": 1,
    "colour, degree 0": 3,
    "colour, degrees 1 to 3": 45,
}
for part, count in parts.items():
    print(f"{part:>23}: {count:2d} numbers")
total, colour = sum(parts.values()), 3 * num_coefficients(3)
print(f"{'together':>23}: {total} numbers, {4 * total} bytes; colour: {colour}, {100 * colour / total:.0f} %")
print(f"a million splats: {4e6 * total / 1e6:.0f} MB; with one colour each {4e6 * (total - 45) / 1e6:.0f} MB")
assert (colour, total) == (48, 59)

# %% [markdown]
# 48 numbers for colour against 3, 59 in all, and with them the description of a splat is complete. Nothing in the
# chapters to come adds another. But look at where these numbers came from. A formula laid the disks on a sphere,
# a formula coloured them, and a formula lit them. Nobody has a formula for a garden, and nobody will type
# 59 numbers a million times. [Chapter 07](07_a_trained_scene.ipynb) opens a scene whose numbers were found by a
# machine, and looks at what it found.
