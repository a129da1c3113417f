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
# # 08 - Fit an image
#
# A trained scene is a file of numbers that nobody typed. Something looked at pixels that were wrong and decided which
# of the numbers to blame, and by how much. To see how, everything that does not matter to that question is left out:
# the third dimension, the camera, the sort. What is left is a photo, flat ellipses in front of it in a fixed order,
# and a picture that is as wrong as a picture can be.

# %%
import os
import time

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.cbook import get_sample_data

from gsplat_edu import ALPHA_MAX, ALPHA_MIN, DILATION, Camera, render_gaussians
from gsplat_edu.fit2d.adam import AdamSettings, AdamState, adam_step_2d
from gsplat_edu.fit2d.fit import Fit2DSettings, fit_2d, psnr_2d, shrunk_photo
from gsplat_edu.fit2d.gradients import backward_2d, squared_error
from gsplat_edu.fit2d.splats import Splats2D, ellipses_2d, random_splats_2d, render_2d
from gsplat_edu.photos.decoding import decode

SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
SIZE, COUNT, LENGTH, TRIAL = (64, 125, 100, 40) if SHORT else (128, 500, 500, 200)
print(f"budget: {COUNT} splats, {SIZE} px, {LENGTH} steps{' (reduced)' if SHORT else ''}")

# Grace Hopper, a portrait by the US Navy, in the public domain. It comes with matplotlib.
photo = shrunk_photo(decode(get_sample_data("grace_hopper.jpg", asfileobj=False))[0], SIZE)
height, width, _ = photo.shape
start = random_splats_2d(COUNT, height, width, np.random.default_rng(8))
wrong = render_2d(start, height, width)


def draw_ellipses(ax, splats, title):
    for curve, color in zip(ellipses_2d(splats), np.clip(splats.colors, 0, 1), strict=True):
        ax.plot(*curve.T, color=color, linewidth=0.8)
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", facecolor="0.35")
    ax.set(xticks=[], yticks=[], title=title)


def draw_images(axes, images):
    for ax, (title, image) in zip(axes, images.items(), strict=False):
        ax.imshow(np.clip(image, 0, 1), interpolation="nearest")
        ax.set(xticks=[], yticks=[], title=title)


fig, axes = plt.subplots(1, 3, figsize=(8.5, 3.9), layout="constrained")
draw_images(axes, {"the photo": photo, "the picture": wrong.image})
draw_ellipses(axes[2], start, "the ellipses it is made of")
plt.show()

# %% [markdown]
# Each ellipse has nine numbers: two of a mean $\mu$ in pixels, two logarithms of scales, one angle $\theta$, three of
# a colour $c$, one [logit](../docs/GLOSSARY.md#logit) $\ell$ of an opacity. They are raw for the reason they are raw
# in a file: so that any step leads to a splat. The covariance is built as chapter 03 builds it, as a product with its
# own transpose, and dilated as chapter 02 does it:
#
# $$R = \begin{pmatrix} \cos\theta & -\sin\theta \\ \sin\theta & \cos\theta \end{pmatrix}, \qquad
# S = \begin{pmatrix} e^{\tau_1} & 0 \\ 0 & e^{\tau_2} \end{pmatrix}, \qquad M = R S, \qquad
# \Sigma = M M^\top + 0.3\, I, \qquad \Lambda = \Sigma^{-1}$$
#
# $$o = \frac{1}{1 + e^{-\ell}}, \qquad \alpha_i = \min\left(0.99,\; o_i\, e^{-d^\top \Lambda_i d / 2}\right),
# \qquad d = x - \mu_i, \qquad T_i = \prod_{j < i} (1 - \alpha_j), \qquad
# \hat c = \sum_i T_i \alpha_i c_i + T_{n+1} b$$
#
# with $\alpha$ zero below 1/255, the background $b$ black, and the first splat in front.
# [gsplat_edu.fit2d.splats](../src/gsplat_edu/fit2d/splats.py) evaluates each only in the box around its ellipse
# $\alpha = 1/255$. Without that the picture is short, and keeps what the chain rule will ask for.


