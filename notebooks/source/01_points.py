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
# # 01 - Points, and why they fail
#
# Measure a place with a laser, or match enough photos of it, and what comes back is a list: here is a
# point, it has this colour. A list is not a picture. The shortest way to make one is to forget about depth: x
# becomes the column, y becomes the row. Two equal balls stand below, one three times as far away as the
# other. Nothing in the picture says so.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

from gsplat_edu import Z_NEAR, Camera, orbit_camera

SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
SIZE, FRAMES = (96, 60) if SHORT else (160, 160)
FX = 1.25 * SIZE
COUNT = 60_000 * SIZE**2 // 160**2
print(f"budget: {COUNT} points, {SIZE} px, {FRAMES} frames{' (reduced)' if SHORT else ''}")

ORANGE, BLUE = np.array([0.95, 0.65, 0.10]), np.array([0.00, 0.35, 0.65])
FIELDS = 20  # of the checkerboard, from pole to pole


def checkerboard(normals):
    """Colour a ball by direction: fields of equal angles, +y is down."""
    azimuth, polar = np.arctan2(normals[..., 0], normals[..., 2]), np.arccos(normals[..., 1])
    sign = np.sin(FIELDS * azimuth) * np.sin(FIELDS * polar)
    return np.where(sign[..., None] > 0, ORANGE, BLUE)


rng = np.random.default_rng(1)
ball = rng.normal(size=(COUNT, 3))
ball /= np.linalg.norm(ball, axis=-1, keepdims=True)  # uniform by area: a normal vector has no favourite side
ball_colors = checkerboard(ball)
pair_colors = np.concatenate([ball_colors, ball_colors])
pair = np.concatenate([ball + np.array([-1.3, 0, 6]), ball + np.array([1.3, 0, 18])])

flat = np.zeros((SIZE, SIZE, 3))
column, row = np.rint(SIZE * (0.5 + pair[:, :2].T / 5)).astype(int)
flat[row, column] = pair_colors
fig, ax = plt.subplots(figsize=(3.6, 3.8), layout="constrained")
ax.imshow(flat, interpolation="nearest")
ax.set(title="depth forgotten: one of these is far away", xticks=[], yticks=[])
plt.show()

# %% [markdown]
# ## How a point gets to a pixel
#
# A photo is made of light that came through one small hole. So a pixel does not ask what is at its x and
# y; it asks what lies on the *line* through it and the hole. Put the hole at the origin, the axis of the
# camera along $+z$, and the image at distance $f$ in front of it. The triangle with legs $x$ and $z$ and
# the one with legs $x'$ and $f$ have the same angle at the hole, so
#
# $$\frac{x'}{f} = \frac{x}{z}.$$
#
# If $f$ is counted in pixels, $x'$ is a number of pixels, counted from where the axis meets the image.
# Pixels are counted from the first one instead, so that place gets a name, $(c_x, c_y)$, and
#
# $$u = f_x\,\frac{x}{z} + c_x, \qquad v = f_y\,\frac{y}{z} + c_y.$$
#
# The image has $+x$ to the right because columns do, $+y$ down because rows do, and then $+z$ has to go
# forward if the three are to be right-handed.
#
# A camera seldom stands at the origin. It stands at $e$ and looks at some target. Its forward axis is
# the unit vector there, its right axis is perpendicular to that and to the world's up, which is
# $(0, -1, 0)$, and its down axis is perpendicular to both. A coordinate along a unit vector is a dot
# product, so the three axes are the rows of a matrix $W$ (`camera.R`), and
#
# $$x_{cam} = W\,(x - e).$$

# %%
eye, target = np.array([1.0, -1.5, -4.0]), np.array([0.2, 0.1, 0.0])


