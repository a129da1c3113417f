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
# # 03 - Gaussians in three dimensions, and cameras
#
# [Chapter 02](02_gaussians_in_2d.ipynb) ended with a splat that is a mark on one picture. Suppose there are two
# pictures of a rod, with the right splat in each, and we want a third view from between them. The splats'
# numbers can be averaged. The middle panel is what comes of it.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

from gsplat_edu import Z_NEAR, Camera, build_cov3d, quat_to_R

SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
DRAWN = 40_000 if SHORT else 400_000
print(f"budget: {DRAWN} samples{' (reduced)' if SHORT else ''}")

rng = np.random.default_rng(3)
turn = np.linspace(0.0, 2 * np.pi, 200)
circle = np.stack([np.cos(turn), np.sin(turn)])


def ellipse(cov2d, k=1.0):
    """Return the contour of a 2D Gaussian at k standard deviations."""
    return k * np.linalg.cholesky(cov2d) @ circle


rod = rng.normal(size=(400, 3)) * [0.1, 0.1, 1.0]
fig, axes = plt.subplots(1, 3, figsize=(10.5, 3.3), layout="constrained", sharey=True)
fitted = []
for ax, degrees in zip((axes[0], axes[2], axes[1]), (-60, 60, 0), strict=True):
    a = np.radians(degrees)
    seen = np.stack([np.cos(a) * rod[:, 0] + np.sin(a) * rod[:, 2], rod[:, 1]])
    fitted.append(np.cov(seen) if degrees else (fitted[0] + fitted[1]) / 2)
    ax.plot(*seen, ".", markersize=3, label="the rod")
    ax.plot(*ellipse(fitted[-1], 2), linewidth=2, label="the splat, two sigma")
    title = f"{degrees} degrees" + ": the average of the two" * (degrees == 0)
    ax.set(title=title.replace("-", "\N{MINUS SIGN}"), xlabel="x (world units)", aspect="equal")
    ax.axis((-2.5, 2.5, 1.5, -1.5))
axes[0].set(ylabel="y (world units)")
fig.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
plt.show()
print(f"variance across from the front: rod {np.var(rod[:, 0]):.3f}, averaged splat {fitted[-1][0, 0]:.3f}")
assert fitted[-1][0, 0] > 30 * np.var(rod[:, 0])

# %% [markdown]
# From the front the rod is seen end on. No arithmetic between pictures knows that. The blob has to be put where
# the rod is.
#
# ## Six numbers
#
# In three dimensions nothing about the formula changes: a mean $\mu$, a symmetric $3 \times 3$ covariance
# $\Sigma$, and $\exp(-\frac12 (x-\mu)^\top\Sigma^{-1}(x-\mu))$. A symmetric $3 \times 3$ matrix has six numbers,
# and the last chapter showed what happens when entries are changed freely. Now gradient descent changes them. A
# flat disc is given by its values at some points; plain gradient descent on the six numbers starts from a ball
# and has to find it.
#
# > **Predict.** The loss falls in each of three runs: six numbers with a high rate, six numbers with a fifth of it,
# > and a product of scales and a quaternion. Which of them end with something that is no Gaussian? Would the loss
# > warn you?

# %%
disc_scales, disc_quat = np.array([0.5, 0.4, 0.06]), np.array([0.9, 0.3, -0.2, 0.1])
disc = build_cov3d(disc_scales, quat_to_R(disc_quat))
probes = rng.multivariate_normal(np.zeros(3), disc + 0.02 * np.eye(3), size=300)


def values_of(cov3d):
    return np.exp(-0.5 * np.einsum("ni,ij,nj->n", probes, np.linalg.inv(cov3d), probes))


def from_six(p):
    return np.array([[p[0], p[1], p[2]], [p[1], p[3], p[4]], [p[2], p[4], p[5]]])


def from_scales_and_quat(p):
    return build_cov3d(np.exp(p[:3]), quat_to_R(p[3:]))


