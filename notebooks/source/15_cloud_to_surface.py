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
# # 15 - From a cloud to a surface
#
# [Chapter 14](14_photos_to_scene.ipynb) ends with a scene that looks right where a camera stood. A 3D printer, a
# physics engine and a tape measure ask another question: where is the wall? A cloud of splats has no inside and no
# outside, and every pixel mixes many splats. This page takes a depth from a pixel, finds out why that depth is wrong,
# and makes one mesh of the depths of many views.
#
# The scene is `solids` ([lab.captures.solids_photos](../lab/captures/solids_photos.py)): a bowl, rods, slots and a
# torus on a floor, photographed by a ray tracer. The exact distance of any point to the surface is known.
#
# > **Needs.** A clone of the repository, whose `lab` takes the photos.

# %%
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib import colormaps
from matplotlib_inline.backend_inline import set_matplotlib_formats
from scipy.spatial import cKDTree
from scipy.special import ndtri

from gsplat_edu import ALPHA_MAX, Z_NEAR, Camera
from gsplat_edu.evaluate.surface import sample_surface, visible_points
from gsplat_edu.mesh.extract import extract_mesh
from gsplat_edu.mesh.volume import SparseVolume
from gsplat_edu.ops.patches import GreyPhoto, Grid, patch_error
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.maps import render_maps
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.train.compose import training
from gsplat_edu.train.config import recipe

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "lab" / "captures").is_dir())
sys.path.append(str(ROOT))
from lab.captures.solids_photos import photograph_solids, solids_capture

SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
WIDTH, COUNT, ITERATIONS, SPLATS, WALLS = (100, 12, 150, 1500, 60) if SHORT else (200, 24, 1500, 6000, 600)
set_matplotlib_formats("jpeg", pil_kwargs={"quality": 85})
print(f"budget: {COUNT} photos, {WIDTH} px, {ITERATIONS} iterations{' (reduced)' if SHORT else ''}")

# %% [markdown]
# ## Three depths of a pixel
#
# Along a pixel's ray, splat $i$ has the camera depth $z_i$ of its mean and the weight $w_i = T_i \alpha_i$ of [chapter
# 05](05_sort_and_composite.ipynb). The obvious depths are two averages. The *mean depth* is $\sum w_i z_i / \sum w_i$.
# The *median depth* is the $z_i$ of the splat at which the [transmittance](../docs/GLOSSARY.md#transmittance) falls
# below one half.
#
# The third depth takes a flat splat for what it is, a piece of a plane. With the camera at the origin, the plane
# through the mean $\mu_i$, whose normal $n_i$ is the shortest axis, holds the points $x$ with $n_i \cdot x = d_i$,
# where $d_i = n_i \cdot \mu_i$. Composite the planes in place of the depths, $\hat n = \sum w_i n_i$ and
# $\hat d = \sum w_i d_i$. The ray $r$, of depth 1, meets the plane $\hat n \cdot x = \hat d$ at the *[planar
# depth](../docs/GLOSSARY.md#planar-depth)*
#
# $$ z = \frac{\hat d}{\hat n \cdot r} . $$
#
# If all splats of a pixel lie in one plane $(n, d)$, then $\hat n = a\,n$ and $\hat d = a\,d$ with $a = \sum w_i$.
# The factor $a$ cancels, and the planar depth is exact on any slant
# ([gsplat_edu.render.planes](../src/gsplat_edu/render/planes.py)). Here are all three in two dimensions, $x$ across
# and $z$ away from the camera.

# %%
DEPTHS = "depth", "median-depth", "planar-depth"  # what the package calls the three
DISTANCE, SIZE = 4.0, 0.05  # of the wall, and the standard deviation of its splats along it; world units


def pixel_depths(x, centers, normals, sigma, opacity):
    """Mean, median and planar depth of flat splats along the ray (x, 1) from the origin, and alpha."""
    order = np.argsort(centers[:, 1], kind="stable")
    (across, z), (n_x, n_z) = centers[order].T, normals[order].T
    u = across / z
    spread = sigma * np.abs(n_z + u * n_x) / z  # sigma J t: J = (1, -u) / z, t = (-n_z, n_x) along the splat
    alpha = np.minimum(ALPHA_MAX, opacity * np.exp(-0.5 * ((x - u) / spread) ** 2))
    T = np.cumprod(np.append(1.0, 1 - alpha))
    w = T[:-1] * alpha
    mean = (w @ z) / w.sum()
    median = z[np.argmax(T[1:] < 0.5)] if T[-1] < 0.5 else np.nan
    planar = (w @ (n_x * across + n_z * z)) / (w @ (n_x * x + n_z))
    return mean, median, planar, 1 - T[-1]


