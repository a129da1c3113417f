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
# # 04 - One ellipse per Gaussian
#
# A Gaussian that goes through a linear map comes out as a Gaussian. A pinhole divides by depth, and a
# division is not linear: [chapter 03](03_gaussians_in_3d.ipynb) ended with images that no Gaussian describes. A
# renderer that has to draw millions cannot draw samples. It wants one Gaussian in the image for each one in space,
# one ellipse, in closed form, and this page asks which ellipse that should be, how wrong it is, and where it stops
# making sense.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection

from gsplat_edu import ALPHA_MIN, DILATION, Z_NEAR, Camera, sphere_shell
from gsplat_edu.scene.gaussian_math import build_cov3d, project_cov3d, quat_to_R

SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
CLOUD, PAIRS_DRAWN = (100_000, 50_000) if SHORT else (400_000, 400_000)
print(f"budget: {CLOUD:,} samples, {PAIRS_DRAWN:,} pairs of samples{' (reduced)' if SHORT else ''}")

BLUE, ORANGE, GREEN, PURPLE = "#0072b2", "#d55e00", "#009e73", "#cc79a7"
CAMERA = Camera.looking_at(eye=[0, 0, 0], target=[0, 0, 1], fx=150, fy=150, H=128, W=128)

# %% [markdown]
# ## No Gaussian fits
#
# The camera stands at the origin and looks along $+z$. The Gaussian below is close to it, off to the side, and
# longer in depth than across. Its near end is spread over many pixels, its far end over few.

# %%
rng = np.random.default_rng(4)


def draw_samples(mean, cov, n):
    return mean + rng.normal(size=(n, 3)) @ np.linalg.cholesky(cov).T


def outline(mean2d, cov2d, sigmas=1.0, corners=90):
    angle = np.linspace(0, 2 * np.pi, corners)
    return mean2d + sigmas * np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ np.linalg.cholesky(cov2d).T


def pixels_of(samples):
    u, v, _ = CAMERA.project(CAMERA.world_to_cam(samples))
    return np.stack([u, v], axis=-1)


close_mean, close_cov = np.array([0.3, -0.1, 1.2]), np.diag([0.06, 0.06, 0.22]) ** 2
cloud = pixels_of(draw_samples(close_mean, close_cov, CLOUD))
center, spread = cloud.mean(axis=0), np.cov(cloud.T)

long_axis = np.linalg.eigh(spread)[1][:, 1]
along = (cloud - center) @ long_axis
skewness = np.mean((along / along.std()) ** 3)
print(f"skewness along the long axis {abs(skewness):.2f}; a Gaussian's is 0 +- {np.sqrt(6 / CLOUD):.4f}")
assert abs(skewness) > 20 * np.sqrt(6 / CLOUD)

fig, ax = plt.subplots(figsize=(8, 4.6), layout="constrained")
ax.plot(*cloud[:6000].T, ".", color="0.45", markersize=1.5)
for sigmas in (1, 2, 3):
    ax.plot(*outline(center, spread, sigmas).T, color=ORANGE)
ax.set(title="one 3D Gaussian: samples, and the ellipses of their mean and covariance")
ax.set(xlabel="u (px)", ylabel="v (px)", xlim=(65, 185), ylim=(90, 10), aspect="equal")
plt.show()

# %% [markdown]
# The ellipses have the mean and the covariance of the samples themselves, so none could do better by these two
# numbers. As contours of a Gaussian they still reach into empty space on the left and miss the tail on the right.
# Any Gaussian is symmetric about its mean, so its third moment vanishes in every direction; the one printed above
# does not, and the error of its estimate for $n$ Gaussian samples, $\sqrt{6/n}$, is far smaller.
#
# It is worse than that. Depth is Gaussian too, so its density at $z = 0$ is tiny but positive, and there
# $1/z^2$ has no mean. The covariance of the projected cloud does not exist; what was drawn is the
# covariance of a finite sample that happened to stay away from zero. Copying the moments is not even an option.