def descend(build, start, rate):
    """Take gradient steps by central differences; return the losses and the smallest eigenvalues on the way."""
    p, wanted, descent, smallest = np.array(start, dtype=float), values_of(disc), [], []
    for _ in range(400):
        smallest.append(np.linalg.eigvalsh(build(p))[0])
        if smallest[-1] <= 0:
            break  # what follows is not a Gaussian, and its loss says nothing
        descent.append(((values_of(build(p)) - wanted) ** 2).mean())
        nudges = 1e-6 * np.eye(len(p))
        both = [[((values_of(build(p + s * n)) - wanted) ** 2).mean() for s in (1, -1)] for n in nudges]
        p -= rate * np.diff(both, axis=1)[:, 0] / -2e-6
    return np.array(descent), np.array(smallest)


ball_six, ball_seven = [0.04, 0, 0, 0.04, 0, 0.04], [*np.log([0.2, 0.2, 0.2]), 1, 0, 0, 0]
runs = {
    "six numbers, rate 0.01": descend(from_six, ball_six, 0.01),
    "six numbers, rate 0.002": descend(from_six, ball_six, 0.002),
    "scales and quaternion": descend(from_scales_and_quat, ball_seven, 0.5),
}
fig, axes = plt.subplots(1, 2, figsize=(11, 3.5), layout="constrained")
for (name, (descent, smallest)), style in zip(runs.items(), ("o-", "--", "-"), strict=True):
    axes[0].plot(descent, style, markersize=3, label=name)
    axes[1].plot(smallest, style, markersize=3, label=name)
    last = f"{len(smallest) - 1:3d} steps, loss {descent[-1]:.4f}, eigenvalue {smallest[-1]:+.4f}"
    print(f"{name:24s} {last}, least on the way {smallest.min():+.4f}")
axes[0].set(title="loss", xlabel="step", ylabel="mean squared error", yscale="log")
axes[1].axhline(0, color="black", linewidth=0.8)
axes[1].set(title="smallest eigenvalue", xlabel="step", ylabel="eigenvalue (world units squared)")
axes[1].legend(loc="upper right")
plt.show()
fast, slow, product = runs.values()
assert fast[1][-1] <= 0 < product[1].min() and product[0][-1] < 0.2 * slow[0][-1]

# %% [markdown]
# The first run goes down and then over the edge: an eigenvalue has become negative, and what is left has no
# exponent that falls in every direction. Nothing in the loss warned of it. The disc is flat, so it lies close to
# the edge, and there the loss is steep. A fifth of the rate does not settle either: the second run swings between
# the edge and the far side, wider and wider. The third run stores something else, and cannot leave whatever its step.
#
# ## A turned and stretched ball
#
# As in two dimensions the way out is a product. Any Gaussian is a ball of variance 1 that was stretched along
# the axes by $S = \mathrm{diag}(s_1, s_2, s_3)$ and then turned by a rotation $R$:
#
# $$x = \mu + R\,S\,q, \qquad \Sigma = (R\,S)(R\,S)^\top.$$
#
# The scales are kept as logarithms, so that they stay positive. That leaves $R$, and with it the same mistake once
# more. A rotation has nine entries and three degrees of freedom; steps on the entries leave the rotations, and $R$
# begins to shear what it should turn. Below, it and a list of four numbers get the same small random steps.

# %%
nine, four = np.eye(3), np.array([1.0, 0.0, 0.0, 0.0])
drift, drift_quat = [], []
for _ in range(300):
    nine = nine + 0.01 * rng.normal(size=(3, 3))
    four = four + 0.01 * rng.normal(size=4)
    drift.append(np.abs(nine @ nine.T - np.eye(3)).max())
    drift_quat.append(np.abs(quat_to_R(four) @ quat_to_R(four).T - np.eye(3)).max())
print(f"R R' - I after 300 steps: nine entries {drift[-1]:.2f}, four numbers {drift_quat[-1]:.1e}")
assert drift[-1] > 0.1 and max(drift_quat) < 1e-14