# %%
def forward_by_hand(splats, rows, columns):
    """Every splat at every pixel: (N, h, w) arrays."""
    c, s = np.cos(splats.angles), np.sin(splats.angles)
    R = np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0)
    M = R * np.exp(splats.log_scales)[:, None, :]
    conic = np.linalg.inv(M @ M.transpose(0, 2, 1) + DILATION * np.eye(2))
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    d = grid - splats.means[:, None, None, :]
    o = 1 / (1 + np.exp(-splats.logit_opacities))
    alpha = o[:, None, None] * np.exp(-0.5 * np.einsum("nhwi,nij,nhwj->nhw", d, conic, d))
    alpha = np.where(alpha < ALPHA_MIN, 0, np.minimum(ALPHA_MAX, alpha))
    T = np.cumprod(np.concatenate([np.ones((1, rows, columns)), 1 - alpha]), axis=0)[:-1]
    return T, alpha, d, conic, M, np.einsum("nhw,nc->hwc", T * alpha, splats.colors)


few = start.map(lambda array: array[:60])
gap = np.abs(forward_by_hand(few, height, width)[-1] - render_2d(few, height, width).image).max()
assert gap < 1e-12

# %% [markdown]
# ## One number for how wrong
#
# Blame needs a number to be shared out. The mean of the squared differences over pixels and channels is one with a
# slope everywhere, so that it can be checked, and a short one; $m$ counts the pixels, $c^*$ is the photo's colour:
#
# $$L = \frac{1}{3m} \sum (\hat c - c^*)^2, \qquad
# g = \frac{\partial L}{\partial \hat c} = \frac{2\,(\hat c - c^*)}{3m}$$
#
# It is usually quoted in decibels, as the [peak signal-to-noise ratio](../docs/GLOSSARY.md#psnr) of what a screen
# would show, clipped to 0 to 1: $\mathrm{PSNR} = -10 \log_{10} L$. Ten decibels more are a tenth of the error.

# %%
shown = np.mean((np.clip(wrong.image, 0, 1) - photo) ** 2)
print(f"mean squared error {shown:.4f}, PSNR {-10 * np.log10(shown):.2f} dB")
assert np.isclose(psnr_2d(wrong.image, photo), -10 * np.log10(shown), rtol=1e-12, atol=0)

# %% [markdown]
# ## The brute-force answer
#
# How much is the third splat's angle to blame? Turn it a little, draw again, look. Turn it back and beyond, draw
# again. The difference over the distance is the derivative, for any formula whatever. It needs two pictures for each
# number, and once the step has been taken it needs them again. The derivatives have to come out of one pass. But
# differences, too slow for training, can check it: on a scene so small that all of them can be computed, every
# formula below has to agree with them.
#
# A difference means something only where the function is smooth. Alpha jumps at 1/255 and has a corner at 0.99, so the
# scene is one where no alpha comes near either: a few pixels, and splats wider than the image. How close must the
# agreement be? A central difference with step $h$ is off by $h^2 |L'''| / 6$, and rounding adds $\epsilon |L| / h$.
# The sum is smallest near $h = \epsilon^{1/3}$, where both are a multiple of $\epsilon^{2/3}$. The parameters are of
# the order of 1 to the picture (a pixel, a radian, a factor $e$), so $|L'''|$ is at most of the order of $L$, and $L$
# is below 1: the tolerance is $\epsilon^{2/3}$ itself.

# %%
rng = np.random.default_rng(88)
tiny = Splats2D(
    means=rng.uniform(2, 6, (4, 2)),
    log_scales=np.log(rng.uniform(2.5, 4, (4, 2))),
    angles=rng.uniform(-3, 3, 4),
    colors=rng.uniform(0.1, 0.9, (4, 3)),
    logit_opacities=rng.uniform(-0.5, 1, 4),
)
TALL, WIDE, NUDGE, TOLERANCE = 9, 8, np.finfo(float).eps ** (1 / 3), np.finfo(float).eps ** (2 / 3)
wanted_picture = rng.uniform(size=(TALL, WIDE, 3))


