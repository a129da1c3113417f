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
# # 13 - Back to the parameters
#
# [Chapter 12](12_the_backward_pass.ipynb) differentiates a picture by what stands on the screen: a position, a conic, a
# colour and an opacity per splat. Suppose that is all we have. Two cameras stand side by side and look at one Gaussian.
# Each compares its picture with its photo, and takes a step on the numbers it has derivatives of. Below, `to_screen`
# takes one Gaussian's raw numbers to the screen, as chapters 03, 04 and 06 derived it; `paint` and `screen_slopes`
# are chapter 12's picture and its derivatives on the screen.

# %%
import functools
import os
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import torch

from gsplat_edu import ALPHA_MAX, ALPHA_MIN, DILATION, Camera, quat_to_R, sh_basis
from gsplat_edu.base.constants import C1, C2, C3, SH_OFFSET
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians

SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
DESCENT_STEPS, SWEEP = (30, 41) if SHORT else (400, 161)
print(f"budget: {DESCENT_STEPS} steps, {SWEEP} places{' (reduced)' if SHORT else ''}")


def to_screen(one, camera, limit=None):
    """Everything on the way from one Gaussian (raw arrays by name) to the screen; `sh` is (K, 3)."""
    x = SimpleNamespace(**one, focal=np.array([camera.fx, camera.fy]))
    x.offset = x.means - camera.eye  # (3,), world axes
    x.p = camera.R @ x.offset  # (3,), camera axes
    x.u = x.focal * x.p[:2] / x.p[2] + [camera.cx, camera.cy]  # (2,), px
    x.ratio = np.clip(x.p[:2] / x.p[2], *np.transpose(camera.jacobian_bounds(limit)))  # (2,), for J only
    (fx, fy), (a, b) = x.focal, x.ratio
    x.J = np.array([[fx, 0, -fx * a], [0, fy, -fy * b]]) / x.p[2]  # (2, 3)
    x.R, x.s = quat_to_R(x.quats), np.exp(x.log_scales)
    x.M = x.R * x.s  # (3, 3): column k times s_k
    x.N = x.J @ camera.R @ x.M  # (2, 3)
    x.conic = np.linalg.inv(x.N @ x.N.T + DILATION * np.eye(2))  # (2, 2), px^-2
    x.d = x.offset / np.linalg.norm(x.offset)  # (3,), from the eye to the mean
    x.basis = sh_basis(x.d)[: len(x.sh)]  # (K,): 1, 4, 9 or 16 harmonics
    x.unfloored = x.basis @ x.sh + SH_OFFSET  # (3,)
    x.color, x.opacity = np.maximum(x.unfloored, 0), 1 / (1 + np.exp(-x.logit_opacities))
    return x


def paint(seen, camera):
    """The picture of N splats, near to far, and what its derivatives need."""
    u, conic, color, o = map(np.stack, zip(*[(x.u, x.conic, x.color, x.opacity) for x in seen], strict=True))
    d = np.stack(np.meshgrid(np.arange(camera.W), np.arange(camera.H)), axis=-1) - u[:, None, None]
    alpha = o[:, None, None] * np.exp(-0.5 * np.einsum("nhwi,nij,nhwj->nhw", d, conic, d))
    alpha = np.where(alpha < ALPHA_MIN, 0, np.minimum(ALPHA_MAX, alpha))
    T = np.cumprod(np.concatenate([np.ones_like(alpha[:1]), 1 - alpha]), axis=0)[:-1]
    return np.einsum("nhw,nc->hwc", T * alpha, color), (T, alpha, d, color)


def screen_slopes(seen, camera, g):
    """For each splat, from g = dL/d picture: dL/d position, (A, B, C) of the conic, colour and opacity."""
    image, (T, alpha, d, color) = paint(seen, camera)
    facing = np.einsum("hwc,nc->nhw", g, color)
    behind = (g * image).sum(-1) - np.cumsum(T * alpha * facing, axis=0)
    h = np.where(alpha < ALPHA_MAX, alpha * (T * facing - behind / (1 - alpha)), 0)
    for i, x in enumerate(seen):
        first, second = np.einsum("hw,hwi->i", h[i], d[i]), np.einsum("hw,hwi,hwj->ij", h[i], d[i], d[i])
        conic_bar = np.array([-second[0, 0] / 2, -second[0, 1], -second[1, 1] / 2])
        yield x.conic @ first, conic_bar, np.einsum("hw,hwc->c", T[i] * alpha[i], g), h[i].sum() / x.opacity