# %% [markdown]
# ## Linear up close
#
# A Gaussian survives linear maps, and this map is not linear. So we replace the map. Near the mean $m$, in camera
# coordinates, the pinhole $u(x, y, z) = (f_x x/z + c_x,\; f_y y/z + c_y)$ is its tangent and a remainder,
#
# $$u(m + h) = u(m) + J h + O(f\,|h|^2 / z^2).$$
#
# The tangent takes six derivatives. Moving sideways moves the image by focal length over depth; moving away pulls
# the image towards $(c_x, c_y)$, the *principal point*, faster the further it is from there:
#
# $$J = \begin{pmatrix} f_x / z & 0 & -f_x\, x / z^2 \\ 0 & f_y / z & -f_y\, y / z^2 \end{pmatrix}.$$


# %%
def pinhole_jacobian(mean_cam, camera):
    x, y, z = mean_cam
    return np.array([[camera.fx / z, 0, -camera.fx * x / z**2], [0, camera.fy / z, -camera.fy * y / z**2]])


h = 1e-5
ahead, behind = (np.array(CAMERA.project(close_mean + step * np.eye(3))[:2]) for step in (h, -h))
numeric = (ahead - behind) / (2 * h)
J = pinhole_jacobian(close_mean, CAMERA)
print(np.round(J, 3))
print(f"largest difference to central differences: {np.abs(J - numeric).max():.1e}")
assert np.abs(J - numeric).max() < 1e-8
assert np.abs(J @ close_mean).max() < 1e-12

# %% [markdown]
# A central difference errs by $h^2/6$ times a third derivative, here at most $6 f |x| / z^4$, together below
# $3 \cdot 10^{-9}$, and by rounding, about $10^{-14}$ pixels over $h$, half as much; twice the sum is allowed. The last
# assertion says what a photograph loses: $J m = 0$. A step along the ray from the eye to the mean does not show.
#
# A covariance goes through a linear map $A$ as $A \Sigma A^\top$. There are two maps in a row: the camera's rotation
# $W$ from world to camera axes, and $J$. So
#
# $$\Sigma_{2d} = J\, W\, \Sigma\, W^\top J^\top,$$
#
# two by two, in square pixels, around the projected mean. The formula is that of Zwicker et al. (2001). They convolve
# this ellipse with the pixel's low-pass filter, as chapter 02 does with its dilation, and call that
# [EWA](../docs/GLOSSARY.md#ewa-splatting) splatting, after Heckbert's elliptical weighted average. The ellipse is the
# [*splat*](../docs/GLOSSARY.md#splat). Written out it is one line, and `project_cov3d` in
# [gsplat_edu.scene.gaussian_math](../src/gsplat_edu/scene/gaussian_math.py) is that line for many Gaussians at once.


# %%
def ellipse_of(cov3d, mean_cam, camera):
    A = pinhole_jacobian(mean_cam, camera) @ camera.R
    return A @ cov3d @ A.T


turned_camera = Camera.looking_at(eye=[2, -1, -5], target=[0.6, 0.2, 0.4], fx=150, fy=140, H=96, W=128)
small_cov = build_cov3d([0.010, 0.004, 0.016], quat_to_R([0.8, 0.3, -0.4, 0.2]))
small_mean = np.array([0.9, -0.4, 0.8])
small_cam = turned_camera.world_to_cam(small_mean)
by_hand = ellipse_of(small_cov, small_cam, turned_camera)
assert np.allclose(by_hand, project_cov3d(small_cov, small_cam, turned_camera), rtol=1e-13, atol=0)

