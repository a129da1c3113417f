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
# # 05 - Which one is in front
#
# [Chapter 04](04_splatting.ipynb) gave every Gaussian its ellipse, and ended with a sphere whose far side was painted
# over the near one. The scene here is the same: `sphere_shell` of
# [gsplat_edu.scene.sphere_shell](../src/gsplat_edu/scene/sphere_shell.py), flat disks on the unit sphere, coloured by
# where they are. It makes a good test, because the right picture is known without any splats: each ray shows the colour
# of the point where it first meets the sphere.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

from gsplat_edu import build_cov3d_batch, orbit_camera, project_cov3d, render_gaussians, sphere_shell
from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN, DILATION, T_STOP, Z_NEAR

SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
EDGE = 64 if SHORT else 128
print(f"budget: images of {EDGE} px{' (reduced)' if SHORT else ''}")

SHELL = means, cov3ds, colors, opacities = sphere_shell()


def view_from(azimuth, elevation=-0.35):
    return orbit_camera(azimuth, elevation, EDGE, 1.17 * EDGE)


CAMERA = view_from(0.5)


def alpha_map(camera, mean2d, cov2d, opacity, floor=ALPHA_MIN, ceiling=ALPHA_MAX):
    """Evaluate one splat at every pixel of the image."""
    d = np.stack(np.meshgrid(np.arange(camera.W), np.arange(camera.H)), axis=-1) - mean2d
    (A, B), (_, C) = np.linalg.inv(cov2d)
    power = -0.5 * (A * d[..., 0] ** 2 + C * d[..., 1] ** 2) - B * d[..., 0] * d[..., 1]
    alpha = np.minimum(ceiling, opacity * np.exp(power))
    return np.where(alpha < floor, 0.0, alpha)


def flat_splats(camera, means, cov3ds):
    """Do what chapter 04 does: ellipses on the image, and how deep each of them was."""
    means_cam = camera.world_to_cam(means)
    u, v, depths = camera.project(means_cam)
    assert np.all(depths > Z_NEAR)
    return np.stack([u, v], axis=-1), project_cov3d(cov3ds, means_cam, camera) + DILATION * np.eye(2), depths


def true_sphere(camera):
    """Meet the unit sphere with the ray of every pixel: |eye + s d| = 1, the nearer s."""
    v, u = np.indices((camera.H, camera.W))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 0 * u + 1], axis=-1) @ camera.R
    a, b, c = (rays**2).sum(axis=-1), rays @ camera.eye, camera.eye @ camera.eye - 1
    hit = b**2 > a * c
    s = (-b - np.sqrt(np.where(hit, b**2 - a * c, 0))) / a
    return np.where(hit[..., None], (camera.eye + s[..., None] * rays + 1) / 2, 0.0), hit


means2d, cov2ds, depths = flat_splats(CAMERA, means, cov3ds)
truth, disk = true_sphere(CAMERA)
added, weight = np.zeros((EDGE, EDGE, 3)), np.zeros((EDGE, EDGE, 1))
for mean2d, cov2d, color, opacity in zip(means2d, cov2ds, colors, opacities, strict=True):
    alpha = alpha_map(CAMERA, mean2d, cov2d, opacity)[..., None]
    added, weight = added + alpha * color, weight + alpha
averaged = added / np.maximum(weight, ALPHA_MIN)


def show(panels, heading):
    fig, axes = plt.subplots(1, len(panels), figsize=(3.1 * len(panels), 3.5), layout="constrained")
    for ax, (title, image) in zip(axes, panels.items(), strict=True):
        ax.imshow(np.clip(image, 0, 1), interpolation="nearest")
        ax.set(title=title, xticks=[], yticks=[])
    fig.suptitle(heading)
    plt.show()


def off(image):
    return np.abs(image - truth)[disk].mean()


show({"added": added, "averaged": averaged, "the sphere": truth}, "two ways of not asking for an order")
print(f"mean error: added and clipped {off(np.clip(added, 0, 1)):.3f}, averaged {off(averaged):.3f}")

# %% [markdown]
# Adding burns out. Averaging mixes the front with the back, which here have opposite colours. Both use every splat and
# ignore that some of them stand behind others. What is missing is not a better sum. It is *hiding*.