def gaussian(mean, scales, quat, logit, base, waves):
    sh = np.concatenate([[base], waves * rng.normal(size=(15, 3))])
    raw = {"means": mean, "log_scales": np.log(scales), "quats": quat, "logit_opacities": logit, "sh": sh}
    return {name: np.array(numbers, dtype=float) for name, numbers in raw.items()}


rng = np.random.default_rng(13)
pair = [Camera.looking_at([x, 0, -3], [x, 0, 0], 60, 60, H=48, W=64) for x in (-0.5, 0.5)]
hidden = gaussian([0.2, -0.2, 0.4], [0.6, 0.25, 0.1], [9, 3, -2, 5], 1.5, [1.2, 0.4, -0.6], 0.1)
guess = gaussian([-0.1, 0.1, -0.3], [0.3, 0.3, 0.3], [1, 0.1, 0, 0], 0.5, [0, 0, 0], 0)
photos = [paint([to_screen(hidden, camera)], camera)[0] for camera in pair]
fig, axes = plt.subplots(1, 2, figsize=(9, 3.3), layout="constrained")
rows, turn = {}, np.linspace(0, 2 * np.pi, 100)
for ax, camera, photo, side in zip(axes, pair, photos, ("left", "right"), strict=True):
    x = to_screen(guess, camera)
    u_bar, *_ = next(screen_slopes([x], camera, paint([x], camera)[0] - photo))
    step = -6 * u_bar / np.linalg.norm(u_bar)  # six pixels downhill
    rows[side] = x.u[1], x.u[1] + step[1]
    ax.imshow(np.clip(photo, 0, 1), interpolation="nearest")
    rim = np.linalg.cholesky(np.linalg.inv(x.conic)) @ [np.cos(turn), np.sin(turn)]
    ax.plot(*(x.u[:, None] + rim), color="w")
    ax.quiver(*x.u, *step, color="w", angles="xy", scale_units="xy", scale=1)
    ax.set(title=f"{side} photo, the guess, its step", xlabel="u (px)", ylabel="v (px)")
plt.show()
print("row before and after the step:", {side: np.round(row, 2).tolist() for side, row in rows.items()})
assert rows["left"][0] == rows["right"][0] and abs(rows["left"][1] - rows["right"][1]) > 0.5

# %% [markdown]
# Cameras side by side see a point in the same row, whatever its depth. After the step the rows differ: no Gaussian
# looks like this to both, and a third camera has nothing to draw. The steps were taken on two pictures of a thing. They
# have to be taken on the thing: on its mean $\mu$, log-scales $\tau$, quaternion $q$, logit $\ell$ and coefficients
# $k_i$. This is `to_screen`, with the camera's rotation $W$ and centre $e$; $\odot$ multiplies entry by entry.
#
# $$p = W(\mu - e), \quad u = f \odot \tfrac{p_{xy}}{p_z} + c_0, \quad n = \tfrac{q}{|q|}, \quad M = R(n)\,
# \mathrm{diag}(e^{\tau}), \quad N = J(p)\, W M, \quad \Sigma = N N^\top + 0.3\, I, \quad \Lambda = \Sigma^{-1},$$
#
# $$d = \tfrac{\mu - e}{|\mu - e|}, \qquad c = \max\bigl(0, \textstyle\sum_i b_i(d)\, k_i + 0.5\bigr), \qquad
# o = \tfrac{1}{1 + e^{-\ell}} .$$
#
# Chapter 12 delivers derivatives by $u$, $\Lambda$, $c$ and $o$. Each link has to carry them one link further back.
# Depth enters the picture only as an order, which does not change until two splats swap: it has no derivative.
#
# ## One rule for every link
#
# The loss $L$ is one number. Write $\bar X$ for $\partial L / \partial X$, an array of the shape of $X$ with one
# derivative per entry (in code `X_bar`). A small change $dX$ changes the loss by the sum over its entries:
#
# $$dL = \langle \bar X, dX \rangle, \qquad \langle X, Y \rangle = \sum_{ij} X_{ij} Y_{ij} .$$
#
# A link makes $Y$ from $X$, and $\bar Y$ is known. Write $dY$ by $dX$, put it into $\langle \bar Y, dY \rangle$, and
# move everything but $dX$ to the other side. What stands there is $\bar X$. Factors move by
#
# $$\langle X, Y\,Z \rangle = \langle Y^\top X,\; Z \rangle = \langle X\,Z^\top,\; Y \rangle . $$
#
# That is the chain rule, read from its end: no matrix $\partial Y / \partial X$ is built. If $X$ is used twice, its two
# shares add. Below each link is checked alone, with $L = \langle \bar Y, Y \rangle$ for a $\bar Y$ drawn at random.
#
# A difference means something only where the function is smooth. Divisions by a depth of about 3, an exponential, a
# length, the inverse of a matrix with 0.3 on its diagonal and polynomials are. Two corners are not, the clamp in $J$
# and the floor of the colour; the scene stays far from both. Chapter 08's difference $D(h)$ is off by a multiple of
# $h^2$. In $(4 D(h) - D(2h)) / 3$ that cancels, $h^4$ is left, and rounding adds $\epsilon / h$. The best $h$ is
# $\epsilon^{1/5}$, with an error of $\epsilon^{4/5}$, some $10^{-13}$, times $L$ and its fifth derivatives. By the
# measure of the largest slope these may be in the hundreds: the bound is $10^{-10}$.