# %% [markdown]
# ## Four numbers that are always a rotation
#
# In the plane a unit complex number turns by multiplication: it has length 1, and lengths multiply. Hamilton found
# that in space, for [quaternions](../docs/GLOSSARY.md#quaternion), it takes three imaginary units,
# $i^2 = j^2 = k^2 = ijk = -1$. With a number written as $(w, a)$, a real part and a vector, these rules say
#
# $$(w, a)(w', b) = (w w' - a \cdot b,\; w b + w' a + a \times b),$$
#
# and again lengths multiply. But $q\,(0, v)$ has a real part and is not a vector. Multiply by the conjugate
# $q^* = (w, -a)$ from the other side as well, and it goes away. For $q$ of length 1
#
# $$q\,(0, v)\,q^* = (0,\; v + 2w\,(a \times v) + 2\,a \times (a \times v)).$$
#
# Put in the three axes for $v$, and with $q = (w, x, y, z)$ the columns of a matrix come out:
#
# $$R(q) = \begin{pmatrix} 1 - 2(y^2 + z^2) & 2(xy - wz) & 2(xz + wy) \\
# 2(xy + wz) & 1 - 2(x^2 + z^2) & 2(yz - wx) \\
# 2(xz - wy) & 2(yz + wx) & 1 - 2(x^2 + y^2) \end{pmatrix}.$$
#
# The map is linear in $v$ and keeps its length, and it moves continuously from the identity: a rotation, about the
# axis $a$. A vector perpendicular to $a$ is turned by the angle $\theta$ with $\cos\theta = 1 - 2|a|^2$, so
# $w = \cos(\theta/2)$. And if every $q$ is divided by its length before use, all lists of four numbers but one are
# rotations. A step can go anywhere.

# %%


def hamilton(p, q):
    """Multiply two quaternions (w, x, y, z)."""
    a, b = p[1:], q[1:]
    return np.array([p[0] * q[0] - a @ b, *(p[0] * b + q[0] * a + np.cross(a, b))])


def quaternion_matrix(q):
    """Build the matrix of v -> q v q*: its columns are what becomes of the three axes."""
    q = q / np.linalg.norm(q)
    conjugate = q * [1, -1, -1, -1]
    return np.stack(
        [hamilton(hamilton(q, np.array([0.0, *axis])), conjugate)[1:] for axis in np.eye(3)], axis=1
    )


for q in rng.normal(size=(200, 4)):
    # Some thirty operations on numbers of at most 2, each rounded to 1e-16.
    assert np.allclose(quaternion_matrix(q), quat_to_R(q), rtol=0, atol=1e-14)
    assert np.allclose(quat_to_R(-3 * q), quat_to_R(q), rtol=0, atol=1e-14)  # neither sign nor length matters
axis, theta = np.array([2.0, -1.0, 2.0]) / 3, 0.7
R = quaternion_matrix(np.array([np.cos(theta / 2), *(np.sin(theta / 2) * axis)]))
assert np.allclose(R @ axis, axis, rtol=0, atol=1e-14) and np.isclose(np.trace(R), 1 + 2 * np.cos(theta))
print("q v q* agrees with quat_to_R")

# %% [markdown]
# Both functions, `quat_to_R` and `build_cov3d`, are in
# [gsplat_edu.scene.gaussian_math](../src/gsplat_edu/scene/gaussian_math.py). What they make is an ellipsoid: the points
# at one standard deviation, with the columns of $R$ as axes.

# %%
ball = rng.normal(size=(DRAWN, 3))


def sampling_error(cov):
    """Return the standard deviation of a sample covariance: sqrt((S_ii S_jj + S_ij²) / n)."""
    return np.sqrt((np.outer(np.diag(cov), np.diag(cov)) + cov**2) / len(ball))


scales, quat = np.array([0.5, 0.1, 0.15]), np.array([0.9, 0.15, 0.5, 0.1])
RS = quat_to_R(quat) * scales
cov3d = build_cov3d(scales, quat_to_R(quat))
cloud = ball @ RS.T
assert np.all(np.abs(cloud.T @ cloud / DRAWN - cov3d) < 5 * sampling_error(cov3d))