# %% [markdown]
# ## Light through layers
#
# A layer of opacity $\alpha$ replaces a share $\alpha$ of what is behind it by its own colour $c$ and lets the rest
# through. At a pixel $p$ splat $i$ is such a layer: its share is its opacity times its footprint of chapter 02 there,
# $\alpha_i = o_i\, g_i(p)$. Seen over a colour $b$ it gives $\alpha c + (1 - \alpha)\, b$. Put a stack of layers on a
# background, the last one first; each step takes the picture so far as its $b$. Unrolled, with index 1 in front:
#
# $$\hat c = \sum_i T_i\, \alpha_i\, c_i + T_{n+1}\, b, \qquad T_i = \prod_{j < i} (1 - \alpha_j).$$
#
# $T_i$ is the [*transmittance*](../docs/GLOSSARY.md#transmittance) in front of layer $i$, the share of light that
# gets from there to the eye. It starts at 1 and only falls. That is the advantage of the sum over the recursion: it
# can be evaluated from the front, keeping $\hat c$ and $T$, and then we notice when nothing more can come.


# %%
def back_to_front(alphas, layer_colors, behind):
    for alpha, color in zip(alphas[::-1], layer_colors[::-1], strict=True):
        behind = alpha * color + (1 - alpha) * behind
    return behind


def front_to_back(alphas, layer_colors, behind):
    seen, T = np.zeros(3), 1.0
    for alpha, color in zip(alphas, layer_colors, strict=True):
        seen, T = seen + T * alpha * color, T * (1 - alpha)
    return seen + T * behind


rng = np.random.default_rng(5)
alphas, layers, behind = rng.uniform(0, 0.6, 12), rng.uniform(size=(12, 3)), rng.uniform(size=3)
both_ways = front_to_back(alphas, layers, behind), back_to_front(alphas, layers, behind)
assert np.allclose(*both_ways, rtol=0, atol=1e-14)
T = np.concatenate([[1.0], np.cumprod(1 - alphas)])
assert abs((T[:-1] * alphas).sum() + T[-1] - 1) < 1e-14
swapped = front_to_back(alphas[1::-1], layers[1::-1], behind) - front_to_back(alphas[:2], layers[:2], behind)
assert np.allclose(swapped, alphas[0] * alphas[1] * (layers[1] - layers[0]), rtol=0, atol=1e-14)
print("weights of 12 layers:", *(f"{weight:.3f}" for weight in T[:-1] * alphas), f"background: {T[-1]:.3f}")

# %% [markdown]
# A dozen operations on numbers below 1 round to about $10^{-15}$; ten times that is the tolerance. The second assertion
# says that the weights and the last transmittance sum to 1: a pixel is a mean of colours, so it cannot burn out. The
# third is the price of a wrong order. Swapping the two in front changes the pixel by $\alpha_1 \alpha_2 (c_2 - c_1)$,
# and two neighbours further back by the same times the $T$ in front of them: nothing if both look alike, everything
# if they are in front, opaque and differ.

# %% [markdown]
# ## The number that was lost
#
# The projection kept two coordinates of each mean and dropped the third, the depth $z$ in camera axes. Sorting by it
# and walking from near to far is all that is missing. Depth is measured along the optical axis, not from the eye, and
# equal depths keep the order of storage. Both are conventions, and renderers have to agree on them.
#
# > **Predict.** The same splats as stored, in reverse, and from near to far. In what share of the sphere's pixels
# > does sorting change the picture by more than a step: a tenth, a half, nearly all?


# %%
def splat_image(camera, scene, order=None, **limits):
    """Composite whole-image layers; by depth unless an order is given."""
    means2d, cov2ds, depths = flat_splats(camera, scene[0], scene[1])
    image, T = np.zeros((camera.H, camera.W, 3)), np.ones((camera.H, camera.W))
    for i in np.argsort(depths, kind="stable") if order is None else order:
        alpha = alpha_map(camera, means2d[i], cov2ds[i], scene[3][i], **limits)
        image += (T * alpha)[..., None] * scene[2][i]
        T = T * (1 - alpha)
    return image, T


stored = np.arange(len(means))
in_depth, T_final = splat_image(CAMERA, SHELL)
as_stored, reverse = (splat_image(CAMERA, SHELL, order)[0] for order in (stored, stored[::-1]))
orders = {"as stored": as_stored, "stored, reversed": reverse, "near to far": in_depth, "the sphere": truth}
show(orders, "the same splats in three orders")
changed = (np.abs(as_stored - in_depth).max(axis=-1) > ALPHA_MIN)[disk].mean()
print(f"pixels of the sphere that sorting changes by more than one step of 255: {100 * changed:.1f} %")
print(f"mean error: as stored {off(as_stored):.3f}, reversed {off(reverse):.3f}, sorted {off(in_depth):.3f}")
assert changed > 0.9 and 4 * off(in_depth) < min(off(as_stored), off(reverse), off(averaged))