# %%
NUDGE = np.finfo(float).eps ** (1 / 5)


def differences(loss_of, x):
    nudges = NUDGE * np.eye(x.size).reshape(-1, *x.shape)
    D = [[(loss_of(x + k * n) - loss_of(x - k * n)) / (2 * k * NUDGE) for n in nudges] for k in (1, 2)]
    return (4 * np.array(D[0]) - D[1]).reshape(x.shape) / 3


def agrees(link, derived, loss_of, x):
    gap = np.abs(derived - differences(loss_of, x)).max() / np.abs(derived).max()
    print(f"{link:>30}: {x.size:2d} slopes, off by {gap:.1e} of the largest")
    assert derived.shape == x.shape and gap < 1e-10


camera, CLAMP = Camera.looking_at([0.4, -0.3, -3], [0, 0, 0], 60, 66, H=48, W=64), 1.3
W, edges_xy = camera.R, np.transpose(camera.jacobian_bounds(CLAMP))
near = gaussian([0.3, -0.2, 0.4], [0.5, 0.2, 0.1], [1.2, -0.4, 0.3, 0.7], 0.4, [1, 0.8, 0.6], 0.2)
aside = near | {"means": np.array([3, -0.2, 0.4]), "log_scales": near["log_scales"] + 0.8}
central, clamped = (to_screen(one, camera, CLAMP) for one in (near, aside))
for x in (central, clamped):
    print("x/z, y/z:", *np.round([x.p[:2] / x.p[2], x.ratio, *edges_xy], 2))
    assert np.abs(x.p[:2] / x.p[2] - edges_xy).min() > 0.05 and np.abs(x.unfloored).min() > 0.05

# %% [markdown]
# ## The conic
#
# Chapter 12 gives three numbers $\bar A, \bar B, \bar C$, and the matrix has $B$ in two places. The exponent uses
# their sum, so each gets half of $\bar B$. Then the inverse: from $\Lambda \Sigma = I$ follows $d\Lambda = -\Lambda\,
# d\Sigma\, \Lambda$. Move both factors over; $\Lambda$ is its own transpose.
#
# $$\bar\Lambda = \begin{pmatrix} \bar A & \bar B / 2 \\ \bar B / 2 & \bar C \end{pmatrix}, \qquad
# \langle \bar\Lambda, -\Lambda\, d\Sigma\, \Lambda \rangle = \langle -\Lambda \bar\Lambda \Lambda,\, d\Sigma \rangle,
# \qquad \bar\Sigma = -\Lambda\, \bar\Lambda\, \Lambda .$$
#
# The derivative is by all four entries of $\Sigma$, each on its own: a nudge makes the matrix asymmetric for a
# moment. Adding 0.3 to the diagonal changes no derivative.


# %%
def conic_backward(conic_bar, conic):
    A, B, C = conic_bar
    return -conic @ np.array([[A, B / 2], [B / 2, C]]) @ conic


