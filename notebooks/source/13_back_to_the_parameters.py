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
# Each compares its image with its photo, and takes a step on the numbers it has derivatives of.
#
# The first function is the whole way from a Gaussian's raw numbers to the screen, as chapters 03, 04 and 06 derived it,
# for one Gaussian and without shortcuts. The other two are chapter 12's: the picture, and its derivatives.

# %%
import os
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import torch
from scipy.optimize import minimize

from gsplat_edu import ALPHA_MAX, ALPHA_MIN, DILATION, Camera, quat_to_R, sh_basis
from gsplat_edu.base.constants import C1, C2, C3, SH_OFFSET
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.render.torch_reference import eval_sh_t
from gsplat_edu.scene.gaussians import Gaussians, quat_to_R_t

SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
STEPS, SWEEP = (60, 41) if SHORT else (300, 161)
print(f"budget: {STEPS} steps, {SWEEP} places{' (reduced)' if SHORT else ''}")


def to_screen(one, camera, limit=None):
    """Everything on the way from one Gaussian (raw arrays by name) to the screen."""
    x = SimpleNamespace(**one)
    x.focal = np.array([camera.fx, camera.fy])
    x.offset = x.means - camera.eye  # (3,), world axes
    x.p = camera.R @ x.offset  # (3,), camera axes
    x.u = x.focal * x.p[:2] / x.p[2] + [camera.cx, camera.cy]  # (2,), px
    x.ratio = np.clip(x.p[:2] / x.p[2], *np.transpose(camera.jacobian_bounds(limit)))  # (2,), for J only
    x.J = jacobian_at(x.focal, x.ratio, x.p[2])  # (2, 3)
    x.R, x.s = quat_to_R(x.quats), np.exp(x.log_scales)
    x.M = x.R * x.s  # (3, 3): column k times s_k
    x.N = x.J @ camera.R @ x.M  # (2, 3)
    x.conic = np.linalg.inv(x.N @ x.N.T + DILATION * np.eye(2))  # (2, 2), px^-2
    x.d = x.offset / np.linalg.norm(x.offset)  # (3,), from the eye to the mean
    x.unfloored = sh_basis(x.d)[: len(x.sh)] @ x.sh + SH_OFFSET  # (3,); sh is (K, 3), K = 1, 4, 9 or 16
    x.color = np.maximum(x.unfloored, 0)
    x.opacity = 1 / (1 + np.exp(-x.logit_opacities))
    return x


def jacobian_at(focal, ratio, z):
    (fx, fy), (a, b) = focal, ratio
    return np.array([[fx, 0, -fx * a], [0, fy, -fy * b]]) / z


def paint(seen, camera):
    """The picture of splats in the order from near to far, and what its derivatives need; N, h, w first."""
    d = (
        np.stack(np.meshgrid(np.arange(camera.W), np.arange(camera.H)), -1)
        - np.stack([x.u for x in seen])[:, None, None]
    )
    power = -0.5 * np.einsum("nhwi,nij,nhwj->nhw", d, [x.conic for x in seen], d)
    alpha = np.array([x.opacity for x in seen])[:, None, None] * np.exp(power)
    alpha = np.where(alpha < ALPHA_MIN, 0, np.minimum(ALPHA_MAX, alpha))
    T = np.cumprod(np.concatenate([np.ones_like(alpha[:1]), 1 - alpha]), axis=0)[:-1]
    return np.einsum("nhw,nc->hwc", T * alpha, [x.color for x in seen]), (T, alpha, d)


def screen_slopes(seen, camera, g):
    """Chapter 12: for every splat dL/d(position, (A, B, C) of the conic, colour, opacity), from g = dL/d picture."""
    image, (T, alpha, d) = paint(seen, camera)
    facing = np.einsum("hwc,nc->nhw", g, [x.color for x in seen])
    behind = (g * image).sum(-1) - np.cumsum(T * alpha * facing, axis=0)
    h = np.where(alpha < ALPHA_MAX, alpha * (T * facing - behind / (1 - alpha)), 0)
    first, second = np.einsum("nhw,nhwi->ni", h, d), np.einsum("nhw,nhwi,nhwj->nij", h, d, d)
    colors = np.einsum("nhw,hwc->nc", T * alpha, g)
    for i, x in enumerate(seen):
        (xx, xy), (_, yy) = second[i]
        yield x.conic @ first[i], -np.array([xx / 2, xy, yy / 2]), colors[i], h[i].sum() / x.opacity