def tiny_loss(name, index, step):
    """The loss with one number of the scene moved."""
    arrays = {key: array.copy() for key, array in tiny.arrays().items()}
    arrays[name][index] += step
    return squared_error(render_2d(Splats2D(**arrays), TALL, WIDE).image, wanted_picture)[0]


measured = {name: np.empty_like(array) for name, array in tiny.arrays().items()}
for name, slopes in measured.items():
    for index in np.ndindex(slopes.shape):
        slopes[index] = (tiny_loss(name, index, NUDGE) - tiny_loss(name, index, -NUDGE)) / (2 * NUDGE)


def agrees(name, derived):
    gap = np.abs(derived - measured[name]).max()
    print(f"{name:>15}: {derived.size:2d} slopes up to {np.abs(derived).max():.1e}, off by {gap:.1e}")
    assert gap < TOLERANCE


T, alpha, d, conic, M, image = forward_by_hand(tiny, TALL, WIDE)
_, g = squared_error(image, wanted_picture)
assert alpha.min() > 2 * ALPHA_MIN and alpha.max() < 0.9 * ALPHA_MAX
print(f"alpha from {alpha.min():.4f} to {alpha.max():.4f}; tolerance {TOLERANCE:.1e}")

# %% [markdown]
# ## Colour
#
# The picture is linear in the colours, with weights $w_i = T_i \alpha_i$ that no colour changes. A pixel's error
# reaches a colour through that weight, and a colour is in as many pixels as its splat covers:
#
# $$\frac{\partial L}{\partial c_i} = \sum_{\text{pixels}} w_i\, g$$

# %%
agrees("colors", np.einsum("nhw,hwc->nc", T * alpha, g))

# %% [markdown]
# ## Opacity, and what lies behind
#
# An alpha does two things to its pixel. It brings its own colour in, with weight $T_i$, and it keeps what is behind it
# out. Everything behind carries the factor $1 - \alpha_i$, once; call what they bring together
# $\hat c_{>i} = \sum_{j > i} w_j c_j + T_{n+1} b$. Without the factor it would be $\hat c_{>i} / (1 - \alpha_i)$, so
#
# $$\frac{\partial \hat c}{\partial \alpha_i} = T_i c_i - \frac{\hat c_{>i}}{1 - \alpha_i}$$
#
# The sum behind looks as if the pixel had to be walked from back to front. It need not be. Only the product with $g$
# counts, one number for a pixel, and it is known when the picture is done: before the first splat everything is still
# behind, and $r = g \cdot \hat c$. Then, from near to far, each splat takes its share out:
#
# $$r \leftarrow r - w_i\, g \cdot c_i, \qquad
# \frac{\partial L}{\partial \alpha_i} = T_i\, g \cdot c_i - \frac{r}{1 - \alpha_i}$$
#
# Where the clamp holds alpha at 0.99, and where the floor makes it zero, nothing behind alpha moves it, and the chain
# ends. Elsewhere it goes on through the sigmoid, whose slope is $o(1 - o)$: alpha is proportional to $o$, so
# $\partial \alpha / \partial \ell = \alpha (1 - o)$. The product $h = \alpha\, \partial L / \partial \alpha$ will come
# back at every step from here on: it is the slope by the exponent.

# %%
remainder, h = (g * image).sum(axis=2), np.empty_like(alpha)
for i in range(len(tiny)):
    facing = g @ tiny.colors[i]
    remainder -= T[i] * alpha[i] * facing
    h[i] = alpha[i] * (T[i] * facing - remainder / (1 - alpha[i]))
assert np.abs(remainder).max() < 1e-15, "black is behind the last one: nothing may remain"
agrees("logit_opacities", (1 - tiny.opacities) * h.sum(axis=(1, 2)))