conic_bar, Sigma = rng.normal(size=3), np.linalg.inv(central.conic)
Sigma_bar = conic_backward(conic_bar, central.conic)
shares = [1, 0.5, 0.5, 1] * conic_bar[[0, 1, 1, 2]]  # A, half of B, half of B, C
agrees("Sigma from conic", Sigma_bar, lambda Sigma: shares @ np.linalg.inv(Sigma).ravel(), Sigma)

# %% [markdown]
# ## A product with its own transpose
#
# $\Sigma$ holds $N$ twice: $d\Sigma = dN\, N^\top + N\, dN^\top$. The first term gives $\langle \bar\Sigma N,
# dN \rangle$. The second is its transpose and $\bar\Sigma$ is symmetric, so it gives the same again. $N = J\,(W M)$
# takes the rule once for each factor:
#
# $$\bar N = 2\, \bar\Sigma N, \qquad \bar M = (J W)^\top \bar N, \qquad \bar J = \bar N\, (W M)^\top .$$

# %%
x, N_bar = central, 2 * Sigma_bar @ central.N
M_bar, J_bar = (x.J @ W).T @ N_bar, N_bar @ (W @ x.M).T
agrees("N from Sigma", N_bar, lambda N: (Sigma_bar * (N @ N.T)).sum(), x.N)
agrees("M from N", M_bar, lambda M: (N_bar * (x.J @ W @ M)).sum(), x.M)
agrees("J from N", J_bar, lambda J: (N_bar * (J @ W @ x.M)).sum(), x.J)

# %% [markdown]
# ## The mean moves the affine camera
#
# $J$ is chapter 04's affine camera, fitted at the mean. When the mean moves, $J$ changes, and the ellipse with it. As a
# constant it would make the mean's gradient wrong. With $r = (p_x / p_z,\; p_y / p_z)$
#
# $$J = \frac{1}{p_z} \begin{pmatrix} f_x & 0 & -f_x r_1 \\ 0 & f_y & -f_y r_2 \end{pmatrix}, \qquad
# dr = \frac{dp_{xy} - r\, dp_z}{p_z} . $$
#
# The mean is in it in two ways. The factor in front makes all of $J$ move by $-J\, dp_z / p_z$. And the last column
# $J_3$ contains $r$, which the position $u = f \odot r + c_0$ uses too. Their shares add:
#
# $$\bar r = f \odot \bar u - \tfrac{1}{p_z} f \odot \bar J_3, \qquad \bar p_{xy} = \frac{\bar r}{p_z}, \qquad
# \bar p_z = -\frac{\bar r \cdot r + \langle \bar J, J \rangle}{p_z}, \qquad \bar\mu = W^\top \bar p . $$
#
# For captures, the $r$ inside $J$ is clamped to 1.3 times the image's own range: far off the axis the affine camera is
# so wrong that its ellipse would cover the picture. A clamped number does not move, so the second term of $\bar r$ is
# zero there, and $\langle \bar J, J \rangle$ takes the clamped $J$. The position is never clamped; its term stays.
#
# > **Predict.** A Gaussian leaves the image sideways, at a constant depth. What does its width on the screen do on the
# > way, and what beyond the clamp? What does the derivative of the width do at the clamp?


# %%
def mean_backward(u_bar, J_bar, x):
    r, z = x.p[:2] / x.p[2], x.p[2]
    r_bar = x.focal * u_bar + np.where(x.ratio == r, -x.focal * J_bar[:, 2] / z, 0)
    return np.array([*r_bar / z, -(r_bar @ r + (J_bar * x.J).sum()) / z])


def changed(limit=CLAMP, **arrays):
    return to_screen(near | arrays, camera, limit)


u_bar = rng.normal(size=2)
for link, x in (("mean from u and J, inside", central), ("mean from u and J, clamped", clamped)):
    both = W.T @ mean_backward(u_bar, J_bar, x)
    agrees(link, both, lambda m: u_bar @ changed(means=m).u + (J_bar * changed(means=m).J).sum(), x.means)