def gaussian(means, scales, quats, logit, sh):
    arrays = (means, quats, np.log(scales), sh, logit)
    names = ("means", "quats", "log_scales", "sh", "logit_opacities")
    return dict(zip(names, (np.array(array, dtype=float) for array in arrays), strict=True))


rng = np.random.default_rng(13)
cameras = [Camera.looking_at([x, 0, -3], [x, 0, 0], 60, 60, H=48, W=64) for x in (-0.5, 0.5)]
sh = 0.1 * rng.normal(size=(16, 3)) * (np.arange(16) > 0)[:, None]
wanted = gaussian(
    [0.2, -0.25, 0.4],
    [0.6, 0.25, 0.1],
    [0.9, 0.3, -0.2, 0.5],
    1.5,
    sh + [1.2, 0.4, -0.6] * (np.arange(16) == 0)[:, None],
)
guess = gaussian([-0.1, 0.1, -0.3], [0.3, 0.3, 0.3], [1, 0.1, 0, 0], 0.5, np.zeros((16, 3)))
photos = [paint([to_screen(wanted, camera)], camera)[0] for camera in cameras]
turn = np.linspace(0, 2 * np.pi, 100)


def show_pair(rows):
    fig, axes = plt.subplots(len(rows), 2, figsize=(9, 3.3 * len(rows)), layout="constrained", squeeze=False)
    for line, (title, gaussians, arrows) in zip(axes, rows, strict=True):
        for ax, camera, photo, side in zip(line, cameras, photos, ("left", "right"), strict=True):
            ax.imshow(np.clip(photo, 0, 1), interpolation="nearest")
            for one, color in zip(gaussians, plt.cm.cool(np.linspace(0, 1, len(gaussians))), strict=True):
                x = to_screen(one, camera)
                curve = np.linalg.cholesky(np.linalg.inv(x.conic)) @ [np.cos(turn), np.sin(turn)]
                ax.plot(*(x.u[:, None] + curve), color=color)
            if arrows is not None:
                ax.annotate(
                    "", x.u + arrows[side], x.u, arrowprops={"arrowstyle": "->", "color": "w", "lw": 2}
                )
            ax.set(title=f"{title}, {side} camera", xlabel="u (px)", ylabel="v (px)")
    plt.show()


pulls = {}
for side, camera, photo in zip(("left", "right"), cameras, photos, strict=True):
    x = to_screen(guess, camera)
    ((grad_u, _, _, _),) = screen_slopes([x], camera, 2 * (paint([x], camera)[0] - photo) / photo.size)
    pulls[side] = -6 * grad_u / np.linalg.norm(grad_u)  # six pixels downhill
    print(f"{side:5}: row {x.u[1]:.2f} before, {(x.u + pulls[side])[1]:.2f} after a step of 6 px")
show_pair([("a guess, and where its image wants to go", [guess], pulls)])
assert abs(pulls["left"][1] - pulls["right"][1]) > 0.5