def slanted_wall(slant, s, off=0.0, leaning=0.0):
    """Splats at the places s along a wall, its normal `slant` from the axis; `off` it and `leaning` if given."""
    along, normal = np.array([np.cos(slant), np.sin(slant)]), np.array([np.sin(slant), -np.cos(slant)])
    centers = np.outer(s, along) + np.outer(off + 0 * s, normal) + (0, DISTANCE)
    angles = slant + leaning + 0 * s
    return centers, np.stack([np.sin(angles), -np.cos(angles)], axis=-1)


rng, tilt = np.random.default_rng(15), np.radians(60)
wall = slanted_wall(tilt, np.sort(rng.uniform(-0.5, 0.5, 160)))
pixels = np.linspace(-0.03, 0.03, 121)
found = np.array([pixel_depths(x, *wall, SIZE, 0.4) for x in pixels])
true = DISTANCE * np.cos(tilt) / (np.cos(tilt) - pixels * np.sin(tilt))
fig, ax = plt.subplots(figsize=(9, 4.2), layout="constrained")
ax.plot(pixels, true, color="k", linewidth=5, alpha=0.25, label="the wall")
for k, name in enumerate(("mean", "median", "planar")):
    ax.plot(pixels, found[:, k], label=name)
ax.set(title="a wall of splats, 60 degrees from facing", xlabel="pixel x", ylabel="depth, world units")
ax.legend()
plt.show()
off = (found[:, :3] - true[:, None]) / SIZE
print("off by, in deviations of a splat: mean {:.2f}, median {:.2f}, planar {:.0e}".format(*off.mean(axis=0)))
assert np.abs(off[:, 2]).max() < 1e-10 and off[:, :2].mean() < -0.5

# %% [markdown]
# Mean and median lie in front of the wall. On a slant, a splat whose mean is nearer than the wall's point under the
# pixel still reaches the pixel, and it comes first. How far in front? Let a wall have $\rho$ faint splats per unit of
# length, each of opacity $o$ and standard deviation $\sigma$. A splat at the distance $s$ along the wall has the alpha
# $o\,e^{-s^2/2\sigma^2}$ at the pixel, so all splats before $s$ let through
#
# $$ T(s) = e^{-\kappa\,\Phi(s/\sigma)}, \qquad \kappa = \sqrt{2\pi}\,\rho\,o\,\sigma, $$
#
# where $\Phi$ is the normal distribution, and $\kappa$ the sum of all alphas at the pixel: the wall lets $e^{-\kappa}$
# through. A mean at $s$ is deeper by $s \sin\theta$. The median is where $T = 1/2$, the mean weighs $s$ by $-dT$. With
# $p = \Phi(s/\sigma)$ as the variable, the biases are
#
# $$ b_{\text{median}} = \sigma \sin\theta\;\Phi^{-1}\!\left(\frac{\ln 2}{\kappa}\right), \qquad
# b_{\text{mean}} = \frac{\sigma \sin\theta}{1 - e^{-\kappa}} \int_0^1 \Phi^{-1}(p)\,\kappa\,e^{-\kappa p}\,dp . $$
#
# On the screen the splat is $\sigma' = \sigma \cos\theta$ wide, so $\sigma \sin\theta = \sigma' \tan\theta$: one pixel
# of width costs ever more depth as the wall turns away.
#
# > **Predict.** More and more splats are laid into the same wall, until nothing shines through it. Do the mean and the
# > median depth come closer to the wall?


# %%
def bias_law(kappa):
    """Bias of mean and median depth of a wall of faint splats, over sigma sin(theta)."""
    p = (np.arange(20_000) + 0.5) / 20_000
    mean = (ndtri(p) * kappa * np.exp(-kappa * p)).mean() / (1 - np.exp(-kappa))
    return mean, ndtri(np.log(2) / kappa) if kappa > np.log(2) else np.nan