fig, axes = plt.subplots(1, 2, figsize=(11, 3.4), layout="constrained")
for limit, style in ((None, "--"), (CLAMP, "-")):
    walk = [changed(limit, means=camera.eye + W.T @ [3 * r, 0.2, 3]) for r in np.linspace(-0.2, 1.2, SWEEP)]
    grads = [2 * np.diag([1, 0]) @ x.N @ (W @ x.M).T for x in walk]  # of J, for L = Sigma_uu
    slopes = [mean_backward(np.zeros(2), grad, x)[0] for grad, x in zip(grads, walk, strict=True)]
    at, label = [x.p[0] / 3 for x in walk], "clamped at 1.3" if limit else "not clamped"
    axes[0].plot(at, [x.N[0] @ x.N[0] for x in walk], style, label=label)
    axes[1].plot(at, slopes, style, label=label)
    variance = functools.partial(lambda limit, mean: (changed(limit, means=mean).N[0] ** 2).sum(), limit)
    axes[1].plot(at[::8], [W[0] @ differences(variance, x.means) for x in walk[::8]], "k.")
axes[0].set(title="variance of the ellipse along u", xlabel="x/z of the mean", ylabel="variance (px²)")
axes[1].set(title="its derivative by x; dots: differences", xlabel="x/z of the mean", ylabel="px² per unit")
for ax in axes:
    ax.axvline(edges_xy[1, 0], color="black", linewidth=0.8, label="the clamp")
    ax.legend()
plt.show()
assert all(slope == 0 for slope, r in zip(slopes, at, strict=True) if r > edges_xy[1, 0])

# %% [markdown]
# Beyond the clamp the ellipse has stopped, and the derivative is zero. It jumps there: the function has a corner.
#
# ## Rotation and scales
#
# Column $k$ of $M$ is $s_k = e^{\tau_k}$ times column $k$ of $R$, and an exponential is its own derivative:
# $dM_{ik} = M_{ik}\, d\tau_k + s_k\, dR_{ik}$. So
#
# $$\bar\tau_k = \sum_i \bar M_{ik} M_{ik}, \qquad \bar R_{ik} = \bar M_{ik}\, s_k .$$
#
# $R(n)$ is quadratic in $n = (w, x, y, z)$. Its derivatives by the four are matrices with linear entries, and
# $\bar n_j = \langle \bar R, \partial R / \partial n_j \rangle$, as if the four were free. What is free is $q$. From
# $n = q / |q|$ and $d|q| = n \cdot dq$
#
# $$dn = \frac{dq - n\,(n \cdot dq)}{|q|}, \qquad \bar q = \frac{\bar n - n\,(n \cdot \bar n)}{|q|} . $$
#
# > **Predict.** In which direction does this $\bar q$ never point? So what does a step do to the length of $q$?


# %%
def unit_backward(unit_bar, vector):
    unit = vector / np.linalg.norm(vector)
    return (unit_bar - unit * (unit @ unit_bar)) / np.linalg.norm(vector)


def quaternion_backward(R_bar, q):
    w, x, y, z = 2 * q / np.linalg.norm(q)
    by_w, by_x = [[0, -z, y], [z, 0, -x], [-y, x, 0]], [[0, y, z], [y, -2 * x, -w], [z, w, -2 * x]]
    by_y, by_z = [[-2 * y, x, w], [x, 0, z], [-w, z, -2 * y]], [[-2 * z, -w, x], [w, -2 * z, y], [x, y, 0]]
    return unit_backward(np.einsum("jik,ik->j", [by_w, by_x, by_y, by_z], R_bar), q)


x, R_bar = central, M_bar * central.s
agrees("log-scales from M", (M_bar * x.M).sum(0), lambda v: (M_bar * x.R * np.exp(v)).sum(), x.log_scales)
quat_bar = quaternion_backward(R_bar, x.quats)
agrees("quaternion from R", quat_bar, lambda q: (R_bar * quat_to_R(q)).sum(), x.quats)
assert abs(quat_bar @ x.quats) < 1e-14 * np.linalg.norm(quat_bar) * np.linalg.norm(x.quats)  # perpendicular

plane = np.stack(np.meshgrid(np.linspace(-2, 2, 60), [0], [0], np.linspace(-2, 2, 60)), axis=-1).squeeze()
ring = [r * np.array([np.cos(a), 0, 0, np.sin(a)]) for r in (0.7, 1.3, 1.9) for a in np.arange(0.2, 6.2, 0.6)]
arrows = np.array([quaternion_backward(R_bar, q) for q in ring])
fig, ax = plt.subplots(figsize=(5.4, 4.2), layout="constrained")
surface = np.einsum("ik,abik->ab", R_bar, [[quat_to_R(q) for q in line] for line in plane])
contours = ax.contourf(plane[..., 0], plane[..., 3], surface, 15, cmap="cividis")
ax.quiver(*np.array(ring)[:, [0, 3]].T, *arrows[:, [0, 3]].T, color="w")
ax.set(title="L of q = (w, 0, 0, z), and its gradient", xlabel="w", ylabel="z", aspect="equal")
fig.colorbar(contours, ax=ax, label="L")
plt.show()