polar, azimuth = np.meshgrid(np.linspace(0, np.pi, 61), np.linspace(0, 2 * np.pi, 121), indexing="ij")
unit = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
fig = plt.figure(figsize=(9, 4.2), layout="constrained")
for panel, (matrix, title) in enumerate(((np.diag(scales), "stretched: S"), (RS, "then turned: R S"))):
    ax = fig.add_subplot(1, 2, panel + 1, projection="3d")
    ax.plot_surface(*np.moveaxis(unit @ matrix.T, -1, 0), alpha=0.35, linewidth=0)
    for column, color in zip(matrix.T, ("C1", "C2", "C3"), strict=True):
        ax.plot(*np.stack([-column, column], axis=1), color=color, linewidth=3)
    ax.set(title=title, xlim=(-0.5, 0.5), ylim=(0.5, -0.5), zlim=(-0.5, 0.5), box_aspect=(1, 1, 1))
    ax.set(xlabel="x (world units)", ylabel="y (world units)", zlabel="z (world units)")
    ax.view_init(elev=20, azim=-60)
plt.show()

# %% [markdown]
# > **Why this bound.** As in chapter 02: five standard deviations of a sample covariance, which chance exceeds about
# > once in two million.
#
# ## In front of a camera
#
# The splat is in the world; now we need a picture of it. Take the simple camera first, one that forgets depth,
# as the first picture of this course did. It is affine, $u = A x + b$ with a $2 \times 3$ matrix $A$, and
#
# $$u = A\,(\mu + R S q) + b = (A\mu + b) + (A R S)\,q$$
#
# is a matrix times a round Gaussian again. The image is a Gaussian with covariance $A \Sigma A^\top$, exactly, at
# any size and from anywhere. Each direction in it has *skewness* 0, the mean of the offset's cube in standard
# deviations.

# %%


def skewness(values):
    centred = values - values.mean(axis=-1, keepdims=True)
    return (centred**3).mean(axis=-1) / centred.std(axis=-1) ** 3


camera = Camera.looking_at(eye=[0, 0, 0], target=[0, 0, 1], fx=200, fy=200, H=256, W=256)
A = np.array([[200 / 4.0, 0, 0], [0, 200 / 4.0, 0]]) @ quat_to_R([0.9, 0.1, 0.3, 0.0])
flat = A @ cloud.T
exact = A @ cov3d @ A.T
print("affine: expected", exact.round(1).tolist(), " sampled", np.cov(flat).round(1).tolist())
print("affine: skewness", skewness(flat).round(4))
assert np.all(np.abs(np.cov(flat) - exact) < 5 * sampling_error(exact))
assert np.all(
    np.abs(skewness(flat)) < 5 * np.sqrt(6 / DRAWN)
)  # the skewness of n normal numbers varies by that

# %% [markdown]
# The [pinhole](../docs/GLOSSARY.md#pinhole) of [gsplat_edu.scene.camera](../src/gsplat_edu/scene/camera.py) divides
# by depth. Points of the near end of a splat are spread out more than those of the far end. So take one that is long,
# leans away from the camera and stands off the axis, and walk towards it along one ray.

# %%
DIRECTION = np.array([0.3, 0.1, 1.0])  # of the ray, scaled to depth 1


def seen_from(distance):
    """Project the cloud with its mean at this depth; leave out, and count, what the renderer would cull."""
    points = cloud + distance * DIRECTION
    points = points[points[:, 2] > Z_NEAR]
    return np.stack(camera.project(points)[:2]), DRAWN - len(points)