# %% [markdown]
# ## Where it is, and what shape it has
#
# The exponent is $-\frac{1}{2} d^\top \Lambda d$ with $d = x - \mu$. Moving the mean moves $d$ the other way, and the
# two signs cancel: the slope is $\Lambda d$. A splat is pulled towards pixels where more of it would help, most by
# those one standard deviation out, and not at all by its own centre.
#
# $$\frac{\partial L}{\partial \mu_i} = \Lambda_i \sum_{\text{pixels}} h\, d$$
#
# How it is stretched and turned is in the matrix. By $\Lambda$ the exponent is linear: its slope is
# $-\frac{1}{2} d d^\top$, a matrix, and summed over the pixels $H_i = \sum h\, d d^\top$ are moments of the blame.
# Then the inverse. From $\Lambda \Sigma = I$ follows $d\Lambda = -\Lambda\, d\Sigma\, \Lambda$, so the matrix passes
# between two conics and changes its sign:
#
# $$\frac{\partial L}{\partial \Lambda} = -\frac{1}{2} H, \qquad
# \frac{\partial L}{\partial \Sigma} = \frac{1}{2} \Lambda H \Lambda$$
#
# The dilation is a constant and adds nothing. $\Sigma = M M^\top + \dots$ holds $M$ twice, and the matrix is symmetric:
# $\partial L / \partial M = 2\, (\partial L / \partial \Sigma)\, M = \Lambda H \Lambda M$.
#
# Column $k$ of $M = R S$ is column $k$ of the rotation times $e^{\tau_k}$, and an exponential is its own slope: by
# $\tau_k$ the column's slope is the column. By the angle, every column turns: $\partial M / \partial \theta = Q M$,
# with $Q$ a quarter turn.
#
# $$\frac{\partial L}{\partial \tau_k} = \sum_i \left(\frac{\partial L}{\partial M} \odot M\right)_{ik}, \qquad
# \frac{\partial L}{\partial \theta} = \sum_{ik} \left(\frac{\partial L}{\partial M} \odot Q M\right)_{ik}, \qquad
# Q = \begin{pmatrix} 0 & -1 \\ 1 & 0 \end{pmatrix}$$
#
# That is all of it. [gsplat_edu.fit2d.gradients](../src/gsplat_edu/fit2d/gradients.py) holds the same links in the
# same order, box by box, and has to give what the differences gave.

# %%
agrees("means", np.einsum("nij,nhw,nhwj->ni", conic, h, d))
H = np.einsum("nhw,nhwi,nhwj->nij", h, d, d)
grad_factor = conic @ H @ conic @ M
agrees("log_scales", (grad_factor * M).sum(axis=1))
agrees("angles", (grad_factor * (np.array([[0, -1], [1, 0]]) @ M)).sum(axis=(1, 2)))

together = backward_2d(render_2d(tiny, TALL, WIDE), g).arrays()
assert all(np.abs(together[name] - slopes).max() < TOLERANCE for name, slopes in measured.items())
began = time.process_time()
wrong = render_2d(start, height, width)
rendered = time.process_time()
slopes = backward_2d(wrong, squared_error(wrong.image, photo)[1]).arrays()
one, both = rendered - began, time.process_time() - began
print(f"a picture and all slopes take the processor as long as {both / one:.1f} pictures;", end=" ")
print(f"differences take {2 * 9 * COUNT:,} of them")
assert both < 0.1 * 2 * 9 * COUNT * one

# %% [markdown]
# ## Downhill, and stuck
#
# A gradient says which way is down, so take a step against it, $p \leftarrow p - \gamma\, \partial L / \partial p$,
# and repeat. The rate $\gamma$ is the one number left to choose. The loss is a mean over all values of the photo, so
# each slope is as small as the photo is large; the rates below are multiples of the number of values, which takes that
# out.
#
# > **Predict.** One rate for all nine numbers of a splat. What will plain descent learn with it first, and what
# > hardly at all: colours, positions, or angles?