u, v, _ = turned_camera.project(turned_camera.world_to_cam(draw_samples(small_mean, small_cov, CLOUD)))
sampled = np.cov(u, v)
variances = np.diag(by_hand)
standard_error = np.sqrt((np.outer(variances, variances) + by_hand**2) / CLOUD)
print("covariance by the formula (px^2)\n", np.round(by_hand, 5))
print("covariance of the samples (px^2)\n", np.round(sampled, 5))
print("difference in standard errors\n", np.round((sampled - by_hand) / standard_error, 2))
assert np.all(np.abs(sampled - by_hand) < 4 * standard_error)

# %% [markdown]
# This Gaussian is small and far away, and the camera is turned, so that a forgotten $W$ would show. An entry
# $\hat\Sigma_{ij}$ of the covariance of $n$ Gaussian samples has the variance $(\hat\Sigma_{ii} \hat\Sigma_{jj} +
# \hat\Sigma_{ij}^2)/n$; four of its roots are the tolerance, and the samples cannot tell the formula from the truth.
#
# The close one of the opening is another matter. Below, it is moved away along its ray and keeps its size.

# %%
fig, axes = plt.subplots(1, 3, figsize=(13, 3.9), layout="constrained")
for ax, far in zip(axes, (1, 2, 6), strict=True):
    mean = far * close_mean
    points = pixels_of(draw_samples(mean, close_cov, 2000))
    cov2d = project_cov3d(close_cov, CAMERA.world_to_cam(mean), CAMERA)
    ax.plot(*points.T, ".", color="0.45", markersize=2)
    for sigmas in (1, 2, 3):
        ax.plot(*outline(pixels_of(mean), cov2d, sigmas).T, color=BLUE)
    reach = 4.6 * np.sqrt(cov2d.max())
    (u, v), ratio = pixels_of(mean), 0.22 / mean[2]
    ax.set(title=f"depth {mean[2]:.1f}: standard deviation / depth = {ratio:.3f}", aspect="equal")
    ax.set(xlabel="u (px)", ylabel="v (px)", xlim=(u - reach, u + reach), ylim=(v + reach, v - reach))
fig.suptitle("the linearised ellipse (1, 2, 3 sigma) over samples of the same Gaussian; the axes zoom in")
plt.show()

# %% [markdown]
# ## How wrong, exactly
#
# The picture says that the error falls with size over depth. One image row is enough to say how fast. Let
# $t = x/z$ be the slope at which the mean is seen, $e = \sigma / z$ the size over depth, and $a, c$ two independent
# standard normal numbers. In units of the focal length a sample lands at
#
# $$\frac{t + e a}{1 + e c} = t + e\,(a - tc) + e^2 (tc^2 - ac) + e^3 (ac^2 - tc^3) + \dots$$
#
# This is $1/(1 + x) = 1 - x + x^2 - \dots$ with $x = e c$, multiplied out. The first-order term has variance
# $e^2 (1 + t^2)$, and that is the ellipse. Odd and even terms are uncorrelated. What the ellipse leaves out begins
# with the variance of the second term, $e^4 (1 + 2t^2)$, and twice the covariance of the first with the third,
# $2 e^4 (1 + 3t^2)$. The numbers are moments of normal numbers, $\mathrm{E}[a^2] = 1$ and $\mathrm{E}[c^4] = 3$: the
# second term, for instance, has $t^2 (3 - 1)$ from $tc^2$ and 1 from $ac$. Together, as a fraction of the ellipse's
# own variance:
#
# $$\text{relative error} = \frac{3 + 8 t^2}{1 + t^2}\; e^2 + O(e^4).$$
#
# It falls as the square of size over depth, and from the axis outwards its factor grows from 3 to 8.
#
# A plain Monte Carlo run cannot see that: at a relative error of one part in ten thousand the noise
# $\sqrt{2/n}$ would ask for more than $10^8$ samples. Two tricks help. The same draws go through both maps and only
# the difference is averaged; and each draw $(a, c)$ comes with its opposite $(-a, -c)$, so that the odd terms cancel
# in each pair instead of on average.

# %%
draws = np.random.default_rng(44).normal(size=(2, PAIRS_DRAWN))