centre = np.stack(camera.project(DIRECTION)[:2])  # of the image of the mean: the same at every distance
ways = np.geomspace(1.5, 24.0, 9)
shifts, skews = [], []
for way in ways:
    pixels, culled = seen_from(way)
    shift = pixels.mean(axis=1) - centre
    shifts.append(np.abs(shift[0]) / pixels[0].std())
    skews.append(np.abs(skewness(pixels[0])))
    # To second order in the offsets from the mean, E[x/z] - E[x]/E[z] = (x/z) S_zz / z² - S_xz / z².
    predicted = 200 * (DIRECTION[0] * cov3d[2, 2] - cov3d[0, 2]) / way**2
    print(
        f"distance {way:4.1f}: mean is off by {shift[0]:7.3f} px, to second order {predicted:7.3f}; "
        f"skewness {skews[-1]:.3f}, culled {culled}"
    )
    # The next order is 3 S_zz / z² of this one, twice that covers the rest where z is over ten deviations;
    # and the mean of a sample varies by its deviation over sqrt(n).
    if way > 10 * np.sqrt(cov3d[2, 2]):
        slack = 6 * cov3d[2, 2] / way**2 * abs(predicted) + 5 * pixels[0].std() / np.sqrt(DRAWN)
        assert abs(shift[0] - predicted) < slack

fig, axes = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
for ax, values, anchor in ((axes[0], shifts, -1), (axes[1], skews, -3)):
    ax.loglog(ways, values, "o-", label="measured")
    ax.loglog(ways, values[anchor] * ways[anchor] / ways, "k:", label="1 / distance")
    ax.set_xticks([2, 5, 10, 20], ["2", "5", "10", "20"])
    ax.xaxis.minorticks_off()
    ax.legend()
axes[0].set(title="the mean of the image is not the image of the mean", xlabel="distance (world units)")
axes[0].set(ylabel="shift (standard deviations)")
axes[1].set(title="and it leans", xlabel="distance (world units)", ylabel="absolute skewness")
plt.show()
assert shifts[0] > 5 * shifts[-1] and skews[0] > 0.5

# %% [markdown]
# > **Why this bound.** With $h$ the offset in depth, $1/z = (1 - h/m_z + h^2/m_z^2 - \dots)/m_z$. The second power
# > gives the prediction, odd powers vanish in the mean, and the fourth brings $\mathrm{E}[h^4] = 3\,\Sigma_{zz}^2$:
# > three times $\Sigma_{zz}/m_z^2$ of the prediction. Twice that leaves room for the rest.
#
# Both faults go with the size of the splat against its distance. Far away perspective is as good as affine. Near
# the camera the image has its mean in one place, the image of its mean in another, and a long tail on one side. If
# nothing were culled it would have no mean at all: some points lie as near to depth 0 as one likes.
#
# The shape of the bent image can be computed exactly, without samples. Look at a ball with one eye: the rays that
# just touch it are a cone, and a screen cuts an ellipse out of the cone. It is easier to ask for planes than for
# rays. A plane through the eye that touches the ball is a line in the image that touches the outline, and whoever
# knows all tangents of a curve knows the curve. The shell of the Gaussian at $k$ standard deviations has an outline
# in the image: where rays just touch it. Let $m$ be the mean in camera coordinates. A plane through the camera with
# normal $n$ touches the shell when its distance from the mean, $|n \cdot m|$, is what the shell reaches in that
# direction, $k\sqrt{n^\top\Sigma n}$. So
#
# $$n^\top D\,n = 0, \qquad D = m m^\top - k^2 \Sigma.$$
#
# In the image these planes are lines, the tangents of the outline. A line $n_1 u + n_2 v + n_3 = 0$ is tangent to
# an ellipse with centre $c$ and shape $G$ if $(n_1 c_1 + n_2 c_2 + n_3)^2 = (n_1, n_2)\,G\,(n_1, n_2)^\top$, a
# quadratic form as well. So, as long as the whole shell is in front of the camera, $m_z > k\sqrt{\Sigma_{zz}}$, the
# outline is an ellipse, and comparing the two, with $f = 1$,
#
# $$c_1 = \frac{D_{13}}{D_{33}} = \frac{m_x m_z - k^2\Sigma_{xz}}{m_z^2 - k^2\Sigma_{zz}}.$$
#
# The centre depends on $k$. Under an affine camera the outlines are the shells of the image's Gaussian and all have
# one centre. What a pinhole sees of this cloud is not a Gaussian, at any distance.