def measured_bias(kappa, slant, opacity=0.05, reach=0.3):
    """The same, from random walls and the ray through their middle."""
    count = round(2 * reach * kappa / (np.sqrt(2 * np.pi) * SIZE * opacity))
    walls = (slanted_wall(slant, rng.uniform(-reach, reach, count)) for _ in range(WALLS))
    depths = np.array([pixel_depths(0.0, *wall, SIZE, opacity)[:3] for wall in walls])
    return np.median(depths - DISTANCE, axis=0) / (SIZE * np.sin(slant))


kappas, fine = np.array([1.5, 2, 3, 5, 8, 12, 20]), np.geomspace(1.2, 22, 40)
walls = np.array([measured_bias(kappa, tilt) for kappa in kappas])
fig, ax = plt.subplots(figsize=(9, 4), layout="constrained")
for k, (name, color) in enumerate((("mean", "C0"), ("median", "C1"), ("planar", "C2"))):
    ax.plot(kappas, walls[:, k], "o", color=color, label=f"{name}, measured")
    ax.plot(fine, [(*bias_law(kappa), 0)[k] for kappa in fine], color=color, label=f"{name}, the law")
ax.set(title="more splats in a wall", xlabel="sum of alphas", ylabel="bias / (sigma sin(slant))")
ax.legend()
plt.show()
for kappa, row in zip(kappas[[0, 3, 6]], walls[[0, 3, 6]], strict=True):
    mean, median = bias_law(kappa)
    print(f"alphas {kappa:4.1f}: mean {row[0]:.2f}, law {mean:.2f}; median {row[1]:.2f}, law {median:.2f}")
assert np.abs(walls[:, :2] - [bias_law(kappa) for kappa in kappas]).max() < (0.2 if SHORT else 0.1)
assert np.abs(walls[:, 2]).max() < 1e-9 and walls[6, 0] < walls[3, 0] < walls[0, 0]

# %% [markdown]
# They move away: the more splats there are, the fewer of the nearest it takes to fill the pixel. Only the median has a
# place without bias, where $\ln 2 / \kappa$ is one half. The planar depth does not care as long as all splats lie in
# the wall. The page of this chapter on the site (`make site`) has a figure in which one takes them off it, or turns
# them. Exercise 2 asks the package.
#
# ## Why splats thicken a surface
#
# A photo fixes the sum $\sum w_i c_i$ of a pixel, not where on the ray the splats lie. Move a splat by $h$ along
# the ray of one photo. Another photo, whose ray meets the first one at the angle $\varphi$, sees it move by about
# $f h \sin\varphi / z$ pixels. Only a change of colour over these pixels reaches the loss: neighbouring photos
# allow much, and on a plain wall all of them do.
#
# How much do photos know? Take the exact depth and the exact normals, move the surface by $h$ along every ray,
# and let a photo look through it at its neighbour. The plane of each 7 x 7 patch says where the patch is in the other
# photo, and the correlation of both sets of values, `ncc`, says whether they show the same. The mean of
# $1 - \mathrm{ncc}$ ignores brightness and contrast ([gsplat_edu.ops.patches](../src/gsplat_edu/ops/patches.py), after
# Chen et al. 2024, PGSR).