def relative_error(e, t):
    """Variance of the projection against the ellipse's, and the standard error of that."""
    tangent_square = (e * (draws[0] - t * draws[1])) ** 2
    shifts = [(t + e * a) / (1 + e * c) - t for a, c in (draws, -draws)]
    excess = (shifts[0] ** 2 + shifts[1] ** 2) / 2 - tangent_square
    bias = np.mean(shifts[0] + shifts[1]) / 2
    unit = e**2 * (1 + t**2)
    return (excess.mean() - bias**2) / unit, excess.std() / np.sqrt(PAIRS_DRAWN) / unit


def predicted_factor(t):
    return (3 + 8 * t**2) / (1 + t**2)


ratios, slopes_seen = np.geomspace(0.005, 0.15, 9), (0.0, 0.5, 1.0, 3.0)
errors = np.array([[relative_error(e, t) for e in ratios] for t in slopes_seen])
small = ratios < 0.05
for t, row in zip(slopes_seen, errors, strict=True):
    order = np.polyfit(np.log(ratios[small]), np.log(row[small, 0]), 1)[0]
    factor, noise = row[0] / ratios[0] ** 2
    print(f"{np.degrees(np.arctan(t)):4.0f} degrees off the axis: order {order:.3f},", end=" ")
    print(f"factor {factor:.2f} +- {noise:.2f}, predicted {predicted_factor(t):.2f}")
    assert abs(order - 2) < 0.06
    assert abs(factor - predicted_factor(t)) < 4 * noise + 0.01

print(f"the next term may tilt a line by {2 * 69 / 8 * 0.05**2:.3f}")

angles = np.linspace(0, 80, 33)
tangents = np.tan(np.radians(angles))
factors = np.array([relative_error(0.01, t)[0] for t in tangents]) / 0.01**2

fig, (ratio_ax, angle_ax) = plt.subplots(1, 2, figsize=(12, 4), layout="constrained")
for t, row, color, mark in zip(slopes_seen, errors, (BLUE, ORANGE, GREEN, PURPLE), "os^D", strict=True):
    name = f"{np.degrees(np.arctan(t)):.0f} degrees off the axis"
    ratio_ax.loglog(ratios, row[:, 0], mark, color=color, label=name)
    ratio_ax.loglog(ratios, predicted_factor(t) * ratios**2, color=color, linewidth=0.8)
ratio_ax.set(title="error of the ellipse against size: marks measured, lines predicted")
ratio_ax.set(xlabel="standard deviation / depth", ylabel="relative error of the variance")
ratio_ax.legend()
angle_ax.plot(angles, factors, "o", color=BLUE, label="measured at standard deviation / depth = 0.01")
angle_ax.plot(angles, predicted_factor(tangents), color=ORANGE, label="(3 + 8t²) / (1 + t²)")
angle_ax.set(title="and against the angle", xlabel="angle off the axis (degrees)", ylim=(0, 9))
angle_ax.set(ylabel="relative error / (standard deviation / depth)²")
angle_ax.legend(loc="lower right")
plt.show()

# %% [markdown]
# > **Why this bound.** The standard error of a mean is the deviation of one draw over $\sqrt{n}$; the factor may
# > stray four of them, plus a hundredth for the next term at the smallest size.
#
# The next term of the series is at most $69/8\; e^2$ of the first (its value far off the axis), so it may tilt
# the fitted line, whose points stay below $e = 0.05$, by $2 \cdot 69/8 \cdot 0.05^2 = 0.043$. The tolerance of 0.06
# has room for that. At $e = 0.15$ the marks are seen to leave the lines, upwards.
#
# The rate is good news for a scene that is made of small things: a splat a hundredth as wide as it is far away
# is wrong by less than a thousandth. A scene with large things near the lens pays.