# %% [markdown]
# Cameras side by side see a point in the same row, whatever its depth. After the step the rows differ: no Gaussian
# looks like this to both, and a third camera has nothing to draw. The steps were taken on pictures of the thing. They
# have to be taken on the thing: its mean $\mu$, quaternion $q$, log-scales $\ell$, coefficients $k$ and logit $\lambda$.
#
# $$p = W(\mu - e), \quad u = f\,\tfrac{p_{xy}}{p_z} + c, \qquad n = \tfrac{q}{|q|}, \quad M = R(n)\, e^{\mathrm{diag}\,\ell},
# \quad N = J(p)\, W M, \quad \Sigma = N N^\top + 0.3\, I, \quad \Lambda = \Sigma^{-1}, $$
#
# $$d = \tfrac{\mu - e}{|\mu - e|}, \qquad \text{colour} = \max\bigl(0, \textstyle\sum_i b_i(d)\, k_i + 0.5\bigr), \qquad
# o = \tfrac{1}{1 + e^{-\lambda}}$$
#
# with the camera's rotation $W$ and centre $e$. The $2 \times 3$ matrix $J$ is chapter 04's affine camera. Chapter 12
# delivers the derivatives by $u$, $\Lambda$, colour and $o$; each of these links has to carry them one link further back.
#
# ## One rule for every link
#
# $L$ is one number. Write $\bar X$ for $\partial L / \partial X$: an array of the shape of $X$, with one derivative per
# entry. For a small change $dX$ the loss changes by the sum of all entries' shares, an inner product of arrays:
#
# $$dL = \langle \bar X, dX \rangle, \qquad \langle A, B \rangle = \sum_{ij} A_{ij} B_{ij} .$$
#
# A link makes $Y$ from $X$, and $\bar Y$ is known. Write $dY$ by $dX$, put it into $\langle \bar Y, dY \rangle$, and
# move everything but $dX$ to the other side. What stands there is $\bar X$. Matrices move by
#
# $$\langle A, B\,C \rangle = \langle B^\top A,\; C \rangle = \langle A\,C^\top,\; B \rangle . $$
#
# That is the chain rule, read from the end. The matrix $\partial Y / \partial X$ is never built. If $X$ is used
# twice, its two shares add. Every link below is checked alone: $\bar Y$ is drawn at random, which makes
# $L = \langle \bar Y, Y \rangle$, and each entry of $X$ is nudged both ways.
#
# Differences need smooth functions. Here there are divisions by depths of about 3, an exponential, a
# root, an inverse of a matrix that has 0.3 on its diagonal, and polynomials: all smooth. Two corners are left, the
# clamp inside $J$ and the floor of the colour, and the scene keeps away from both by much more than a nudge. As in
# chapter 08 a nudge of $\epsilon^{1/3}$ leaves an error of some $\epsilon^{2/3}$. The yardstick is the largest slope;
# third derivatives and $L$ itself may be several times that, so the bound is $10^{-9}$, about 27 $\epsilon^{2/3}$.

# %%
NUDGE, CLOSE = np.finfo(float).eps ** (1 / 3), 1e-9


def differences(loss_of, x):
    slopes = np.empty_like(x)
    for at in np.ndindex(x.shape):
        step = np.zeros_like(x)
        step[at] = NUDGE
        slopes[at] = (loss_of(x + step) - loss_of(x - step)) / (2 * NUDGE)
    return slopes


def agrees(name, derived, loss_of, x):
    gap = np.abs(derived - differences(loss_of, x)).max() / np.abs(derived).max()
    print(f"{name:>34}: {np.size(derived):2d} slopes, off by {gap:.1e} of the largest")
    assert derived.shape == x.shape and gap < CLOSE


camera = Camera.looking_at([0.4, -0.3, -3], [0, 0, 0], 60, 66, H=48, W=64)
W, LIMIT = camera.R, 1.3
sh = 0.2 * rng.normal(size=(16, 3)) + [1.0, 0.8, 0.6] * (np.arange(16) == 0)[:, None]
inside = gaussian([0.3, -0.2, 0.4], [0.5, 0.2, 0.1], [1.2, -0.4, 0.3, 0.7], 0.4, sh)
outside = gaussian([3.0, -0.2, 0.4], [0.9, 0.5, 0.3], [1.2, -0.4, 0.3, 0.7], 0.4, sh)
one, beside = (to_screen(each, camera, LIMIT) for each in (inside, outside))
rim = np.transpose(camera.jacobian_bounds(LIMIT))
for x in (one, beside):
    assert np.abs(x.p[:2] / x.p[2] - rim).min() > 0.05 and np.abs(x.unfloored).min() > 0.05
print(
    "x/z, y/z:", *(np.round(x.p[:2] / x.p[2], 2) for x in (one, beside)), "bounds:", np.round(rim, 2).tolist()
)