# %%
captures = {name: solids_capture(name, WIDTH, COUNT) for name in ("textured", "plain", "glossy")}
solid = captures["textured"].scene
shifts = np.linspace(-0.06, 0.06, 25)
fig, axes = plt.subplots(1, 4, figsize=(13, 3.2), layout="constrained")
for ax, (finish, capture) in zip(axes, captures.items(), strict=False):
    ax.imshow(capture.photos[2].image)
    ax.set(title=f"{finish} objects", xticks=[], yticks=[])
    pair = ((view.camera, np.rint(view.image.mean(axis=2)).astype(np.uint8)) for view in capture.views[2:4])
    (photo, other), shot = (GreyPhoto(*one) for one in pair), capture.photos[2]
    body = cv2.erode((shot.part > 0).astype(np.uint8), np.ones((7, 7))) > 0  # patches inside the objects
    normals, alpha = torch.tensor(shot.normals * body[..., None]), torch.tensor(1.0 * body)
    misfits = []
    for shift in shifts:
        moved = torch.tensor((shot.depth + shift) * body)
        loss, _ = patch_error(normals, moved, alpha, photo, other, Grid(1), weight=body.size / body.sum())
        misfits.append(float(loss))
    axes[3].plot(shifts, misfits, label=finish)
    rise = misfits[0] + misfits[-1] - 2 * misfits[len(misfits) // 2]
    print(
        f"{finish}: least at a shift of {abs(shifts[np.argmin(misfits)]):.3f}, rise to both sides {rise:.3f}"
    )
    assert finish != "textured" or abs(shifts[np.argmin(misfits)]) < (0.02 if SHORT else 0.011)
axes[3].set(title="loss of patches", xlabel="shift along the ray, world units", ylabel="mean of 1 - ncc")
axes[3].legend()
plt.show()

# %% [markdown]
# Patches of a textured surface name its place best. A plain one offers only its shading, which changes slowly, and a
# glossy one a highlight that moves with the camera. Training on colours alone has the same weakness, and a use for it:
# splats that spread along the ray can fake highlights and fine texture. The surface becomes a thick layer.
#
# `--surface` of `gsplat-edu train` adds this loss of patches and, after Huang et al. 2024 (2DGS), one of normals. One
# normal is $\hat n = \sum w_i n_i$, the other is $m$ of the depth map, from the cross product of its differences. With
# $a = \sum w_i$, the loss of a pixel ([gsplat_edu.ops.surface](../src/gsplat_edu/ops/surface.py)) is
#
# $$ a\,(a - \hat n \cdot m) . $$
#
# $|\hat n| \le a$ by the triangle inequality, with equality if and only if all $n_i$ are equal; then $\hat n \cdot m
# = a$ if and only if they equal $m$. So the loss is never negative, and it is 0 only if all splats of a pixel face
# the way the depth map runs. It does not know where the surface is. Photos and patches do, once splats no longer hide
# others.


# %%
def trained(finish, surface):
    """Train the photos of a finish; return the scene, its mesh, and depth and normal errors of all photos."""
    capture = captures[finish]
    config = recipe(ITERATIONS, strategy="fast", surface=surface, max_gaussians=SPLATS)
    data = SimpleNamespace(train=capture.views, points=capture.points, colors=capture.colors)
    trainer = training(config, data, load_backend("cpu"))
    trainer.run()
    settings = RenderSettings(config.background, jacobian_limit=config.jacobian_limit)
    errors, angles = {kind: [] for kind in DEPTHS}, []
    for view, photo in zip(capture.views, capture.photos, strict=True):
        with torch.no_grad():
            maps, _ = render_maps(trainer.gaussians, view.camera, (*DEPTHS, "normal"), settings, "cpu")
        for kind in DEPTHS:
            both = (photo.depth > 0) & (maps[kind].numpy() > 0)
            errors[kind].append(np.where(both, maps[kind].numpy() - photo.depth, np.nan))
        cosine = np.clip((maps["normal"].numpy() * photo.normals).sum(axis=-1)[photo.depth > 0], -1, 1)
        angles.append(np.degrees(np.arccos(cosine)).mean())
    cameras = [(view.name, view.camera) for view in capture.views]
    meshed = extract_mesh(trainer.gaussians, cameras, settings, load_backend("cpu"))
    return SimpleNamespace(
        meshed=meshed, angle=np.mean(angles), errors={k: np.stack(errors[k]) for k in DEPTHS}
    )


runs = {"photos alone": trained("textured", False), "with a surface": trained("textured", True)}
fig, axes = plt.subplots(2, 3, figsize=(13, 6.8), layout="constrained")
for row, (name, run) in zip(axes, runs.items(), strict=True):
    far = {kind: np.nanmean(np.abs(values)) for kind, values in run.errors.items()}
    print(f"{name}: mean error of", ", ".join(f"{kind} {value:.4f}" for kind, value in far.items()), end="; ")
    print(f"normals off by {run.angle:.1f} degrees")
    for ax, (kind, values) in zip(row, run.errors.items(), strict=True):
        shown = ax.imshow(values[2], cmap="RdBu", vmin=-0.2, vmax=0.2)
        ax.set(title=f"{kind}, {name}", xticks=[], yticks=[])
fig.colorbar(shown, ax=axes, label="depth error, world units")
plt.show()
before, after = runs.values()
far = [[np.nanmean(np.abs(run.errors[kind])) for kind in DEPTHS] for run in (before, after)]
assert after.angle < before.angle and (SHORT or np.all(np.array(far[1]) < far[0]))

# %% [markdown]
# With photos alone, faint splats hang before the surface (red) and behind it (blue), and the mean depth averages over
# them. The median ignores a veil of less than one half, so meshes are made of it. The planar depth is the worst: all
# $d_i$ are negative, but where normals disagree, terms of $\hat n \cdot r$ cancel.
#
# ## Many depths, one surface
#
# Depth maps disagree. Curless and Levoy 1996 let them vote on a grid. To view $k$, a grid point of camera depth $z_k$
# lies $d_k - z_k$ in front of the surface, where $d_k$ is its depth map at the point's pixel: positive outside,
# negative inside. Far from the surface the number means little, so it is clamped to $\pm t$, the *truncation*; and a
# point deeper than $t$ is hidden, so this view has no vote on it. The value with the smallest sum of weighted squares
# is the mean:
#
# $$ \frac{\partial}{\partial D} \sum_k v_k \left(D - \mathrm{clamp}(d_k - z_k)\right)^2 = 0 \quad\Rightarrow\quad
# D = \frac{\sum_k v_k\, \mathrm{clamp}(d_k - z_k)}{\sum_k v_k} . $$
#
# The surface is where this [TSDF](../docs/GLOSSARY.md#tsdf) is 0. The vote $v$ is 1 in front of the surface and falls
# to 0 between $-t/2$ and $-t$. Between pixels, $1/z$ is interpolated, because it is linear on a plane: from
# $n \cdot z r = d$ follows $1/z = n \cdot r / d$, and $r$ is linear in the pixel.


# %%
def looked_up(depth, u, v, truncation):
    """Depth between pixels; 0 beside a jump and where a pixel has none."""
    left, top = (np.floor(x).astype(int) for x in (u, v))
    x, y = u - left, v - top
    four = np.stack([depth[top + j, left + i] for j in (0, 1) for i in (0, 1)])
    whole = (four.min(axis=0) > 0) & (np.ptp(four, axis=0) < truncation)
    shares = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y])
    return np.where(whole, 1 / (shares / np.where(whole, four, 1)).sum(axis=0), 0)