# %% [markdown]
# The length of $q$ changes nothing: contours are rays, gradients tangents of circles, and a step makes $q$ longer. And
# $q$ and $-q$ are one rotation, so that the picture repeats after half a turn.
#
# ## Colour, and who is looking
#
# Let $c'$ be the colour before the floor. A floored channel does not move: $\bar c' = \bar c$ where $c' > 0$, else 0.
#
# $$\bar k_i = b_i(d)\, \bar c', \qquad \bar d = \sum_i (k_i \cdot \bar c')\, \nabla b_i(d) .$$
#
# Each harmonic is a polynomial in $x, y, z$ with a gradient $\nabla b_i$. And $d$ is $\mu - e$ divided by its length,
# the quaternion's link again: it adds a second share to $\bar\mu$.


# %%
def harmonic_slopes(d):
    """Gradients of the 16 harmonics as polynomials in x, y, z: (16, 3)."""
    (x, y, z), (xx, yy, zz), xy = d, d * d, d[0] * d[1]
    first = [(0, 0, 0), (0, -1, 0), (0, 0, 1), (-1, 0, 0)]
    second = [(y, x, 0), (0, z, y), (-2 * x, -2 * y, 4 * z), (z, 0, x), (2 * x, -2 * y, 0)]
    third = [(6 * xy, 3 * (xx - yy), 0), (y * z, x * z, xy), (-2 * xy, 4 * zz - xx - 3 * yy, 8 * y * z)]
    third += [(-6 * x * z, -6 * y * z, 6 * zz - 3 * xx - 3 * yy), (4 * zz - 3 * xx - yy, -2 * xy, 8 * x * z)]
    third += [(2 * x * z, -2 * y * z, xx - yy), (3 * (xx - yy), -6 * xy, 0)]
    return np.array(first + second + third) * np.array([0, C1, C1, C1, *C2, *C3])[:, None]


def color_backward(color_bar, x):
    """dL/d coefficients, and the share of dL/d mean that comes by the viewing direction."""
    unfloored_bar = np.where(x.unfloored > 0, color_bar, 0)
    d_bar = (x.sh @ unfloored_bar) @ harmonic_slopes(x.d)[: len(x.sh)]
    return np.outer(x.basis, unfloored_bar), unit_backward(d_bar, x.offset)


color_bar = rng.normal(size=3)
for few in (near["sh"][:count] for count in (1, 4, 9, 16)):
    sh_bar, mean_bar = color_backward(color_bar, changed(sh=few))
    agrees(f"coefficients, {len(few)} x 3", sh_bar, lambda sh: color_bar @ changed(sh=sh).color, few)
    if len(few) > 1:
        by_mean = functools.partial(lambda sh, mean: color_bar @ changed(sh=sh, means=mean).color, few)
        agrees("mean by their colour", mean_bar, by_mean, near["means"])

# %% [markdown]
# ## All of it
#
# The opacity's link is one factor, the sigmoid's derivative $o(1 - o)$. Now the links in order. The kernels
# `project_backward.cpp` and `project_backward.wgsl` are this list too, a lane or a thread for each Gaussian;
# [gsplat_edu.scene.gaussians](../src/gsplat_edu/scene/gaussians.py) holds the raw numbers, and leaves them to autograd.


# %%
def to_parameters(x, camera, u_bar, conic_bar, color_bar, opacity_bar):
    """From one Gaussian's numbers on the screen to its raw parameters."""
    W, N_bar = camera.R, 2 * conic_backward(conic_bar, x.conic) @ x.N
    M_bar, J_bar = (x.J @ W).T @ N_bar, N_bar @ (W @ x.M).T
    sh_bar, by_color = color_backward(color_bar, x)
    return {
        "means": W.T @ mean_backward(u_bar, J_bar, x) + by_color,
        "log_scales": (M_bar * x.M).sum(axis=0),
        "quats": quaternion_backward(M_bar * x.s, x.quats),
        "logit_opacities": opacity_bar * x.opacity * (1 - x.opacity),
        "sh": sh_bar,
    }