def project_point(point, eye, target, f, middle):
    """Project one point, with nothing but the two equations above."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, -1.0, 0.0])
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    x, y, z = right @ (point - eye), down @ (point - eye), forward @ (point - eye)
    return f * x / z + middle, f * y / z + middle, z


turned_camera = Camera.looking_at(eye=eye, target=target, fx=FX, fy=FX, H=SIZE, W=SIZE)
mine = np.array([project_point(point, eye, target, FX, SIZE / 2) for point in ball[:500]])
theirs = np.stack(turned_camera.project(turned_camera.world_to_cam(ball[:500])), axis=-1)
# Both compute numbers of a few hundred from the same few operations: rounding is some 1e-13.
assert np.allclose(mine, theirs, rtol=0, atol=1e-10)
assert np.allclose(turned_camera.R @ turned_camera.R.T, np.eye(3), rtol=0, atol=1e-12)
assert np.linalg.det(turned_camera.R) > 0
print("rows of R (right, down, forward):")
print(turned_camera.R.round(3))
print(f"largest difference from Camera.project: {np.abs(mine - theirs).max():.1e} px")

# %% [markdown]
# [gsplat_edu.scene.camera](../src/gsplat_edu/scene/camera.py) is this with checks around it, and for all points at
# once. From here on it does the projecting.
#
# ## Which of them
#
# Along the line through a pixel there is more than one point. A list has an order, but not one that means
# anything, so the pixel needs a rule: the nearest point takes it. Sort from far to near and let each
# point overwrite what was there.

# %%
front_camera = Camera.looking_at(eye=[0, 0, 0], target=[0, 0, 1], fx=FX, fy=FX, H=SIZE, W=SIZE)


def draw_points(camera, points, radius=None, depth_test=True):
    """Return which point each pixel shows, -1 for none: the nearest pixel's, or all within a radius."""
    u, v, z = camera.project(camera.world_to_cam(points))
    near_enough = np.arange(-np.ceil(radius or 0), np.ceil(radius or 0) + 1)
    pixels, indices = [], []
    for right in near_enough:
        for down in near_enough:
            column, row = np.rint(u) + right, np.rint(v) + down
            hit = (z > Z_NEAR) & (column >= 0) & (column < camera.W) & (row >= 0) & (row < camera.H)
            if radius is not None:
                hit &= (column - u) ** 2 + (row - v) ** 2 <= radius**2
            indices.append(np.flatnonzero(hit))
            pixels.append((row[hit] * camera.W + column[hit]).astype(int))
    pixels, indices = np.concatenate(pixels), np.concatenate(indices)
    order = np.argsort(-z[indices], kind="stable") if depth_test else np.argsort(indices, kind="stable")
    owner = np.full(camera.H * camera.W, -1)
    owner[pixels[order]] = indices[order]  # where a pixel occurs twice the last one stays
    return owner.reshape(camera.H, camera.W)


def painted(owner, colors):
    return np.where(owner[..., None] >= 0, colors[owner], 0.0)


listed_order, nearest_first = (draw_points(front_camera, pair, depth_test=test) for test in (False, True))
wrong = (listed_order != nearest_first).sum() / (nearest_first >= 0).sum()
print(f"pixels that show another point when the list decides: {100 * wrong:.0f} %")
assert wrong > 0.3

titles = ("pinhole, in the order of the list", "pinhole, the nearest wins")
fig, axes = plt.subplots(1, 2, figsize=(7.4, 3.8), layout="constrained")
for ax, owner, title in zip(axes, (listed_order, nearest_first), titles, strict=True):
    ax.imshow(painted(owner, pair_colors), interpolation="nearest")
    ax.set(title=title, xticks=[], yticks=[])
plt.show()

# %% [markdown]
# The near ball has its pattern now, with specks in it. They are the next thing that goes wrong. The far ball
# is small, as it should be, but of its pattern only noise is left: that comes after.
#
# ## Too near: holes
#
# Walk up to one ball. The picture grows and the points stay as many as they were.
#
# > **Predict.** The camera walks from distance 8 to 4 to 2. What will a pixel show that no point in front has hit:
# > black, or something worse?

# %%
distances = (8.0, 4.0, 2.0)
near_cameras = [orbit_camera(0.0, -0.2, SIZE, FX, distance) for distance in distances]
owners = [draw_points(camera, ball) for camera in near_cameras]
facing = [np.einsum("ni,ni->n", ball, camera.eye - ball) > 0 for camera in near_cameras]