def fused(depths, cameras, low, shape, voxel, truncation):
    """Mean of the clamped distances at the points low + voxel * (i, j, k); NaN where no view votes."""
    points = low + voxel * np.indices(shape).reshape(3, -1).T
    total, votes = np.zeros((2, len(points)))
    for depth, camera in zip(depths, cameras, strict=True):
        u, v, z = camera.project(camera.world_to_cam(points))
        at = np.flatnonzero((z > Z_NEAR) & (u >= 0) & (v >= 0) & (u < camera.W - 1) & (v < camera.H - 1))
        seen = looked_up(depth, u[at], v[at], truncation)
        gap = seen - z[at]
        vote = np.clip(2 + 2 * gap / truncation, 0, 1) * (seen > 0)
        total[at] += vote * np.clip(gap, -truncation, truncation)
        votes[at] += vote
    return np.divide(total, votes, where=votes > 0, out=np.full(len(points), np.nan)).reshape(shape)


def crossings(D, low, voxel):
    """Where D changes its sign along the edges of the grid, by linear interpolation."""
    places = []
    for axis in range(3):
        first, last = np.delete(D, -1, axis), np.delete(D, 0, axis)
        at = np.nonzero(first * last < 0)
        place = np.stack(at, axis=1).astype(float)
        place[:, axis] += first[at] / (first[at] - last[at])
        places.append(low + voxel * place)
    return np.concatenate(places)