# %%
def descend(rate, steps):
    """Plain gradient descent: one rate for every number. Ends early where it has lost its way."""
    splats, history = start, []
    for _ in range(steps):
        rendered = render_2d(splats, height, width)
        error, g = squared_error(rendered.image, photo)
        history.append(error)
        if error > 2 * history[0]:
            break
        down = backward_2d(rendered, g).arrays()
        splats = Splats2D(**{key: p - rate * photo.size * down[key] for key, p in splats.arrays().items()})
    return splats, history


def moved(splats):
    return {key: np.median(np.abs(p - start.arrays()[key])) for key, p in splats.arrays().items()}


descents = {rate: descend(rate, TRIAL) for rate in (0.0025, 0.025, 0.05)}
stuck, stuck_history = descents[0.025]
for rate, (_, history) in descents.items():
    print(f"rate {rate:6.4f}: error {history[0]:.4f} -> {history[-1]:.4f} in {len(history)} pictures")
assert descents[0.05][1][-1] > 2 * stuck_history[0] and len(descents[0.05][1]) < 20

# %% [markdown]
# The highest rate throws the picture away within a few steps. Half of it survives, and stalls: the splats have been
# recoloured, and hardly one has gone anywhere. The rate is to blame, because it is one. A pixel, a radian and a unit
# of red are different units. Write the means in others, $p = u q$: then
# $\partial L / \partial q = u\, \partial L / \partial p$, and the step that descent takes in $q$ is, seen in $p$,
# $u^2 \gamma\, \partial L / \partial p$. Measure in millimetres and the path is another one. The rate has to stay
# below what the stiffest unit bears, and the others crawl.
#
# A step with the right unit is a slope divided by the size that slopes of this number usually have, times a rate in
# the number's own unit. Whatever $u$ was, it cancels. The usual size is a running mean of squares:
#
# $$v \leftarrow \beta_2 v + (1 - \beta_2)\, g^2, \qquad p \leftarrow p - \gamma_p\, \frac{g}{\sqrt{v}}$$
#
# A slope whose sign keeps changing should not be followed at full length, so it is averaged too,
# $m \leftarrow \beta_1 m + (1 - \beta_1)\, g$. Both means start at zero, a slope that nobody has seen: after $t$ steps
# their weights add up to $1 - \beta^t$, so they are divided by that. This is Adam (Kingma and Ba 2015), in
# [gsplat_edu.fit2d.adam](../src/gsplat_edu/fit2d/adam.py). Two consequences can be asserted: the first step is the
# rate, with the sign of the slope against it; and a loss in other units changes nothing.

# %%
settings, fresh = AdamSettings(), AdamState.fresh(start)
stepped, _ = adam_step_2d(start, Splats2D(**slopes), fresh, settings)
louder, _ = adam_step_2d(start, Splats2D(**slopes).map(lambda slope: 1000 * slope), fresh, settings)
clear = np.abs(slopes["colors"]) > 1e-7  # where the floor under the root cannot be felt
expected = -settings.rates["colors"] * np.sign(slopes["colors"])
for after in (stepped, louder):
    assert np.allclose((after.colors - start.colors)[clear], expected[clear], rtol=1e-4, atol=0)

trial = fit_2d(photo, start, Fit2DSettings(TRIAL))
print(f"{'':>15}  plain   Adam   (median distance moved)")
for key, distance in moved(trial.splats).items():
    print(f"{key:>15}  {moved(stuck)[key]:5.2f}  {distance:5.2f}")
assert trial.losses[-1] < 0.8 * stuck_history[-1]
assert moved(trial.splats)["means"] > 10 * moved(stuck)["means"]