# %%
to_pixels = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


def outline(distance, k):
    """Return the centre and the shape of the outline of the shell at k standard deviations, in pixels."""
    mean = distance * DIRECTION
    D = to_pixels @ (np.outer(mean, mean) - k**2 * cov3d) @ to_pixels.T
    c = D[:2, 2] / D[2, 2]
    return c, np.outer(c, c) - D[:2, :2] / D[2, 2]


for k in (1, 2, 3):
    c, M = outline(2.0, k)
    u = camera.project(2.0 * DIRECTION + k * unit.reshape(-1, 3) @ RS.T)[0]
    # The grid on the shell has steps of 3 degrees; between two points a circle rises by step² / 8 of its radius.
    reach = np.sqrt(M[0, 0])
    assert np.allclose(
        [u.min(), u.max()], [c[0] - reach, c[0] + reach], rtol=0, atol=reach * np.radians(3) ** 2
    )

fig, axes = plt.subplots(1, 3, figsize=(12, 4.2), layout="constrained")
for ax, way in zip(axes, (12.0, 4.0, 2.0), strict=True):
    pixels, _ = seen_from(way)
    half = 1.15 * np.sqrt(outline(way, 3)[1][0, 0])
    window = [[c - half, c + half] for c in outline(way, 3)[0]]
    ax.hist2d(*pixels, bins=80, range=window, cmap="Greys")
    for k, color in ((1, "C0"), (2, "C1"), (3, "C2")):
        c, M = outline(way, k)
        ax.plot(*(c[:, None] + ellipse(M)), color=color, linewidth=1.2, label=f"shell {k} and its centre")
        ax.plot(*c, "o", color=color, markersize=4)
    ax.plot(*centre, "+", color="C3", markersize=12, markeredgewidth=2, label="image of the mean")
    ax.set(title=f"distance {way:g}", xlabel="u (px)", ylabel="v (px)", xlim=window[0], ylim=window[1][::-1])
axes[0].legend(loc="upper right", fontsize=8)
plt.show()

# %% [markdown]
# ## The next failure
#
# A renderer wants a Gaussian in the image all the same, because everything of
# [chapter 02](02_gaussians_in_2d.ipynb) was made for one. Which? Let it have the mean and the covariance of the
# samples, which no other Gaussian can claim, and count how many samples lie within its ellipses.

# %%
for way in (12.0, 4.0, 2.0):
    pixels, _ = seen_from(way)
    offset = pixels - pixels.mean(axis=1, keepdims=True)
    distance2 = np.einsum("in,ij,jn->n", offset, np.linalg.inv(np.cov(pixels)), offset)
    row = [f"{100 * (distance2 < k * k).mean():.2f} %" for k in (1, 2, 3)]
    print(f"distance {way:4.1f}: within 1, 2, 3 sigma {row}")
promised = np.array([1 - np.exp(-0.5 * k * k) for k in (1, 2, 3)])
print(f"a Gaussian:                         {[f'{100 * share:.2f} %' for share in promised]}")
error = np.sqrt(promised * (1 - promised) / DRAWN)
found = np.array([(distance2 < k * k).mean() for k in (1, 2, 3)])
assert np.abs((found - promised) / error).max() > 20

# %% [markdown]
# It is wrong near the camera, it took all those samples to find, and it would have to be found again for every splat,
# every picture and every step of a training. No Gaussian is exactly right, so the one to draw is chosen for other
# reasons: it has to follow from $\mu$, $\Sigma$ and the camera by a formula short enough for millions of splats, have
# a derivative, and be right where splats are small against their distance, as nearly all of them are. Affine cameras
# are exact. [Chapter 04](04_splatting.ipynb) replaces the pinhole, for each splat, by the affine camera that fits it
# best at the mean, and goes looking for where that breaks.