VOXEL = 0.06 if SHORT else 0.03
cells = np.array([[-1.3, -0.9, -1.3], [1.3, 0.06, 1.3]]) // VOXEL  # 0.5 is added, as the package does
low, shape = VOXEL * (cells[0] + 0.5), (cells[1] - cells[0]).astype(int)
cameras = [view.camera for view in captures["textured"].views]
exact_depths = [photo.depth for photo in captures["textured"].photos]
for what, depths in (("exact", exact_depths), ("trained", [view.depth for view in after.meshed.views])):
    volume = SparseVolume(VOXEL)
    for depth, camera in zip(depths, cameras, strict=True):
        volume.integrate(depth, camera)
    ours = crossings(fused(depths, cameras, low, shape, VOXEL, 3 * VOXEL), low, VOXEL)
    theirs = volume.mesh().vertices
    theirs = theirs[((theirs > low) & (theirs < low + VOXEL * (shape - 1))).all(axis=1)]
    away = [np.abs(solid.distance(vertices)).mean() / VOXEL for vertices in (ours, theirs)]
    print(f"{what} depths: {len(ours)} crossings, {away[0]:.3f} voxels off the surface on average;", end=" ")
    print(f"the package: {len(theirs)}, {away[1]:.3f}")
    assert what == "trained" or max(away) < (0.2 if SHORT else 0.1)

# %% [markdown]
# The places where the sign changes on the grid's edges are the vertices of *marching cubes* (Lorensen and Cline 1987).
# The rest is a table: the signs of a cell's eight corners have $2^8$ patterns, and for each pattern the table says
# which crossings form triangles. Two cells that share a face have to join its crossings in the same way, or the mesh
# tears. [gsplat_edu.mesh.volume](../src/gsplat_edu/mesh/volume.py) does both on blocks of voxels near the surface
# only.
#
# ## The mesh of the splats
#
# Now the same with the median depths of trained scenes. `extract_mesh`, which `gsplat-edu mesh` calls, drops the
# depths that other views see through or that see the surface edge-on, fuses the rest, and removes loose crumbs.
#
# > **Predict.** Which objects end up furthest from the truth: textured, plain or glossy ones?

# %%
runs |= {f"{finish}, with a surface": trained(finish, True) for finish in ("plain", "glossy")}
BOX = np.array([[-1.4, -1.2, -1.4], [1.4, 0.2, 1.4]])  # without the rim of the floor


def sampled(run):
    """Points of a mesh, uniform over its area and inside the box, and their distances from the truth."""
    points, _ = sample_surface(run.meshed.mesh, 50_000 if SHORT else 300_000)
    points = points[((points > BOX[0]) & (points < BOX[1])).all(axis=1)]
    return points, np.abs(solid.distance(points))


def drawn(run, camera):
    """Draw a mesh's triangles from far to near, coloured by distance from the truth, shaded by their normals."""
    corners = run.meshed.mesh.corners
    corners = corners[((corners > BOX[0]) & (corners < BOX[1])).all(axis=(1, 2))]
    middles, (a, b, c) = corners.mean(axis=1), np.moveaxis(corners, 1, 0)
    across, towards = np.cross(b - a, c - a), camera.eye - middles
    lengths = np.linalg.norm(across, axis=1) * np.linalg.norm(towards, axis=1)
    facing = np.abs((across * towards).sum(axis=1)) / np.maximum(lengths, 1e-30)
    colors = colormaps["viridis"](np.clip(np.abs(solid.distance(middles)) / 0.04, 0, 1))[:, :3]
    u, v, z = camera.project(camera.world_to_cam(corners.reshape(-1, 3)))
    polygons = np.rint(16 * np.stack([u, v], axis=1)).astype(np.int32).reshape(-1, 3, 2)  # 1/16 px: shift=4
    picture = np.ones((camera.H, camera.W, 3))
    colors = (colors * (0.3 + 0.7 * facing)[:, None]).tolist()
    for face in np.argsort(-z.reshape(-1, 3).mean(axis=1)):
        cv2.fillConvexPoly(picture, polygons[face], colors[face], shift=4)
    return picture


samples = {name: sampled(run) for name, run in runs.items()}
above = Camera.looking_at([0.9, -2.4, -2.6], [0, -0.25, 0], fx=600, fy=600, H=400, W=570)
fig, axes = plt.subplots(2, 2, figsize=(13, 8.6), layout="constrained")
for ax, (name, (_, away)) in zip(axes.flat, samples.items(), strict=True):
    shown = ax.imshow(drawn(runs[name], above), cmap="viridis", vmin=0, vmax=0.04)
    ax.set(title=f"{name}: {away.mean():.4f} off on average", xticks=[], yticks=[])