def by_hand(scene, camera, weights, limit=None):
    """The picture of Gaussians, near to far, and the gradient of L = <weights, picture>."""
    seen = [to_screen(one, camera, limit) for one in scene]
    slopes = screen_slopes(seen, camera, weights)
    found = [to_parameters(x, camera, *each) for x, each in zip(seen, slopes, strict=True)]
    return paint(seen, camera)[0], {name: np.stack([each[name] for each in found]) for name in found[0]}


def by_package(scene, camera, weights, limit, backend):
    tensors = {name: torch.tensor(np.stack([one[name] for one in scene])) for name in scene[0]}
    sh = tensors.pop("sh")
    leaves = Gaussians(**tensors, sh0=sh[:, :1], sh_rest=sh[:, 1:]).trainable()
    image = render(leaves, camera, settings=RenderSettings(jacobian_limit=limit), backend=backend).image
    (image * torch.tensor(weights)).sum().backward()
    grads = {name: tensor.grad.numpy() for name, tensor in leaves.tensors().items()}
    sh = np.concatenate([grads.pop("sh0"), grads.pop("sh_rest")], axis=1)
    return image.detach().numpy(), grads | {"sh": sh}


# %% [markdown]
# Two witnesses: autograd, which differentiates the dense renderer and knows none of these formulas, and the package's
# native kernels, which have their own. In float64 autograd does the same arithmetic in another order, hundreds of
# roundings of $10^{-16}$: it has to agree to $10^{-12}$ of a parameter's largest slope. The kernels get $10^{-9}$, the
# bound of the package's tests. The scene has both Gaussians from above and six more.

# %%
places, sizes, quats = rng.uniform(-0.8, 0.8, (6, 3)), rng.uniform(0.1, 0.4, (6, 3)), rng.normal(size=(6, 4))
others = [gaussian(*one, 1, [0.5, 0.5, 0.5], 0.3) for one in zip(places, sizes, quats, strict=True)]
every = sorted([near, aside, *others], key=lambda one: W[2] @ one["means"])  # by depth
weights = rng.normal(size=(camera.H, camera.W, 3))
for title, scene in (("one", [near]), ("clamped", [aside]), ("scene", every)):
    image, grads = by_hand(scene, camera, weights, CLAMP)
    for backend, bound in (("torch", 1e-12), ("cpu", 1e-9)):
        picture, theirs = by_package(scene, camera, weights, CLAMP, backend)
        gaps = {key: np.abs(grads[key] - other).max() / np.abs(other).max() for key, other in theirs.items()}
        print(f"{title:>7}, {backend:>5}:", ", ".join(f"{key} {gap:.0e}" for key, gap in gaps.items()))
        assert max(gaps.values()) < bound and np.abs(image - picture).max() < 1e-12

# %% [markdown]
# ## The next failure
#
# Back to the two cameras. Their slopes now meet in the same 59 numbers, where shares add. Descend from the guess above,
# and from others, further and further below.


# %%
def descent(one):
    for _ in range(DESCENT_STEPS):
        errors = [paint([to_screen(one, c)], c)[0] - photo for c, photo in zip(pair, photos, strict=True)]
        yield sum((error**2).mean() for error in errors)
        grads = [by_hand([one], c, 2 * e / e.size)[1] for c, e in zip(pair, errors, strict=True)]
        one = {key: numbers - 0.5 * sum(grad[key][0] for grad in grads) for key, numbers in one.items()}
        assert np.ptp([to_screen(one, c).u[1] for c in pair]) < 1e-12, "the same row in both"


for deeper in range(4):
    falls = list(descent(guess | {"means": guess["means"] + [0, deeper, 0]}))
    print(f"{deeper} below: loss {falls[0]:.5f} -> {falls[-1]:.5f}")
assert falls[0] == falls[-1]

# %% [markdown]
# At every step both cameras see one thing, and the nearest guess comes close to it. The furthest do not move: their
# gradient is exact, and exactly zero, because alpha is below the floor all over both photos. A derivative knows nothing
# of what is out of sight. A training has to start with Gaussians that are nearly where they belong, and with cameras
# that are right. [Chapter 14](14_photos_to_scene.ipynb) finds both in photos.