# %%
for ratio in (0.01, 0.2):
    print(
        f"size / depth {ratio:.2f}: {300 * ratio**2:.2f} to {800 * ratio**2:.2f} % of the variance, at first order"
    )

# %% [markdown]
# ## Beside the image
#
# The derivation never asked whether the mean is inside the image. A splat also shows when its mean is just outside
# and its rim reaches in, so means outside have to be kept. But the third column of $J$ is $-f_x\,(x/z)/z$, and beside
# the camera, where $z$ is small, both factors grow without bound. Below, a row of equal balls stands in a half
# circle around the camera, which looks at its middle. The samples say which of them the camera sees.
#
# > **Predict.** How wide does the formula draw the ball at the very end of the half circle, compared with the one in
# > the middle: narrower, since it is hardly seen, or wider, and by how much?

# %%
around = np.radians(np.arange(-85, 86, 10))
balls = np.stack(
    [1.5 * np.sin(around), 0.1 * (-1.0) ** np.arange(len(around)), 1.5 * np.cos(around)], axis=-1
)
ball_cov = 0.1**2 * np.eye(3)


def footprints(jacobian_limit):
    """Evaluate every ball's splat at every pixel: (balls, H, W), peak 1."""
    rows, columns = np.mgrid[: CAMERA.H, : CAMERA.W]
    layers = []
    for ball in balls:
        cov2d = project_cov3d(ball_cov, ball, CAMERA, jacobian_limit=jacobian_limit) + DILATION * np.eye(2)
        d = np.stack([columns, rows], axis=-1) - pixels_of(ball)
        layers.append(np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", d, np.linalg.inv(cov2d), d)))
    return np.array(layers)


seen = pixels_of(np.concatenate([draw_samples(ball, ball_cov, 1500) for ball in balls]))
seen = seen[np.all((seen > -0.5) & (seen < 127.5), axis=-1)]
unclamped, clamped = footprints(None), footprints(1.3)
half = (CAMERA.W / 2) / CAMERA.fx

fig, axes = plt.subplots(1, 4, figsize=(14, 3.8), layout="constrained", width_ratios=(1.7, 1, 1, 1))
for ball in balls:
    axes[0].plot(*outline(ball[[0, 2]], ball_cov[:2, :2], 2).T, color=BLUE)
for slope, style in ((half, "-"), (1.3 * half, "--")):
    axes[0].plot([-1.8 * slope, 0, 1.8 * slope], [1.8, 0, 1.8], style, color=ORANGE)
axes[0].set(title="from above: balls (2 sigma), the image\n(line) and 1.3 times it (dashes)", aspect="equal")
axes[0].set(xlabel="x (world units)", ylabel="z (world units)", xlim=(-1.75, 1.75), ylim=(-0.1, 1.95))
axes[1].plot(*seen.T, ".", color="white", markersize=1)
axes[1].set(xlim=(-0.5, 127.5), ylim=(127.5, -0.5), aspect="equal", facecolor="black")
axes[1].set(title="what the camera sees:\nsamples of all balls", xticks=[], yticks=[])
for ax, layers, name in zip(axes[2:], (unclamped, clamped), ("the formula", "clamped inside J"), strict=True):
    ax.imshow(layers.max(axis=0), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    ax.set(title=f"{name}:\nstrongest splat at each pixel", xticks=[], yticks=[])
plt.show()

# %% [markdown]
# The grey of the third panel is no fog. The balls at the far left and right are drawn as ellipses larger than the
# image, and lay a veil over all of it. The tangent is right at the mean; eleven focal lengths away from the middle of
# the image, where the mean is, that says nothing about the image.
#
# The code of Kerbl et al. (2023) has a bound rather than a better formula. The mean is projected as before. Inside
# $J$, and only there, $x/z$ and $y/z$ are clamped to the viewing directions of the image, enlarged 1.3 times around
# its middle. A mean inside that window keeps its [Jacobian](../docs/GLOSSARY.md#jacobian) to the last bit. A mean
# outside gets the one of the window's rim: wrong, but of bounded width, so that its splat stays near its mean, out of
# the picture, where it belongs.

# %%
(low, high), _ = CAMERA.jacobian_bounds(1.3)
slopes = np.abs(np.tan(around))
in_image, beyond = slopes < half, slopes > 1
for name, layers, limit in (("unclamped", unclamped, None), ("clamped", clamped, 1.3)):
    width = np.sqrt(project_cov3d(ball_cov, balls[0], CAMERA, jacobian_limit=limit)[0, 0])
    covered = (layers[beyond].max(axis=0) >= ALPHA_MIN).mean()
    print(f"{name}: outermost ball {width:.0f} px wide (1 sigma);", end=" ")
    print(f"the balls beyond 45 degrees reach {100 * covered:.0f} % of the pixels")
    assert covered == (limit is None)
print(f"x/z is clamped to {low:.3f} .. {high:.3f}; the image ends at {half:.3f}; outermost {slopes[0]:.1f}")
assert np.array_equal(clamped[in_image], unclamped[in_image]) and in_image.any()

# %% [markdown]
# `jacobian_limit` is a setting, not a law. Captures of real places, where the camera walks among the splats, are
# trained and rendered with 1.3. The spheres of this course stand in the middle of the image and are projected
# without it, which is why it is off unless asked for.

# %% [markdown]
# ## Close to the lens, and behind it
#
# One factor is left, $f/z$, and no clamp of a direction holds it back. At $z = 0$ there is no image, and behind
# that something odd: $J(-m) = -J(m)$, and a covariance does not see the sign.

# %%
for z in (1.0, 0.2, Z_NEAR, 0.01):
    width = np.sqrt(project_cov3d(ball_cov, [0, 0, z], CAMERA)[0, 0])
    print(f"a ball of 0.1 at depth {z:4.2f}: {width:6.0f} px wide (1 sigma), in an image of {CAMERA.W} px")
assert np.allclose(ellipse_of(ball_cov, close_mean, CAMERA), ellipse_of(ball_cov, -close_mean, CAMERA))
assert np.isnan(CAMERA.project(-close_mean)[0])

# %% [markdown]
# A Gaussian behind the eye would be drawn in front, upside down, as the twin of one that is not there. So the
# formula refuses means with $z \le 0$, and a renderer drops what lies at `Z_NEAR` or closer before it asks. That is
# a cut, not a cure: whatever passes it at six hundredths of a unit may still cover the image. Nothing on this page
# is right for a Gaussian as large as its distance; the hope is that a scene has few of them.

# %% [markdown]
# ## What a lens does to a Gaussian
#
# Nothing above needs a pinhole; it needs a map that has a tangent. A fisheye draws what it sees at an angle $\theta$
# to the optical axis at a distance $f\theta$ from the middle, also past 90 degrees, where $z < 0$:
#
# $$(u, v) = (c_x, c_y) + f\,\theta\,(x, y) / r, \qquad r = \sqrt{x^2 + y^2}, \quad \theta = \mathrm{atan2}(r, z).$$
#
# The rays that touch a shell of a ball are a cone around its mean, so the shell's true outline is the image of a
# circle of directions. Here it is with the ellipse of $J \Sigma J^\top$, two deviations of balls of 0.12 at distance 1.


# %%
def by_fisheye(points):
    r = np.hypot(points[..., 0], points[..., 1])
    return 64 + 40 * (np.arctan2(r, points[..., 2]) / r)[..., None] * points[..., :2]


def by_pinhole(points):
    return 64 + 40 * points[..., :2] / points[..., 2:]


(fig, axes), misses = plt.subplots(1, 2, figsize=(13, 3.2), layout="constrained"), {}
for ax, lens, angles in ((axes[0], by_pinhole, (20, 40, 60)), (axes[1], by_fisheye, (20, 40, 60, 80, 100))):
    for angle in np.radians(angles):
        mean, turn = np.array([np.sin(angle), 0.0, np.cos(angle)]), np.linspace(0, 2 * np.pi, 100)[:, None]
        aside = np.cos(turn) * [np.cos(angle), 0, -np.sin(angle)] + np.sin(turn) * [0, 1, 0]
        rim = lens(np.sqrt(1 - 0.24**2) * mean + 0.24 * aside)
        J = np.stack([(lens(mean + h * e) - lens(mean - h * e)) / (2 * h) for e in np.eye(3)], axis=-1)
        shape, offset = 0.12**2 * J @ J.T, rim - lens(mean)
        distances = np.sqrt(np.einsum("ni,ij,nj->n", offset, np.linalg.inv(shape), offset))
        misses[lens.__name__[3:], round(np.degrees(angle))] = np.abs(distances / 2 - 1).max()
        ax.plot(*rim.T, color=BLUE, linewidth=2.5)
        ax.plot(*outline(lens(mean), shape, 2).T, color=ORANGE, linewidth=1)
    ax.set(title=f"{lens.__name__[3:]}: balls at {', '.join(map(str, angles))} degrees", aspect="equal")
    ax.set(xlabel="u (px)", ylabel="v (px)", xlim=(64, 210), ylim=(90, 38))
plt.show()
for (name, angle), miss in misses.items():
    print(f"{name} at {angle} degrees: the outline (blue) leaves the ellipse (orange) by {100 * miss:.0f} %")
assert misses["fisheye", 100] < misses["pinhole", 20]

# %% [markdown]
# The ellipses of a fisheye are better ones: its scale hardly changes across a splat. A camera takes such a lens as a
# value, `Camera.through(Projection("fisheye"))`. Lenses, formulas and tangents are in
# [gsplat_edu.scene.projection](../src/gsplat_edu/scene/projection.py),
# [projection_formulas](../src/gsplat_edu/scene/projection_formulas.py) and
# [sight](../src/gsplat_edu/scene/sight.py).

# %% [markdown]
# ## The next failure
#
# Every Gaussian now has its ellipse, and each is right to a percent. Here are 2,500 of them, flat disks laid on a
# sphere. The colour tells where a disk lies. They are painted as opaque ellipses in the order in which they are
# stored, and then in the opposite order.

# %%
means, cov3ds, colors, _ = sphere_shell(2500)
camera = Camera.looking_at(eye=[0, 0, -3], target=[0, 0, 0], fx=150, fy=150, H=128, W=128)
means_cam = camera.world_to_cam(means)
u, v, depth = camera.project(means_cam)
cov2ds = project_cov3d(cov3ds, means_cam, camera)
shapes = [outline(mean, cov, 1.5, 30) for mean, cov in zip(np.stack([u, v], axis=-1), cov2ds, strict=True)]

fig, axes = plt.subplots(1, 3, figsize=(9.6, 3.5), layout="constrained")
axes[0].add_collection(PolyCollection(shapes[:400], facecolors="none", edgecolors="black", linewidths=0.4))
axes[0].set(title="400 of the 2,500 ellipses")
for ax, step, name in ((axes[1], 1, "in the order of storage"), (axes[2], -1, "in the opposite order")):
    ax.add_collection(PolyCollection(shapes[::step], facecolors=colors[::step], edgecolors="none"))
    ax.set(title=f"painted {name}")
for ax in axes:
    ax.set(xlim=(0, 128), ylim=(128, 0), aspect="equal", xticks=[], yticks=[])
plt.show()
print(f"disks farther away than the centre of the sphere: {(depth > 3).sum()} of {len(depth)}")

# %% [markdown]
# Neither is a sphere. Half of the disks belong to the far side and lie over the near one wherever chance has put
# them later in the list. An ellipse on the image has lost the one number that says what hides what, and these disks
# are not even opaque. [Chapter 05](05_sort_and_composite.ipynb) gives it back.