fig.colorbar(shown, ax=axes, label="distance from the true surface, world units")
plt.show()
assert SHORT or samples["with a surface"][1].mean() < samples["photos alone"][1].mean()

# %% [markdown]
# Distances to the truth do not notice what is missing. So go the other way: sample the truth, and ask which part of it
# has the mesh within a voxel. A virtual scan ([gsplat_edu.evaluate.surface](../src/gsplat_edu/evaluate/surface.py))
# tells first which part any photo sees at all.

# %%
truth, _ = solid.surface(4_000 if SHORT else 20_000)
truth = truth[(np.abs(truth[:, [0, 2]]) < 1.35).all(axis=1)]
owner = np.array([part.name for part in solid.parts])[solid.nearest(truth)]
seen = visible_points(truth, cameras, exact_depths, tolerance=0.01)
names, found = ("floor", "bowl", "rods", "slots", "torus"), {}
print(f"{'found within a voxel, %':24}" + "".join(f"{name:>8}" for name in (*names, "unseen")))
for name, (points, _) in samples.items():
    near = cKDTree(points).query(truth)[0] < runs[name].meshed.voxel
    shares = [near[(owner == part) & seen].mean() for part in names]
    found[name] = dict(zip((*names, "unseen"), (*shares, near[~seen].mean()), strict=True))
    print(f"{name:24}" + "".join(f"{100 * share:8.1f}" for share in found[name].values()))
print(f"no photo sees {100 * (~seen).mean():.1f} % of the true surface")
assert all(table["unseen"] < 0.5 for table in found.values())
assert SHORT or found["with a surface"]["rods"] < found["with a surface"]["torus"]
assert SHORT or found["with a surface"]["rods"] < found["photos alone"]["rods"]
for finish in ("plain", "glossy"):
    shares = {part: found[f"{finish}, with a surface"][part] for part in names}
    assert SHORT or min(shares, key=shares.get) == "bowl"

below = Camera.looking_at([0.9, 2.2, -2.6], [0, -0.1, 0], fx=500, fy=500, H=350, W=500)
close = Camera.looking_at([0.5, -1.1, -2.4], [0.6, -0.35, -0.6], fx=640, fy=640, H=350, W=500)
fig, axes = plt.subplots(1, 3, figsize=(13, 3.6), layout="constrained")
axes[0].imshow(photograph_solids(solid, close, "glossy").image)
axes[0].set(title="the rods, in truth", xticks=[], yticks=[])
for ax, camera, title in zip(axes[1:], (close, below), ("the glossy mesh", "from below"), strict=True):
    ax.imshow(drawn(runs["glossy, with a surface"], camera))
    ax.set(title=title, xticks=[], yticks=[])
plt.show()

# %% [markdown]
# The bowl is the worst where it is plain or glossy. Its inside has no texture, and a shade that changes slowly fits
# any depth; a highlight even moves with the camera, as a point off the surface would. All rods are thinner than the
# truncation: the front of one still votes behind its back. The losses of `--surface` do the textured rods harm: with
# photos alone, the mesh has more of them. What no photo sees, such as the floor's underside, is missing, and the yellow
# corner is seen by few photos.
#
# ## The next failure
#
# Each triangle of the mesh has one colour: the highlight is painted onto the bowl, and with it the light of the day of
# the photos. Hair, leaves and glass have no surface to find. And photos made splats, splats made depths, depths made
# triangles: no error of the mesh flows back.
#
# With a capture of your own, `gsplat-edu train CAPTURE --out RUN --surface` trains with both losses of this page,
# `gsplat-edu mesh RUN mesh.glb --texture` makes the mesh, and `--truth SCAN` measures it
# ([Meshes](../docs/howto/mesh.md)). It began with [a point](01_points.ipynb). What every training since
# [chapter 09](09_train_in_3d.ipynb) took for granted is left: where its Gaussians come from, and where they go
# ([chapter 16](16_birth_and_death.ipynb)).