fig, axes = plt.subplots(1, 3, figsize=(11, 3.9), layout="constrained")
for ax, owner, distance in zip(axes, owners, distances, strict=True):
    ax.imshow(painted(owner, ball_colors), interpolation="nearest")
    ax.set(title=f"distance {distance:.0f}", xticks=[], yticks=[])
plt.show()

# %% [markdown]
# How many holes there are can be known before anything is drawn. Points are scattered at random with $n$
# on an area $a_0$. A pixel that sees the patch $a$ of the surface expects $m = n\,a/a_0$ of them, and
# the chance that each of the $n$ has missed it is
#
# $$\left(1 - \frac{a}{a_0}\right)^n \approx e^{-m}.$$
#
# The patch follows from the ray. A pixel's ray is $e + t\,d$ with $d$ scaled so that $t$ is the depth; at
# depth $t$ the pixel is $t/f$ wide, and a surface with normal $\nu$ that it meets at a slant shows it
#
# $$a = \frac{t^2}{f^2\,|\nu \cdot d|}.$$
#
# A ray meets a ball twice: in front, and again behind. Holes in the front are not black. In
# $e^{-m_{front}}(1 - e^{-m_{back}})$ of the cases they show the inside of the other side.

# %%


def pixel_rays(camera, rows, columns):
    """Directions of the pixels' rays in the world, with depth 1."""
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    return np.stack(np.broadcast_arrays(x, y, 1.0), axis=-1) @ camera.R


def ball_depths(camera, rays):
    """Depths where the rays enter and leave the unit ball: |e + t d| = 1; NaN where they miss it."""
    a, b, c = (rays**2).sum(-1), rays @ camera.eye, camera.eye @ camera.eye - 1
    root = np.sqrt(np.where(b * b > a * c, b * b - a * c, np.nan))
    return (-b - root) / a, (-b + root) / a


def expected_points(camera):
    """Points that each pixel may expect of the front and of the back, and how squarely its ray meets them."""
    rays = pixel_rays(camera, *np.mgrid[:SIZE, :SIZE])
    depths = np.stack(ball_depths(camera, rays))
    slant = np.abs(((camera.eye + depths[..., None] * rays) * rays).sum(-1))
    density = COUNT / (4 * np.pi) * depths**2 / (camera.fx**2 * slant)
    return density, slant[0] / np.linalg.norm(rays, axis=-1)


print("            holes: counted  expected   back shows: counted  expected")
for camera, owner, front, distance in zip(near_cameras, owners, facing, distances, strict=True):
    (lam_front, lam_back), cosine = expected_points(camera)
    clear = cosine > 0.4  # leave the rim out: the patch of a pixel changes too fast within the pixel
    empty, through = (owner < 0)[clear], ((owner >= 0) & ~front[owner])[clear]
    lost = np.exp(-lam_front - lam_back)[clear]
    shown = (np.exp(-lam_front) * (1 - np.exp(-lam_back)))[clear]
    # A pixel is a coin with this chance, and coins that share a fixed number of points vary no more than
    # independent ones: four standard deviations of their sum, and one pixel.
    for seen, p in ((empty, lost), (through, shown)):
        assert abs(seen.sum() - p.sum()) < 4 * np.sqrt((p * (1 - p)).sum()) + 1
    shares = [100 * share.mean() for share in (empty, lost, through, shown)]
    print("distance {:.0f} {:14.2f} % {:7.2f} % {:19.2f} % {:7.2f} %".format(distance, *shares))
assert through.mean() > 0.2

# %% [markdown]
# The middle row is the worse lie: hardly a black pixel, and a fifth of what is shown is the far side. A depth test
# compares points, and in a hole there is no point to lose against. More points only move the distance at which
# this begins. Half as far away a pixel sees a quarter of the surface, so every halving asks for a list four times
# as long.
#
# ## Too far: flicker
#
# Walk away instead. Many points fall into one pixel now and one of them takes it. Which one depends on where the
# camera stands, to a fraction of a pixel. Below, a far camera moves sideways, so slowly that the ball's near side
# shifts by a small part of a pixel from frame to frame. Each row of the pictures is the middle row of one frame.