fig, (loss_ax, psnr_ax) = plt.subplots(1, 2, figsize=(12, 3.4), layout="constrained")
for (rate, (_, history)), style in zip(descents.items(), ("C0:", "C1--", "C2-."), strict=True):
    end = "" if len(history) == TRIAL else ": diverges, stopped"
    loss_ax.semilogy(history, style, label=f"one rate for all, {rate}{end}")
loss_ax.semilogy(trial.losses, "k", label="Adam")
psnr_ax.plot(trial.psnrs, "k")
loss_ax.set(title="the same start, the same gradients", xlabel="step", ylabel="mean squared error")
psnr_ax.set(title="Adam's error in decibels", xlabel="step", ylabel="PSNR, dB")
loss_ax.legend()
plt.show()

# %% [markdown]
# ## The picture
#
# The loop is in [gsplat_edu.fit2d.fit](../src/gsplat_edu/fit2d/fit.py): render, compare, go back, step. The rates fall
# to a tenth on the way, so that the end is no trembling. Without a notebook: `python train/train_2d.py --help`.

# %%
fit = fit_2d(photo, start, Fit2DSettings(LENGTH))
quality = psnr_2d(fit.image, photo)
print(f"PSNR {fit.psnrs[0]:.2f} dB -> {quality:.2f} dB; {9 * COUNT:,} numbers for {photo.size:,}")
assert quality > fit.psnrs[0] + (10 if SHORT else 15)

fig, axes = plt.subplots(1, 4, figsize=(11.5, 3.6), layout="constrained")
draw_images(axes, {"the photo": photo, "fitted": fit.image})
draw_ellipses(axes[2], fit.splats, "its ellipses")
errors = axes[3].imshow(np.abs(fit.image - photo).max(axis=2), vmin=0, cmap="magma", interpolation="nearest")
axes[3].set(xticks=[], yticks=[], title="what is still wrong")
fig.colorbar(errors, ax=axes[3], label="largest error of a pixel's channels", shrink=0.8)
plt.show()

# %% [markdown]
# Small splats went to edges, long ones lie along the stripes and the lapels, and large ones cover what is plain.
# Nobody told them to. What is left over lies along edges and in fine structure, where there are too few.
#
# ## The next failure
#
# The picture is a page with ellipses on it. Give each of them a depth, in the order they have, and scale it so that a
# camera sees it as before: flat splats parallel to the image have the same covariance on the screen at any distance,
# so the renderer of the scene agrees with the page to rounding. Then take a step to the side.

# %%
z = np.sort(np.random.default_rng(1).uniform(2, 4, COUNT))  # focal length: SIZE px
middle, per_pixel = np.array([width / 2, height / 2]), z[:, None] / SIZE
means = np.concatenate([(fit.splats.means - middle) * per_pixel, z[:, None]], axis=1)
covariances = np.zeros((COUNT, 3, 3))
covariances[:, :2, :2] = (fit.splats.cov2d - DILATION * np.eye(2)) * per_pixel[..., None] ** 2
lifted = (means, covariances, fit.splats.colors, fit.splats.opacities)


def seen_from(x):
    camera = Camera.looking_at((x, 0, 0), (0, 0, 3), SIZE, SIZE, height, width)
    return render_gaussians(camera, *lifted, extent="exact", stop="none")[0]


assert np.abs(seen_from(0.0) - fit.image).max() < 1e-10

fig, axes = plt.subplots(1, 3, figsize=(8.5, 3.9), layout="constrained")
draw_images(
    axes, {f"{x} world units to the right,\n2 to 4 world units away": seen_from(x) for x in (0.0, 0.3, 1.2)}
)
plt.show()

# %% [markdown]
# From where the photo was taken, nothing is wrong, and no gradient can tell these depths from any others. One photo
# cannot. Several can, if a splat has to explain all of them at once, and then the chain from pixel to number runs
# through a camera, a perspective, a quaternion, and an order that changes. Every one of those links can be derived as
# these were. Before that is worth doing, it should be known that a scene can be learned this way at all: [chapter
# 09](09_train_in_3d.ipynb) borrows the gradients and finds out.