# %% [markdown]
# ## The conic
#
# Chapter 12 gives three numbers, $\bar A$, $\bar B$, $\bar C$, and the conic matrix has $B$ in two places. The exponent
# uses their sum, so each place gets half. Then the inverse. From $\Lambda \Sigma = I$ follows
# $d\Lambda = -\Lambda\, d\Sigma\, \Lambda$, and moving both factors over:
#
# $$\bar\Lambda = \begin{pmatrix} \bar A & \bar B / 2 \\ \bar B / 2 & \bar C \end{pmatrix}, \qquad
# \langle \bar\Lambda, -\Lambda\, d\Sigma\, \Lambda \rangle = \langle -\Lambda \bar\Lambda \Lambda,\, d\Sigma \rangle,
# \qquad \bar\Sigma = -\Lambda\, \bar\Lambda\, \Lambda .$$
#
# All four entries of $\Sigma$ count as free: the nudges below change them one at a time, and so make matrices that are not
# symmetric. Adding 0.3 to the diagonal changes no derivative.


# %%
def conic_backward(grad_conic, conic):
    A, B, C = grad_conic
    return -conic @ np.array([[A, B / 2], [B / 2, C]]) @ conic


grad_conic = rng.normal(size=3)
shares = np.array([[grad_conic[0], grad_conic[1] / 2], [grad_conic[1] / 2, grad_conic[2]]])
grad_cov = conic_backward(grad_conic, one.conic)
agrees(
    "covariance from conic",
    grad_cov,
    lambda cov: (shares * np.linalg.inv(cov)).sum(),
    np.linalg.inv(one.conic),
)

# %% [markdown]
# ## A product with its own transpose
#
# $\Sigma = N N^\top + \dots$ holds $N$ twice: $d\Sigma = dN\, N^\top + N\, dN^\top$. The first term moves to
# $\langle \bar\Sigma N, dN \rangle$. The second is its transpose, and $\bar\Sigma$ is symmetric, so it gives the same again.
# $N = J\,(W M)$ is a product of different matrices, and the rule applies twice as it stands:
#
# $$\bar N = 2\, \bar\Sigma N, \qquad \bar M = (J W)^\top \bar N, \qquad \bar J = \bar N\, (W M)^\top .$$

# %%
grad_cov = rng.normal(size=(2, 2))
grad_cov += grad_cov.T
grad_N = 2 * grad_cov @ one.N
grad_M, grad_J = (one.J @ W).T @ grad_N, grad_N @ (W @ one.M).T
agrees("N from covariance", grad_N, lambda N: (grad_cov * (N @ N.T)).sum(), one.N)
agrees("M from N", grad_M, lambda M: (grad_N * (one.J @ W @ M)).sum(), one.M)
agrees("J from N", grad_J, lambda J: (grad_N * (J @ W @ one.M)).sum(), one.J)

# %% [markdown]
# ## The mean moves the affine camera
#
# $J$ is the derivative of the projection at the mean, so when the mean moves, $J$ changes, and with it the ellipse. Whoever
# treats $J$ as a constant gets a wrong gradient of the mean. With $a = p_x / p_z$ and $b = p_y / p_z$
#
# $$J = \frac{1}{p_z} \begin{pmatrix} f_x & 0 & -f_x a \\ 0 & f_y & -f_y b \end{pmatrix} . $$
#
# The mean is in it in two ways. The factor in front has the derivative $-1/p_z^2$, so all of $J$ moves by $-J\,dp_z / p_z$.
# And the last column contains $(a, b)$, which the position $u = f\,(a, b) + c$ uses too. Their shares add:
#
# $$\bar r = f \odot \bar u - \tfrac{1}{p_z} f \odot \bar J_{\cdot 3}, \qquad
# \bar p = \Bigl( \frac{\bar r_1}{p_z},\; \frac{\bar r_2}{p_z},\;
# -\frac{\bar r_1 p_x + \bar r_2 p_y}{p_z^2} - \frac{\langle \bar J, J \rangle}{p_z} \Bigr), \qquad \bar\mu = W^\top \bar p . $$
#
# For captures, $a$ and $b$ inside $J$ are clamped to 1.3 times the image's own range: far off the axis the affine camera is
# wrong, and its ellipse would cover the picture. A clamped number does not move, so $\bar J_{\cdot 3}$ has no
# share of it: the second term of $\bar r$ is zero. The position is never clamped, and keeps the first.
#
# **A prediction.** A Gaussian leaves the image sideways, at a constant depth. How does its width on the screen change, and
# what becomes of that derivative beyond the clamp?