# %% [markdown]
# This is a renderer, whole. Nothing in it is fast and nothing is missing. The package's,
# [gsplat_edu.render.numpy_reference](../src/gsplat_edu/render/numpy_reference.py), takes the same steps and checks
# its arguments. Asked for every pixel that counts and never to stop early, it must give the same image. Of 2,500 terms
# per pixel each errs by $10^{-16}$ or so, together by less than $10^{-12}$.

# %%
reference, T_reference = render_gaussians(CAMERA, *SHELL, extent="exact", stop="none")
differences = np.abs(in_depth - reference).max(), np.abs(T_final - T_reference).max()
print(f"largest difference: image {differences[0]:.1e}, transmittance {differences[1]:.1e}")
assert max(differences) < 1e-12

# %% [markdown]
# ## Three small lies
#
# Two constants have been in the code above, 0.99 and 1/255, and a third is about to be. Each bends the formula a
# little, and each can say by how much at most. Let the colours lie between 0 and $c_{max}$.
#
# **Alpha is at most 0.99.** An opaque splat would make $T$ zero for ever: nothing behind it would have a gradient, and
# recovering $T_i$ from the back, by dividing by $1 - \alpha_i$, would divide by zero. Take the first splat of a pixel
# that is clamped. In front of it nothing changes. From there on, of the light $T \le 1$ that is left, at most 0.01
# goes to other colours than it would have: the image is wrong by at most $0.01\, c_{max}$.
#
# **Alpha below 1/255 is zero.** A Gaussian is nowhere zero; without a floor each splat is in each pixel. Dropping a
# layer with its alpha $\alpha$ changes $\hat c$ by $T \alpha$ times a difference of colours, at most $\alpha\,
# c_{max}$: less than one step of an 8-bit image. But layers add up. The bound for a pixel is $c_{max} \sum \alpha$
# over what was dropped there, and a scene made of veils that are all just below the floor is not drawn at all.
#
# **Below a transmittance of 0.0001 compositing may stop** (next section). The weights of all that is left sum to at
# most that $T$, so the pixel is wrong by at most $10^{-4}\, c_{max}$: a fortieth of a step.

# %%
# every opacity 1, so that there is something to clamp
opaque = (means, cov3ds, colors, np.ones(len(means)))
clamp_error = splat_image(CAMERA, opaque)[0] - splat_image(CAMERA, opaque, ceiling=1.0)[0]
floor_error = in_depth - splat_image(CAMERA, SHELL, floor=0.0)[0]
dropped = np.zeros((EDGE, EDGE))
for mean2d, cov2d, opacity in zip(means2d, cov2ds, opacities, strict=True):
    alpha = alpha_map(CAMERA, mean2d, cov2d, opacity, floor=0.0)
    dropped += np.where(alpha < ALPHA_MIN, alpha, 0.0)
print(f"clamp at {ALPHA_MAX}: largest error {np.abs(clamp_error).max():.5f}, bound {1 - ALPHA_MAX:.5f}")
print(f"floor: largest error {np.abs(floor_error).max():.5f}, largest bound {dropped.max():.5f}")
assert np.abs(clamp_error).max() <= (1 - ALPHA_MAX) * colors.max()
assert np.all(np.abs(floor_error).max(axis=-1) <= dropped * colors.max() + 1e-12)

# %% [markdown]
# The clamp costs far less than its bound, because something of about the same colour stands behind most splats.
# The floor is the surprise: many steps of an 8-bit image. It happens just outside the sphere's edge, where a ray meets
# the tails of dozens of disks and nothing else. A floor per splat is not a floor per pixel. It stays because
# it is what gives a splat an end, and because training sees it too.

# %% [markdown]
# ## Work that does not show
#
# The naive renderer visits every pixel for every splat. But the floor gave each splat a rim: outside of
# $\sqrt{2 \ln(255\, o)}$ standard deviations an opacity $o$ is below it. So a box around the ellipse is enough.
# `render_gaussians` by default takes the box of Kerbl et al.'s code, three standard deviations of the long axis to
# each side (there it chooses blocks of 16 by 16 pixels; here it cuts), and skips a splat when its whole box is below
# the stopping transmittance.

# %%
radii = np.ceil(3 * np.sqrt(np.linalg.eigvalsh(cov2ds)[:, 1:]))
low, high = (np.clip(edge, 0, EDGE) for edge in (np.floor(means2d) - radii, np.ceil(means2d) + radii + 1))
everything, visited = len(means) * EDGE**2, np.prod(high - low, axis=-1).sum()
boxed, _ = render_gaussians(CAMERA, *SHELL)
print(f"evaluations: whole images {everything:,}, boxes {visited:,.0f}: {100 * visited / everything:.2f} %")