# %%
STEP = 0.0015  # radians per frame
far_cameras = [orbit_camera(STEP * i, -0.2, SIZE, FX, 30.0) for i in range(FRAMES)]
middle = np.arange(int(SIZE / 2 - FX / 26), int(SIZE / 2 + FX / 26) + 2)
within = (np.arange(8) + 0.5) / 8 - 0.5


def surface_colors(camera, rows, columns):
    """Return the colour of the ball itself along each ray, and where there is none."""
    rays = pixel_rays(camera, rows, columns)
    depth = ball_depths(camera, rays)[0][..., None]
    hit = np.clip(camera.eye + np.nan_to_num(depth) * rays, -1, 1)
    return np.where(np.isnan(depth), 0.0, checkerboard(hit)), np.isnan(depth[..., 0])


by_points, by_area = [], []
for camera in far_cameras:
    by_points.append(painted(draw_points(camera, ball), ball_colors)[SIZE // 2, middle])
    # What a sensor would measure: the mean over the pixel's area, here over 8 x 8 rays.
    fine = surface_colors(camera, SIZE // 2 + within[:, None, None], middle[:, None] + within)[0]
    by_area.append(fine.mean(axis=(0, 2)))
by_points, by_area = np.array(by_points), np.array(by_area)
flicker, calm = (np.abs(np.diff(rows, axis=0)).mean() for rows in (by_points, by_area))
print(f"the ball's near side moves {STEP * FX / 29:.3f} px per frame")
print(f"mean change of a value: one point per pixel {flicker:.4f}, mean over the pixel {calm:.4f}")
assert flicker > 3 * calm

titles = ("one point per pixel", "mean over the pixel")
fig, axes = plt.subplots(1, 2, figsize=(8, 4), layout="constrained")
for ax, rows, title in zip(axes, (by_points, by_area), titles, strict=True):
    ax.imshow(rows, interpolation="nearest", aspect="auto")
    ax.set(title=title, xlabel="column of the far ball (px)", ylabel="frame")
plt.show()

# %% [markdown]
# ## No slope
#
# Holes and flicker are ugly. For this course points fail for another reason. The scene is going to be *found*:
# compare the picture with a photo, ask in which direction each point would have to move to make the difference
# smaller, move it a little, repeat. So take one white point, a photo of it in its right place, and the sum of
# squared differences as it is moved towards that place.

# %%
small = Camera.looking_at(eye=[0, 0, 0], target=[0, 0, 1], fx=24, fy=24, H=24, W=24)


def mask_at(u, radius):
    return draw_points(small, np.array([[(u - small.cx) / small.fx, 0.0, 1.0]]), radius) >= 0


photos = {radius: mask_at(14.0, radius) for radius in (None, 2.3)}


def difference_at(u, radius):
    return float((mask_at(u, radius) ^ photos[radius]).sum())


def finite_difference(u, radius, h):
    return (difference_at(u + h, radius) - difference_at(u - h, radius)) / (2 * h)


h = 1e-3
positions = np.sort(rng.uniform(6.0, 14.0, 300))
differing = {radius: np.array([difference_at(u, radius) for u in positions]) for radius in photos}
slopes = {radius: np.array([finite_difference(u, radius, h) for u in positions]) for radius in photos}

fig, axes = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
for radius, name, style in ((2.3, "disc of radius 2.3 px", "-"), (None, "one pixel", "--")):
    axes[0].plot(positions, differing[radius], style, drawstyle="steps-mid", label=name)
at_jumps = np.linspace(9.6, 9.8, 201)
for width, style in ((1e-2, "-"), (1e-3, "--")):
    slope = [finite_difference(u, 2.3, width) for u in at_jumps]
    axes[1].plot(at_jumps, slope, style, label=f"h = {width:g} px")
axes[0].set(title="a loss made of steps", ylabel="pixels that differ")
axes[1].set(title="its finite differences", ylabel="slope (pixels per px)")
for ax in axes:
    ax.set_xlabel("column of the point (px)")
    ax.legend()
plt.show()

for radius, slope in slopes.items():
    jumps, still, values = slope[slope != 0], (slope == 0).mean(), np.unique(differing[radius]).size
    print(f"radius {radius}: {values} values of the loss, slope 0 at {100 * still:.1f} %")
    # A jump is at least one pixel, seen from within h. Five rows of the disc have two ends that pass eight columns:
    # 80 jumps, which 2 % of random positions can see, and chance may double that.
    assert np.all(np.abs(jumps) >= 1 / (2 * h)) and still > 0.96

# %% [markdown]
# The slope is zero wherever it exists. Where it does not, a [finite
# difference](../docs/GLOSSARY.md#finite-difference) is one step divided by whatever $h$ was chosen: it says something
# about $h$. There is nothing to descend.
#
# ## The obvious fix
#
# The figure has given it away: let a point cover more than one pixel. A disc of radius $r$ covers a pixel if its
# centre is within $r$ of it. A pixel now sees the points of $\pi r^2$ pixels, and the fraction of holes is
# $e^{-m \pi r^2}$.

# %%
camera, ((lam_front, lam_back), cosine) = near_cameras[1], expected_points(near_cameras[1])
truth, beside = surface_colors(camera, *np.mgrid[:SIZE, :SIZE])
radii = np.array([0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0])
discs = [draw_points(camera, ball, radius) for radius in radii]
errors = [np.abs(painted(owner, ball_colors) - truth).mean() for owner in discs]
outside = [int((owner >= 0)[beside].sum()) for owner in discs]
through = [((owner >= 0) & ~facing[1][owner])[~beside].mean() for owner in discs]
for radius, owner, error, spill, back in zip(radii, discs, errors, outside, through, strict=True):
    print(f"radius {radius:4.2f} px  error {error:.4f}  back shows {100 * back:5.2f} %  outside {spill} px")
    if radius <= 1.0:
        p = np.exp(-(lam_front + lam_back) * np.pi * radius**2)[cosine > 0.4]
        # Pixels within 2 r of one another share points, so a count of holes varies as if there were that
        # many fewer coins, each worth as many pixels.
        tolerance = 4 * np.sqrt((p * (1 - p)).sum() * max(1.0, np.pi * (2 * radius) ** 2)) + 1
        assert abs((owner < 0)[cosine > 0.4].sum() - p.sum()) < tolerance
middling = int(np.argmin(errors))
assert 0 < middling < len(radii) - 1 and errors[-1] > 1.3 * errors[middling] and outside[-1] > outside[0]

fig, axes = plt.subplots(1, 4, figsize=(14, 3.6), layout="constrained")
axes[0].imshow(truth, interpolation="nearest")
axes[0].set(title="the surface", xticks=[], yticks=[])
for ax, i in ((axes[1], middling), (axes[2], -1)):
    ax.imshow(painted(discs[i], ball_colors), interpolation="nearest")
    ax.set(title=f"discs of {radii[i]:g} px", xticks=[], yticks=[])
axes[3].plot(radii, errors, "o-")
axes[3].set(title="no radius is right", xlabel="radius (px)", ylabel="mean error (colour)", ylim=(0, None))
plt.show()

# %% [markdown]
# Small discs leave holes, and the back shows through. Large ones close them, and three new things go
# wrong. The outline swells by the radius. Where discs overlap, the nearest *centre* takes all of its
# disc, so every edge of the pattern is cut along scraps of circles, and the scraps change as the camera moves.
# And in the plot of the loss above the disc is a finer staircase than the point, but a staircase: its slope is
# zero almost everywhere as well.

# %% [markdown]
# ## The next failure
#
# Size was needed, but it is not enough. A disc says of every pixel that it is covered or that it is not, and a
# number that is either 0 or 1 cannot change a little. Whatever a disc does at its rim, it does between one
# position and the next.

# %%
inside_rim = [bool(mask_at(u, 2.3)[12, 12]) for u in (9.6999, 9.7001)]
print(f"a disc at 9.6999 px covers column 12: {inside_rim[0]}; at 9.7001 px: {inside_rim[1]}")
assert inside_rim == [False, True]

# %% [markdown]
# What a point wants is an extent without a rim: full at its centre, less a little further out, and nothing far
# away, with no place in between where it jumps. [Chapter 02](02_gaussians_in_2d.ipynb) finds that function, and
# makes it wide in one direction and narrow in another.