# %%
def mean_backward(grad_u, grad_J, x):
    x_z, z = x.p[:2] / x.p[2], x.p[2]
    through_J = np.where(x.ratio == x_z, -x.focal * grad_J[:, 2] / z, 0)
    grad_ratio = x.focal * grad_u + through_J
    return np.array([*grad_ratio / z, -grad_ratio @ x_z / z - (grad_J * x.J).sum() / z])


def moved_to(p, like=inside, limit=LIMIT):
    return to_screen(like | {"means": camera.eye + W.T @ p}, camera, limit)


grad_u = rng.normal(size=2)
for name, x in (("inside", one), ("clamped", beside)):
    derived = mean_backward(grad_u, grad_J, x)
    agrees(
        f"mean from u and J, {name}",
        derived,
        lambda p: grad_u @ moved_to(p).u + (grad_J * moved_to(p).J).sum(),
        x.p,
    )

places, only_width = np.linspace(-0.2, 1.2, SWEEP), np.array([[1.0, 0], [0, 0]])
fig, axes = plt.subplots(1, 2, figsize=(11, 3.5), layout="constrained")
for limit, style in ((None, "--"), (LIMIT, "-")):
    path = [moved_to(np.array([3 * a, 0.2, 3]), inside, limit) for a in places]
    axes[0].plot(
        places, [x.N[0] @ x.N[0] for x in path], style, label="clamped at 1.3" if limit else "as it is"
    )
    slopes = [mean_backward(np.zeros(2), 2 * only_width @ x.N @ (W @ x.M).T, x)[0] for x in path]
    line = axes[1].plot(places, slopes, style)[0]
    for x in path[:: SWEEP // 20]:
        both = [moved_to(x.p + [s * NUDGE, 0, 0], inside, limit).N[0] for s in (1, -1)]
        measured = (both[0] @ both[0] - both[1] @ both[1]) / (2 * NUDGE)
        axes[1].plot(x.p[0] / 3, measured, "o", color=line.get_color(), markersize=4)
for ax in axes:
    ax.axvline(rim[1, 0], color="black", linewidth=0.8)
    ax.set(xlabel="x/z of the mean; the line is the clamp")
axes[0].set(title="a Gaussian leaves the image", ylabel="variance of its ellipse along u (px²)")
axes[1].set(title="derivative in x: by hand, dots by differences", ylabel="px² per world unit")
axes[0].legend()
plt.show()
assert all(slope == 0 for slope, a in zip(slopes, places, strict=True) if a > rim[1, 0])

# %% [markdown]
# Beyond the clamp the ellipse has stopped: the derivative is zero, with a jump at the line, where the function has a
# corner. Differences across it would mean nothing.
#
# ## Rotation and scales
#
# Column $k$ of $M$ is $e^{\ell_k}$ times column $k$ of $R$, and an exponential is its own derivative: $dM_{ik} = M_{ik}\,
# d\ell_k + dR_{ik}\, e^{\ell_k}$. So
#
# $$\bar\ell_k = \sum_i \bar M_{ik} M_{ik}, \qquad \bar R = \bar M S .$$
#
# $R(n)$ is quadratic in the unit quaternion $n = (w, x, y, z)$; its four derivatives are matrices with linear entries,
# and $\bar n_k = \langle \bar R, \partial R / \partial n_k \rangle$. That treats the entries of $n$ as free,
# and they are not. What is free is $q$. From $n = q / |q|$ and $d|q| = n \cdot dq$ follows
#
# $$dn = \frac{dq - n\,(n \cdot dq)}{|q|}, \qquad \bar q = \frac{\bar n - n\,(n \cdot \bar n)}{|q|} . $$
#
# **A prediction.** In which direction can this $\bar q$ never point, and what does a gradient step therefore do to $|q|$?


# %%
def unit_backward(grad_unit, vector):
    length = np.linalg.norm(vector)
    unit = vector / length
    return (grad_unit - unit * (unit @ grad_unit)) / length


def rotation_slopes(n):
    """dR/dw, dR/dx, dR/dy, dR/dz: (4, 3, 3)."""
    w, x, y, z = 2 * n
    return np.array(
        [
            [[0, -z, y], [z, 0, -x], [-y, x, 0]],
            [[0, y, z], [y, -2 * x, -w], [z, w, -2 * x]],
            [[-2 * y, x, w], [x, 0, z], [-w, z, -2 * y]],
            [[-2 * z, -w, x], [w, -2 * z, y], [x, y, 0]],
        ]
    )


def quaternion_backward(grad_R, q):
    return unit_backward(np.einsum("kij,ij->k", rotation_slopes(q / np.linalg.norm(q)), grad_R), q)


agrees(
    "log-scales from M", (grad_M * one.M).sum(0), lambda v: (grad_M * one.R * np.exp(v)).sum(), one.log_scales
)
grad_R = grad_M * one.s
grad_q = quaternion_backward(grad_R, one.quats)
agrees("quaternion from R", grad_q, lambda q: (grad_R * quat_to_R(q)).sum(), one.quats)
print(f"along q itself: {abs(grad_q @ one.quats) / np.linalg.norm(grad_q):.1e}")

w, z = np.meshgrid(np.linspace(-2, 2, 60), np.linspace(-2, 2, 60))
turned = np.array([(grad_R * quat_to_R([a, 0, 0, b])).sum() for a, b in zip(w.flat, z.flat, strict=True)])
fig, ax = plt.subplots(figsize=(5.4, 4.4), layout="constrained")
levels = ax.contourf(w, z, turned.reshape(w.shape), 15, cmap="cividis")
for radius in (0.7, 1.3, 1.9):
    for angle in np.arange(0.2, 2 * np.pi, np.pi / 5):
        q = radius * np.array([np.cos(angle), 0, 0, np.sin(angle)])
        ax.quiver(
            *q[[0, 3]], *quaternion_backward(grad_R, q)[[0, 3]], color="w", scale=40 * np.abs(grad_R).max()
        )
ax.set(title="L(q) for q = (w, 0, 0, z), and its gradient", xlabel="w", ylabel="z", aspect="equal")
fig.colorbar(levels, ax=ax, label="L")
plt.show()
assert abs(grad_q @ one.quats) < 1e-14 * np.linalg.norm(grad_q) * 10

# %% [markdown]
# The length of $q$ changes nothing, so the contours are rays, the gradient runs around the origin, and it is as small
# as $q$ is long. A step along a tangent makes $q$ longer, never shorter.
#
# ## Colour, and who is looking
#
# Let $c' = \sum_i b_i(d)\, k_i + 0.5$ be the colour before the floor, with the harmonics of degrees 0 to 3. A channel
# below zero is floored, and nothing moves it: $\bar c' = \bar c$ where $c' > 0$, else 0. Then
#
# $$\bar k_i = b_i(d)\, \bar c', \qquad \bar d = \sum_i (k_i \cdot \bar c')\, \nabla b_i(d) .$$
#
# Each $b_i$ is a polynomial in $x, y, z$, and $\nabla b_i$ its three derivatives. Degree 0 has none; degree 1
# has constant ones, and so on. Finally $d$ is $\mu - e$ divided by its length, the link that the quaternion had: a
# second share of $\bar\mu$.


# %%
def harmonic_slopes(d):
    """Gradients of the 16 harmonics as polynomials in x, y, z: (16, 3)."""
    x, y, z = d
    xx, yy, zz = d * d
    rows = [(0, 0, 0), (0, -1, 0), (0, 0, 1), (-1, 0, 0)]
    rows += [(y, x, 0), (0, z, y), (-2 * x, -2 * y, 4 * z), (z, 0, x), (2 * x, -2 * y, 0)]
    rows += [
        (6 * x * y, 3 * (xx - yy), 0),
        (y * z, x * z, x * y),
        (-2 * x * y, 4 * zz - xx - 3 * yy, 8 * y * z),
    ]
    rows += [
        (-6 * x * z, -6 * y * z, 6 * zz - 3 * xx - 3 * yy),
        (4 * zz - 3 * xx - yy, -2 * x * y, 8 * x * z),
    ]
    rows += [(2 * x * z, -2 * y * z, xx - yy), (3 * (xx - yy), -6 * x * y, 0)]
    return np.array(rows) * np.array([0, C1, C1, C1, *C2, *C3])[:, None]


def color_backward(grad_color, x):
    """dL/d coefficients, and the share of dL/d mean that comes through the viewing direction."""
    grad_unfloored = np.where(x.unfloored > 0, grad_color, 0)
    grad_d = harmonic_slopes(x.d)[: len(x.sh)].T @ (x.sh @ grad_unfloored)
    return np.outer(sh_basis(x.d)[: len(x.sh)], grad_unfloored), unit_backward(grad_d, x.offset)


grad_color = rng.normal(size=3)
for degree, count in enumerate((1, 4, 9, 16)):
    short = inside | {"sh": inside["sh"][:count]}
    grad_sh, grad_mean = color_backward(grad_color, to_screen(short, camera))
    loss_of = lambda **change: grad_color @ to_screen(short | change, camera).color
    agrees(f"coefficients, degree {degree}", grad_sh, lambda sh: loss_of(sh=sh), short["sh"])
    if degree:
        agrees(
            f"mean from colour, degree {degree}",
            grad_mean,
            lambda means: loss_of(means=means),
            short["means"],
        )
    assert abs(grad_mean @ one.offset) < 1e-14 * 10, "straight away from the camera no colour changes"

# %% [markdown]
# ## All of it
#
# The opacity's link is one factor, the sigmoid's derivative $o(1-o)$. Now the links in order, for one Gaussian: a dozen
# lines, and every one of them was checked above. `project_backward` in `native/project_backward.cpp` and in
# `engine/project_backward.wgsl` is the same list, for a Gaussian per lane or per thread; the forward
# half of it is in [gsplat_edu.render.torch_reference](../src/gsplat_edu/render/torch_reference.py), for autograd to differentiate.


# %%
def to_parameters(x, camera, grad_u, grad_conic, grad_color, grad_opacity):
    """From the screen to the raw parameters of one Gaussian; x is what to_screen returned."""
    W = camera.R
    grad_N = 2 * conic_backward(grad_conic, x.conic) @ x.N
    grad_M, grad_J = (x.J @ W).T @ grad_N, grad_N @ (W @ x.M).T
    grad_sh, by_color = color_backward(grad_color, x)
    return {
        "means": W.T @ mean_backward(grad_u, grad_J, x) + by_color,
        "quats": quaternion_backward(grad_M * x.s, x.quats),
        "log_scales": (grad_M * x.M).sum(axis=0),
        "sh": grad_sh,
        "logit_opacities": grad_opacity * x.opacity * (1 - x.opacity),
    }


def by_hand(gaussians, camera, weights, limit=None):
    """The picture of a scene, and dL/d raw parameters of each Gaussian for L = sum of weights times picture."""
    seen = [to_screen(one, camera, limit) for one in gaussians]
    order = np.argsort([x.p[2] for x in seen])
    near = [seen[i] for i in order]
    found = [
        to_parameters(x, camera, *slopes)
        for x, slopes in zip(near, screen_slopes(near, camera, weights), strict=True)
    ]
    return paint(near, camera)[0], [found[i] for i in np.argsort(order)]


# %% [markdown]
# The witnesses. Autograd differentiates the dense renderer and knows nothing of these formulas, and the package's native kernels
# have their own. First one Gaussian inside the image and one that is clamped, then both and six others in one picture,
# which also passes chapter 12's half. Autograd and this page do the same arithmetic in another order, some hundred
# roundings of $10^{-16}$: they agree to $10^{-12}$ of the largest slope of each parameter. The kernels take $10^{-9}$, the
# bound of the package's own tests, because their alphas come from a recurrence.


# %%
def by_package(gaussians, camera, weights, backend, limit=None):
    leaves = {name: torch.tensor(np.stack([one[name] for one in gaussians])) for name in gaussians[0]}
    sh = leaves.pop("sh")
    leaves = Gaussians(sh0=sh[:, :1], sh_rest=sh[:, 1:], **leaves).trainable()
    image = render(leaves, camera, settings=RenderSettings(jacobian_limit=limit), backend=backend).image
    (image * torch.tensor(weights)).sum().backward()
    grads = {name: tensor.grad.numpy() for name, tensor in leaves.tensors().items()}
    grads["sh"] = np.concatenate([grads.pop("sh0"), grads.pop("sh_rest")], axis=1)
    return image.detach().numpy(), grads


others = [
    gaussian(
        rng.uniform(-0.8, 0.8, 3),
        rng.uniform(0.1, 0.4, 3),
        rng.normal(size=4),
        1.0,
        0.3 * rng.normal(size=(16, 3)),
    )
    for _ in range(6)
]
weights = rng.normal(size=(camera.H, camera.W, 3))
for title, scene in (("one", [inside]), ("one clamped", [outside]), ("scene", [inside, outside, *others])):
    image, mine = by_hand(scene, camera, weights, LIMIT)
    for backend, bound in (("torch", 1e-12), ("cpu", 1e-9)):
        picture, theirs = by_package(scene, camera, weights, backend, LIMIT)
        gaps = {
            name: np.abs([each[name] for each in mine] - other).max() / np.abs(other).max()
            for name, other in theirs.items()
        }
        print(
            f"{title:>11} against {backend:5}:", ", ".join(f"{name} {gap:.0e}" for name, gap in gaps.items())
        )
        assert max(gaps.values()) < bound and np.abs(image - picture).max() < 1e-12

# %% [markdown]
# ## Two photos, one thing
#
# Back to the two cameras. Their derivatives now meet in the same 59 numbers, where shares add, and a quasi-Newton method with a
# line search, which fails on wrong slopes, descends.


# %%
def pack(one):
    return np.concatenate([one[name].ravel() for name in guess])


def unpack(flat):
    parts = np.split(flat, np.cumsum([array.size for array in guess.values()])[:-1])
    return {name: part.reshape(array.shape) for (name, array), part in zip(guess.items(), parts, strict=True)}


def loss_and_slopes(flat):
    loss, slopes, one = 0, 0, unpack(flat)
    for camera, photo in zip(cameras, photos, strict=True):
        error = paint([to_screen(one, camera)], camera)[0] - photo
        loss, slopes = (
            loss + (error**2).mean(),
            slopes + pack(by_hand([one], camera, 2 * error / error.size)[1][0]),
        )
    return loss, slopes


path = [pack(guess)]
minimize(
    loss_and_slopes,
    path[0],
    jac=True,
    method="L-BFGS-B",
    callback=lambda x: path.append(x.copy()),
    options={"maxiter": STEPS, "ftol": 0, "gtol": 1e-12},
)
falls = [loss_and_slopes(flat)[0] for flat in path]
print(f"{len(path) - 1} steps: loss {falls[0]:.1e} -> {falls[-1]:.1e}")
print("mean", path[-1][:3].round(3), "and that of the photos", wanted["means"])
rows = [[to_screen(unpack(flat), camera).u[1] for camera in cameras] for flat in path]
assert np.ptp(rows, axis=1).max() < 1e-12, "at every step both cameras see one thing"
assert falls[-1] < 1e-3 * falls[0]
show_pair([("the way down", [unpack(flat) for flat in path[:: max(1, len(path) // 8)]], None)])

# %% [markdown]
# ## The next failure
#
# Every derivative is now known to twelve digits. Start the same Gaussian further and further from where it should be:

# %%
for shift in (0.5, 1, 1.5, 2, 2.5):
    one = inside | {"means": wanted["means"] + [0, shift, 0]}
    slopes = loss_and_slopes(pack(one))[1]
    print(f"{shift} below: length of the mean's slope {np.linalg.norm(slopes[:3]):.1e}")