dense = sphere_shell(s_t=0.12, opacity=0.95)
never, T_never = render_gaussians(CAMERA, *dense, stop="none")
print(f"dense shell: {100 * (T_never < T_STOP).mean():.1f} % of the pixels end below T = {T_STOP:.4f}")
for stop in ("box", "tile"):
    stopped, T_stopped = render_gaussians(CAMERA, *dense, stop=stop)
    error = np.abs(stopped - never)
    print(f"stop by {stop:>4}: {100 * (error > 0).any(axis=-1).mean():.1f} % of the pixels change,", end=" ")
    print(f"largest error {error.max():.1e}, bound {T_STOP * dense[2].max():.1e}")
    assert 0 < error.max() <= T_STOP * dense[2].max()
    assert np.array_equal(T_stopped[T_never >= T_STOP], T_never[T_never >= T_STOP])

# %% [markdown]
# A box can only stop as a whole, so it stops late; the fast renderers of later chapters stop by
# [*tiles*](../docs/GLOSSARY.md#tile), squares of 16 pixels, and have more to show for it. Where a pixel is still
# above the limit at the end, nothing has changed to the last bit.
#
# The box has a fault of its own. Three standard deviations are less than the rim, and what is cut off there is not
# below the floor. One large round splat shows it.

# %%
single = ([[0, 0, 0]], [0.25**2 * np.eye(3)], [[1, 1, 1]], [0.8])
exact, tight = (render_gaussians(CAMERA, *single, extent=extent)[0] for extent in ("exact", "box3sigma"))
print(
    f"opacity 0.8: rim at {np.sqrt(2 * np.log(255 * 0.8)):.2f} sigma, alpha {0.8 * np.exp(-4.5):.4f} at 3 sigma"
)
print(f"cut off: {np.abs(exact - tight).max():.4f} from one splat, floor {ALPHA_MIN:.4f};", end=" ")
print(f"from the sphere {np.abs(boxed - reference).max():.1e}")
assert ALPHA_MIN <= np.abs(exact - tight).max() < 0.8 * np.exp(-4.5)

fig, axes = plt.subplots(1, 2, figsize=(8, 3.6), layout="constrained")
slivers = {"one splat, exact": exact, "what its box cuts off": exact - tight}
for ax, (title, image) in zip(axes, slivers.items(), strict=True):
    shown = ax.imshow(image[..., 0], cmap="magma", interpolation="nearest")
    ax.set(title=title, xticks=[], yticks=[])
    fig.colorbar(shown, ax=ax, label="alpha")
plt.show()

# %% [markdown]
# Four slivers, a step or two of an 8-bit image. On the sphere it matters even less, because the boxes of small
# splats are rounded outwards to whole pixels. But it is not rounding, and whoever compares two renderers has to agree
# on the rim first; `extent="exact"` is for that.

# %% [markdown]
# ## What is left for the background
#
# The transmittance that remains after the last splat is an image of its own. It is where the background enters, once,
# at the very end: $\hat c = \hat c_{splats} + T_{final}\, b$. It also tells where there was no scene.

# %%
fig, axes = plt.subplots(2, 4, figsize=(11, 6.6), layout="constrained")
for column, azimuth in zip(axes.T, (0.5, 2.1, 3.6, 5.2), strict=True):
    camera = view_from(azimuth)
    black, T_final = render_gaussians(camera, *SHELL)
    white, _ = render_gaussians(camera, *SHELL, bg=(1, 1, 1))
    assert np.allclose(white, black + T_final[..., None], rtol=0, atol=1e-14)
    column[0].imshow(np.clip(white, 0, 1), interpolation="nearest")
    column[0].set(title=f"azimuth {np.degrees(azimuth):.0f} degrees", xticks=[], yticks=[])
    shown = column[1].imshow(T_final, cmap="gray", vmin=0, vmax=0.1, interpolation="nearest")
    column[1].set(title="transmittance left over", xticks=[], yticks=[])
label = "transmittance left over (share of light); white from 0.1"
fig.colorbar(shown, ax=axes[1], label=label, location="bottom", shrink=0.5, extend="max")
fig.suptitle("the sphere over a white background, and where that comes through")
plt.show()
print(f"largest transmittance inside the sphere, last view: {T_final[true_sphere(camera)[1]].max():.2f}")

# %% [markdown]
# Four views of one object. Its edge is soft, and a little outside of where the sphere ends: the disks there are seen
# from the side, stick out, and have nothing behind them.

# %% [markdown]
# ## Where one depth is not enough
#
# A splat has one place in the queue, that of its mean. Two splats that pass through each other have no right
# order: on the left one of them is in front, on the right the other. Here are two disks, crossed like two
# pages of a book, their means a hundredth apart. The camera walks past the point where the depths of the means are
# equal.

# %%
turns = np.radians([45, -45])
pages = np.stack([[[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]] for a in turns])
crossed = (
    np.array([[0.005, 0, 0], [-0.005, 0, 0]]),
    build_cov3d_batch(np.tile([0.45, 0.35, 0.01], (2, 1)), pages),
    np.array([[0.90, 0.62, 0.0], [0.0, 0.45, 0.70]]),
    np.array([0.95, 0.95]),
)

path = np.arange(-6, 6.01, 0.5) + 0.25
views = np.array([render_gaussians(view_from(turn, 0.0), *crossed)[0] for turn in np.radians(path)])
steps = np.abs(np.diff(views, axis=0)).mean(axis=(1, 2, 3))
flip = np.argmax(steps)
print(f"between {path[flip]:.2f} and {path[flip + 1]:.2f} degrees the image changes", end=" ")
print(f"{steps[flip] / np.median(steps):.0f} times as much as in the other steps of half a degree")
assert path[flip] < 0 < path[flip + 1] and steps[flip] > 10 * np.delete(steps, flip).max()

camera, (amber, blue) = view_from(0.0, 0.0), crossed[2]
flat, flat_cov, _ = flat_splats(camera, crossed[0], crossed[1])
a, b = (alpha_map(camera, flat[i], flat_cov[i], 0.95)[..., None] for i in (0, 1))
one_way, other_way = a * amber + (1 - a) * b * blue, b * blue + (1 - b) * a * amber
by_pixel = np.where(np.arange(EDGE)[:, None] < EDGE / 2, one_way, other_way)
fig, axes = plt.subplots(1, 4, figsize=(13.5, 3.5), layout="constrained")
names = [
    *(f"camera at {degrees:.2f} degrees".replace("-", "\N{MINUS SIGN}") for degrees in path[flip : flip + 2]),
    "each half in its own order",
]
for ax, image, title in zip(axes, (views[flip], views[flip + 1], by_pixel), names, strict=False):
    ax.imshow(np.clip(image, 0, 1), interpolation="nearest")
    ax.set(title=title, xticks=[], yticks=[])
for channel, color in enumerate(("#d55e00", "#009e73", "#0072b2")):
    axes[3].plot(path, views[:, EDGE // 2, EDGE // 2, channel], ".-", color=color, label="RGB"[channel])
axes[3].set(title="the pixel in the middle", xlabel="camera azimuth (degrees)", ylabel="colour (0 to 1)")
axes[3].legend()
plt.show()

# %% [markdown]
# Half a degree, and the picture turns over. It is called popping, and the method has it by design: an order per
# pixel would be right (third panel) and would cost a sort per pixel. Small splats pop too, but little, and a scene
# that is trained against photos is made of small splats.

# %% [markdown]
# ## The next failure
#
# Now give the sphere a lamp. A glossy thing has a highlight where the mirrored light meets the eye, so its place
# depends on who looks. Below, the colours of the disks are worked out for the camera on the left; the camera in
# the middle gets its own; and the camera on the right stands where the middle one does and is shown the colours of the
# first.

# %%
lamp = np.array([-0.5, -0.6, -0.62]) / np.linalg.norm([-0.5, -0.6, -0.62])


def glossy_colors(camera):
    to_eye = camera.eye - means
    to_eye /= np.linalg.norm(to_eye, axis=-1, keepdims=True)
    mirrored = 2 * (means @ lamp)[:, None] * means - lamp
    return 0.6 * colors + np.maximum((mirrored * to_eye).sum(axis=-1), 0)[:, None] ** 12


left, right = view_from(-0.9), view_from(-0.1)
whose = {"camera A": (left, left), "camera B": (right, right), "camera B, colours of A": (right, left)}
for title, (camera, owner) in whose.items():
    whose[title] = render_gaussians(camera, means, cov3ds, glossy_colors(owner), opacities)[0]
show(whose, "a highlight belongs to the one who looks")
moved = np.abs(glossy_colors(left) - glossy_colors(right)).max(axis=-1)
moved *= np.any([((c.eye - means) * means).sum(axis=-1) > 0 for c in (left, right)], axis=0)  # disks in view
print(f"disks in view whose colour differs by more than 0.1: {(moved > 0.1).sum()} of {len(means)}")
assert (moved > 0.1).sum() > 50

# %% [markdown]
# The third picture has its highlight painted on. With one colour per splat there is no other way: three numbers
# cannot know who is looking. [Chapter 06](06_spherical_harmonics.ipynb) gives each splat a few more.
