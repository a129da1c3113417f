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
# # 14 - From photos to a scene
#
# Everything so far was trained on photos that a renderer took, from cameras that were written down before the first
# photo existed. A phone writes a folder of photos. It does not say where it was held, its focal length is not
# reliable, and one photo in twenty is blurred by motion. [Chapter 12](12_the_backward_pass.ipynb) made training
# fast, but fast training on cameras that are wrong arrives early at nothing.
#
# The photos of this page show a house in a garden ([lab.captures.garden](../lab/captures/garden.py)). A ray
# tracer takes them of solid walls, roofs and tree crowns, so no set of splats can match them exactly. The window panes
# mirror the sky, and the sky is infinitely far away, as outdoors.
#
# > **Needs.** A clone of the repository, whose `lab` takes the photos, a C++ compiler, with which the page builds a
# > kernel of `benchmarks/ladder`, and pycolmap, which `make course` installs.

# %%
import itertools
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pycolmap
import torch
from matplotlib_inline.backend_inline import set_matplotlib_formats

from gsplat_edu import Z_NEAR, Camera, _native
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.doctor.before import examine
from gsplat_edu.doctor.diagnosis import advice_lines, diagnosis_lines
from gsplat_edu.evaluate.metrics import psnr, ssim, summarize, to_bytes
from gsplat_edu.ops.losses import l1_ssim
from gsplat_edu.render.numpy_reference import project
from gsplat_edu.runs.training import CaptureRun, RunOptions
from gsplat_edu.scene.gaussians import cov3d_t
from gsplat_edu.scene.views import View
from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from gsplat_edu.survey.capture import prepare
from gsplat_edu.train.config import recipe

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "benchmarks" / "ladder").is_dir())
sys.path += [str(ROOT), str(ROOT / "benchmarks")]
from kernel_operations import operations
from ladder.forward import tight
from ladder.splats import from_cov2d
from train_step import measure

from lab.captures.garden import GARDEN_DISTANCE, MATERIALS, garden_camera, photograph_garden
from lab.captures.textured_box import align_cameras

SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
COUNT, WIDTH, ITERATIONS, BRIEFLY = (36, 320, 400, 200) if SHORT else (41, 480, 3000, 300)
WORK = Path(tempfile.mkdtemp())
set_matplotlib_formats("jpeg", pil_kwargs={"quality": 75})  # photos are large as PNG
print(f"budget: {COUNT} photos, {WIDTH} px, {ITERATIONS} iterations{' (reduced)' if SHORT else ''}")

# %% [markdown]
# ## Photos, and nothing else
#
# Somebody walks around the house once, in steps that are not even, and holds the phone now higher and now lower. One
# photo is shaken.

# %%
rng = np.random.default_rng(13)
walk = 2 * np.pi * (np.arange(COUNT) + rng.uniform(-0.3, 0.3, COUNT)) / COUNT
heights = 0.28 + 0.12 * np.sin(3 * walk) + rng.uniform(-0.05, 0.05, COUNT)
names = [f"IMG_{i:02d}.png" for i in range(COUNT)]
frame_size, shaken = (WIDTH, 3 * WIDTH // 4), names[5]
truth = {n: garden_camera(a, h, frame_size) for n, a, h in zip(names, walk, heights, strict=True)}
photos = {name: photograph_garden(camera).image for name, camera in truth.items()}
photos[shaken] = cv2.blur(photos[shaken], (WIDTH // 64, 1))  # the hand moved by that many px
(WORK / "photos").mkdir()
for name, photo in photos.items():
    cv2.imwrite(str(WORK / "photos" / name), photo[..., ::-1])


def gallery(title, images, rows=1, height=2.8):
    fig, axes = plt.subplots(rows, len(images) // rows, figsize=(13, height), layout="constrained")
    for ax, (name, image) in zip(axes.flat, images.items(), strict=True):
        ax.imshow(image, interpolation="nearest")
        ax.set(title=name, xticks=[], yticks=[])
    fig.suptitle(title)
    plt.show()


gallery("the first ten photos: no pose, no focal length", {n: photos[n] for n in names[:10]}, 2, 4.4)

# %% [markdown]
# The obvious thing is to guess: a circle, even steps, one height, and the lens is known. The guess becomes a capture
# with random points around the house. [gsplat_edu.runs.training](../src/gsplat_edu/runs/training.py) trains on it, as
# `gsplat-edu train` does.


# %%
def trained(data, out, iterations, strategy="adc", appearance="none", sky="none", **reading):
    config = recipe(iterations, strategy=strategy, appearance=appearance, sky=sky, max_gaussians=20_000)
    settings = DataSettings(**reading)
    options = RunOptions(WORK / data, WORK / out, config, settings, eval_every=iterations, save_every=0)
    job = CaptureRun(options)
    began = time.process_time()
    job.train()
    return job, time.process_time() - began, job.finish()


def picture(job, camera):
    with torch.no_grad():
        return to_bytes(job.options.renderer(job.trainer.gaussians, camera).image)


def compare(rows):
    """Draw photo, render and error for each name, photo and render."""
    fig, axes = plt.subplots(len(rows), 3, squeeze=False, figsize=(13, 3.3 * len(rows)), layout="constrained")
    for row, (name, photo, image) in zip(axes, rows, strict=True):
        apart = np.abs(image.astype(float) - photo).mean(axis=2) / 255
        titles = f"photo, {name}", f"render, {psnr(image / 255, photo):.2f} dB", "error"
        for ax, title, pixels in zip(row, titles, (photo, image, apart), strict=True):
            mesh = ax.imshow(pixels, cmap="magma", vmin=0, vmax=0.25)
            ax.set(title=title, xticks=[], yticks=[])
        fig.colorbar(mesh, ax=row[2], label="absolute error, mean of the channels")
    plt.show()


even = 2 * np.pi * np.arange(COUNT) / COUNT
guess = {name: garden_camera(a, 0.28, frame_size) for name, a in zip(names, even, strict=True)}
cloud = rng.uniform([-2, -1.8, -2], [2, 0, 2], (4000, 3))
views = [View(guess[name], photos[name], name=name) for name in names]
write_colmap(WORK / "guess", views, cloud, np.full(cloud.shape, 0.5))
SIDE_PX = 160
mush, _, scores = trained("guess", "mush", BRIEFLY, resolution=SIDE_PX)
mushy, seen = (summarize(part)["psnr"] for part in (scores.test, scores.train))
print(f"guessed poses, {BRIEFLY} iterations at {SIDE_PX} px: {mushy:.2f} dB held out, {seen:.2f} dB seen")
compare([(v.name, v.image, picture(mush, v.camera)) for v in mush.dataset.test[:2]])

# %% [markdown]
# Every photo contradicts the next: a few degrees around the house move its corners by many pixels. The cameras have to
# be found, and the photos are all there is to find them with.
#
# ## What two photos say about each other
#
# A point of the scene lies on a ray through each photo that shows it. Let $x_1 = ((u_1 - c_x)/f, (v_1 - c_y)/f, 1)$
# be its direction in the first camera and $x_2$ that in the second, and let the second camera see the first one's
# coordinates through $W$ and $t$: $z_2 x_2 = W\, z_1 x_1 + t$. Cross with $t$, then take the product with $x_2$. Both
# $t$ and the left side fall out, and so do the unknown depths:
#
# $$ x_2^\top [t]_\times W\, x_1 = 0 . $$
#
# One equation per match, linear in the nine numbers of $E = [t]_\times W$, and true only for the right motion. The
# length of $t$ is a common factor and cannot be known. So poses can be found from matches, and matches from what does
# not change between photos: SIFT describes the surroundings of a corner by gradients, at the corner's own scale and
# angle (Lowe 2004). Then the mapper (Schönberger and Frahm 2016) begins with two photos, triangulates points, adds
# the photo that sees most of them, and again and again lets least squares move poses, points and the lens together
# ([bundle adjustment](../docs/GLOSSARY.md#bundle-adjustment)).
#
# [gsplat_edu.sfm](../src/gsplat_edu/sfm/reconstruct.py) drives COLMAP through these stages. It is what `gsplat-edu
# sfm` calls. One thread makes the result the same to the bit in every run.

# %%
reconstruct(SfmOptions(WORK / "photos", WORK / "capture", threads=1), print)
found_set = load_dataset(WORK / "capture", DataSettings(test_every=0))
found = {view.name: view.camera for view in found_set.train}
one, two, focal = *names[:2], truth[names[0]].fx
print(f"{len(found)} of {COUNT} posed; focal length {found[one].fx:.2f} px, in truth {focal:.2f} px")
assert len(found) >= COUNT - 1
database = pycolmap.Database.open(WORK / "capture/sfm/database.db")
number = {name: i + 1 for i, name in enumerate(names)}


def matched(*pair):
    """Return where two photos match, px; COLMAP has the first pixel's centre at (0.5, 0.5)."""
    chosen = database.read_two_view_geometry(*(number[name] for name in pair)).inlier_matches.T
    points = (database.read_keypoints(number[name]) for name in pair)
    return [xy[rows, :2] - 0.5 for xy, rows in zip(points, chosen, strict=True)]


points, (a, b) = database.read_keypoints(number[one]), matched(one, two)
fig, axes = plt.subplots(1, 2, figsize=(13, 3.4), layout="constrained", width_ratios=[1, 2])
axes[0].imshow(photos[one])
widths = np.hypot(points[::4, 2], points[::4, 4])
axes[0].scatter(*points[::4, :2].T, s=20 * widths, facecolors="none", edgecolors="yellow")
axes[0].set(title=f"{len(points)} features, every fourth drawn", xlim=(0, WIDTH), ylim=(frame_size[1], 0))
axes[1].imshow(np.concatenate([photos[one], photos[two]], axis=1))
axes[1].plot([a[::25, 0], b[::25, 0] + WIDTH], [a[::25, 1], b[::25, 1]], color="white", linewidth=0.9)
axes[1].set(title=f"{len(a)} matches that one geometry explains, one in 25 drawn")
plt.setp(axes, xticks=[], yticks=[])
plt.show()

# %% [markdown]
# The equation can be asked of any cameras: how far is a match from the line that the other photo gives it? Features
# are placed to a fraction of a pixel, so for the right poses half of the matches have to be closer than one.


# %%
def line_distances(cameras):
    distances = []
    for pair in itertools.pairwise(sorted(found)):
        c1, c2 = (cameras[name] for name in pair)
        a, b = ((xy - [c.cx, c.cy]) / c.fx for xy, c in zip(matched(*pair), (c1, c2), strict=True))
        x1, x2 = (np.column_stack([xy, np.ones(len(xy))]) for xy in (a, b))
        lines = np.cross(c2.R @ (c1.eye - c2.eye), x1 @ (c2.R @ c1.R.T).T)  # E x1, row by row
        off = np.abs((x2 * lines).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)
        distances.append(c2.fx * off)
    return np.concatenate(distances)


off = {what: line_distances(c) for what, c in (("guess", guess), ("found", found), ("truth", truth))}
for what, far in off.items():
    print(f"{what}: half of {len(far)} matches lie within {np.median(far):.2f} px of their line")
assert np.median(off["found"]) < 1 < np.median(off["guess"])

# %% [markdown]
# ## Found, up to a similarity
#
# Photos know no north and no metre. Turn, move and enlarge the whole world, cameras and all, and every photo stays as
# it is. So poses are compared with the truth after the similarity $x' = s R x + t$ that brings the centres closest
# ([align_cameras](../lab/captures/textured_box.py), after Umeyama 1991).
#
# The size of the remaining error can be predicted. A lens of $f$ pixels sees a pixel as $1/f$ radians, and at the
# distance $z$ of the house a pixel is $z/f$ world units. Features are better than a pixel, but focal length and
# distortion are found from the same few photos: two pixels' worth is allowed, of angle and of place.

# %%
fit = align_cameras(found, truth)
eyes = np.stack([truth[name].eye for name in found])
allowed = 2 * GARDEN_DISTANCE / focal / np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max()
print(f"largest turn {fit.turned.max():.3f} degrees, allowed {np.degrees(2 / focal):.3f}")
print(f"largest shift {100 * fit.moved.max():.3f} % of the extent, allowed {100 * allowed:.3f} %")
assert fit.turned.max() < np.degrees(2 / focal) and fit.moved.max() < allowed

fig, ax = plt.subplots(figsize=(6.4, 6), layout="constrained")
cloud_found = fit.s * found_set.points @ fit.R.T + fit.t
ax.scatter(cloud_found[:, 0], cloud_found[:, 2], c=found_set.colors, s=4)
for what, cameras, style in (("truth", truth, "ko"), ("guess", guess, "rx"), ("found", found, "b.")):
    eyes = np.stack([camera.eye for camera in cameras.values()])
    eyes = fit.s * eyes @ fit.R.T + fit.t if what == "found" else eyes
    ax.plot(eyes[:, 0], eyes[:, 2], style, fillstyle="none", markersize=9, label=what)
ax.set(title=f"from above: cameras, and the {len(cloud_found)} points that were triangulated")
ax.set(xlabel="x, world units of the truth", ylabel="z, world units of the truth", aspect="equal")
ax.legend()
plt.show()

# %% [markdown]
# ## A second opinion
#
# [Structure from motion](../docs/GLOSSARY.md#structure-from-motion) places a shaken photo like any other, since a
# blurred corner is still at the place of the corner. A scene that trains on it learns the blur. The doctor
# ([gsplat_edu.doctor](../src/gsplat_edu/doctor/before.py)) looks for that before any training: it compares the fine
# detail of each photo, along eight directions, with that of its neighbours, which see the same.

# %%
for expected in ((shaken,), None):
    diagnosis = examine(prepare(CaptureReader(WORK / "capture")))
    for line in (*diagnosis_lines(diagnosis), *advice_lines(diagnosis)):
        print(line.replace(f"{WORK}/", ""))
    assert {finding.name: finding.images for finding in diagnosis.findings}.get("blurred") == expected
    # It names the photo that was planted. Its advice is taken.
    (WORK / "capture/images" / shaken).unlink(missing_ok=True)

# %% [markdown]
# ## The scene
#
# Now the recipe of Kerbl et al. 2023 (`gsplat-edu train --strategy adc`), every eighth photo held out. The loss is
# $0.8\,L_1 + 0.2\,(1 - \mathrm{SSIM})$, where [SSIM](../docs/GLOSSARY.md#ssim) (Wang et al. 2004) is 1 if two photos
# agree in mean, contrast and pattern around every pixel: $L_1$ alone forgives blur. With the mean $m$, the variance
# $v$ and the covariance $v_{xy}$ of render $x$ and photo $y$ in a round window about the pixel, of 11 px and a
# standard deviation of 1.5, it is
#
# $$\mathrm{SSIM} = \frac{a\,b}{d\,e}, \qquad a = 2 m_x m_y + 0.01^2, \quad b = 2 v_{xy} + 0.03^2, \quad
# d = m_x^2 + m_y^2 + 0.01^2, \quad e = v_x + v_y + 0.03^2,$$
#
# and the mean over all pixels and channels counts. Its gradient is one blur more. A pixel enters $m_x$ with the
# window's weight, the mean of $x^2$ in $v_x$ with $2x$ times the weight, and the mean of $xy$ in $v_{xy}$ with $y$
# times the weight; every window that holds the pixel adds its share, and adding shares up by weights is a blur.

# %%
WINDOW = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
WINDOW /= WINDOW.sum()


def blurred(image):
    return cv2.sepFilter2D(image, -1, WINDOW, WINDOW, borderType=cv2.BORDER_CONSTANT)  # zero outside


def ssim_and_slope(x, y):
    m_x, m_y = blurred(x), blurred(y)
    v_x, v_y, v_xy = blurred(x * x) - m_x * m_x, blurred(y * y) - m_y * m_y, blurred(x * y) - m_x * m_y
    a, b = 2 * m_x * m_y + 0.01**2, 2 * v_xy + 0.03**2
    d, e = m_x * m_x + m_y * m_y + 0.01**2, v_x + v_y + 0.03**2
    ratio = a * b / (d * e)
    by_m, by_v, by_xy = 2 * m_y * b / (d * e) - 2 * m_x * ratio / d, -ratio / e, 2 * a / (d * e)
    slope = blurred(by_m - 2 * m_x * by_v - m_y * by_xy) + 2 * x * blurred(by_v) + y * blurred(by_xy)
    return ratio.mean(), slope / x.size


sharp = photos[names[0]] / 255
soft = torch.tensor(blurred(sharp), requires_grad=True)
by_hand, slope = ssim_and_slope(soft.detach().numpy(), sharp)
l1_ssim(soft, torch.tensor(sharp), ssim_weight=1.0).backward()
error = np.abs(slope + soft.grad.numpy()).max() / np.abs(slope).max()
l1_apart = np.abs(soft.detach().numpy() - sharp).mean()
print(
    f"blurred: L1 {l1_apart:.3f}, SSIM {by_hand:.3f}; the package's slope differs by {error:.0e} of the largest"
)
assert abs(by_hand - ssim(soft.detach(), sharp)) < 1e-12 and error < 1e-9
assert 1 - by_hand > 5 * l1_apart

# %% [markdown]
# The field compares the mean peak signal-to-noise ratio of held-out photos, $10 \log_{10}(1/\mathrm{MSE})$ in decibels
# ([gsplat_edu.evaluate.metrics](../src/gsplat_edu/evaluate/metrics.py)): 3 dB are half the squared error. The first
# line below compares with the guess, which had to begin with random points.

# %%
posed = summarize(trained("capture", "small", BRIEFLY, resolution=SIDE_PX)[2].test)["psnr"]
print(f"{BRIEFLY} iterations at {SIDE_PX} px: {posed:.2f} dB held out, on guessed poses {mushy:.2f} dB")
assert posed > mushy + 1
final, seconds, scores = trained("capture", "scene", ITERATIONS)
test, train = summarize(scores.test), summarize(scores.train)
print(f"{ITERATIONS} iterations, {len(final.trainer.gaussians)} Gaussians")
print(f"{len(scores.test)} held out: PSNR {test['psnr']:.2f} dB, SSIM {test['ssim']:.3f};", end=" ")
print(f"seen: PSNR {train['psnr']:.2f} dB")
assert test["psnr"] > (17 if SHORT else 22)

held_out = sorted(final.dataset.test, key=lambda v: psnr(picture(final, v.camera) / 255, v.image))
view, poorest = held_out[len(held_out) // 2], held_out[0]
print("; ".join(f"{v.name} {psnr(picture(final, v.camera) / 255, v.image):.2f} dB" for v in held_out))
compare([(v.name, v.image, picture(final, v.camera)) for v in (view, poorest)])

# %% [markdown]
# The first row is the median of the held-out photos, the second is the worst. The true cameras say what each held-out
# pixel shows, so the error can be listed by material:

# %%
shows = np.stack([photograph_garden(truth[v.name]).material for v in held_out])
shot = np.stack([v.image for v in held_out]) / 255


def by_material(job):
    """Return the PSNR of each material's pixels in the held-out photos, dB, and its share of the squared error."""
    squares = ((np.stack([picture(job, v.camera) for v in held_out]) / 255 - shot) ** 2).mean(axis=-1)
    pixels = {what: squares[shows == k] for k, what in enumerate(MATERIALS)}
    levels = {what: -10 * np.log10(errors.mean()) for what, errors in pixels.items()}
    return levels, {what: errors.sum() / squares.sum() for what, errors in pixels.items()}


old, shares = by_material(final)
for what, level in old.items():
    print(f"{what:8} {level:6.2f} dB, {100 * shares[what]:5.1f} % of the error")
assert shares["sky"] + shares["grass"] > 0.5
assert SHORT or set(sorted(old, key=old.get)[:2]) == {"sky", "chimney"}
assert SHORT or max(old["sky"], old["chimney"]) < min(old["brick"], old["roof"], old["wood"]) - 3

# %% [markdown]
# The sky is what went wrong, and with it the chimney, which stands before it; the walls are right. Sky and grass
# have more than half of the error. The recipe begins with the triangulated points, and at infinity there are none:
# training puts splats near the cameras instead, which cover the sky in one photo and the lawn in the next. The doctor
# has seen it, and advises `--sky shell`: far splats from the start, coloured by the photos.
#
# Those were the steps of 2023. `gsplat-edu train` takes others unless asked: small photos at first, splits of the
# splats with the largest gradients up to a planned number, a small weight on opacity, so that what no photo needs
# fades, and rates twice as high, which fall to the end ([RECIPE.md](../docs/RECIPE.md) says where each piece comes
# from). It also looks for sky and chooses `--sky` by itself. A third of the steps will do:

# %%
steps = ITERATIONS if SHORT else ITERATIONS // 3
quick, spent, better = trained("capture", "quick", steps, "fast", sky="shell")
faster, share = summarize(better.test)["psnr"], spent / seconds
print(f"{steps} iterations, {share:.2f} of the processor's time: {faster:.2f} dB held out")
assert faster > test["psnr"] - 1
new, _ = by_material(quick)
for what, level in new.items():
    print(f"{what:8} {level:6.2f} dB, {level - old[what]:+6.2f} dB")
gained = {what: new[what] - old[what] for what in old}
assert SHORT or set(sorted(gained, key=gained.get)[-2:]) == {"sky", "chimney"}
assert SHORT or max(gained["brick"], gained["wood"]) < 1.5 < min(gained["sky"], gained["chimney"]) / 2
compare([(poorest.name, poorest.image, picture(quick, poorest.camera))])

# %% [markdown]
# Sky and chimney have gained by far the most. Not everything has: brick and wood, which the longer run had right
# already, gain little or lose a little with a third of the steps.
#
# ## When the phone decides
#
# These photos agree about the colour of every wall. Those of a phone left on automatic do not: it sets exposure and
# white balance anew for each photo. Here every third photo is made 0.8 stops darker, the others as much brighter, and
# red and blue change a little. A stop doubles the light, and a pixel's value is about the light to the power of 1/2.2.
#
# > **Predict.** A scene is trained on these photos as if they agreed. Where do you look for the damage first: at the
# > edges of the roof, in the texture of grass and bricks, or where large surfaces are plain?

# %%
shutil.copytree(WORK / "capture", WORK / "automatic")
planted = {}
for k, path in enumerate(sorted((WORK / "automatic/images").iterdir())):
    light = (0.8 if k % 3 else -0.8) + rng.uniform(-0.2, 0.2, 3) * (1, 0, 1)  # stops of blue, green and red
    changed = np.clip(np.round(cv2.imread(str(path)) * 2 ** (light / 2.2)), 0, 255).astype(np.uint8)
    cv2.imwrite(str(path), changed)
    planted[f"{path.name}, {light[1]:+.1f} stops"] = changed[..., ::-1]
gallery("four neighbours, as the phone exposes them", dict(list(planted.items())[:4]), height=2.9)

wavering, fitted = {}, {}
for name in ("none", "exposure"):
    wavering[name], _, scores = trained("automatic", name, ITERATIONS // 3, "fast", name, "shell")
    fitted[name] = summarize(scores.test)["psnr_fitted"]
    print(f"appearance {name}: {fitted[name]:.2f} dB held out, exposure fitted")
assert fitted["exposure"] > fitted["none"]


def balanced(name, v):
    """Render a view with one gain per channel, because a scene's exposure is its own; return the PSNR, too."""
    image = np.maximum(picture(wavering[name], v.camera), 1) / 255
    image = to_bytes(image * np.median(v.image / 255 / image, axis=(0, 1)))
    return psnr(image / 255, v.image), image


v = max(held_out, key=lambda v: balanced("exposure", v)[0] - balanced("none", v)[0])
compare([(f"{v.name} ({name})", v.image, balanced(name, v)[1]) for name in wavering])

# %% [markdown]
# The plain surfaces show it best: without a correction, sky and lawn have lighter and darker patches. With
# `--appearance exposure`, each photo has one gain per channel, measured whenever it is drawn: the median of photo
# over render. The render is multiplied by it before the loss compares the two, so that the scene need not change its
# colour with the viewpoint. The gains of all photos have the geometric mean 1: otherwise a scene half as bright with
# gains twice as large would be as good. The gain of a held-out photo is measured on its left half, and the right half
# is scored: that is "exposure fitted". `gsplat-edu train` looks at the photos and chooses by itself. Other faults have
# their own remedies: `--refine` for poses that are a little off, `--transients` for passers-by, and `gsplat-edu clean`
# for floaters. The [how-tos](../docs/howto/README.md) show what they do.
#
# ## Where the time went
#
# Poses are paid for once; training is what a budget decides. `benchmarks/train_step.py` takes its iteration apart, here
# on the trained scene. Of some rounds the fastest is shown; its rows are medians, so they need not add up.

# %%
done = json.loads((WORK / "capture/sfm/stages.json").read_text())["stages"]
table = {name: done[name]["facts"]["seconds"] for name in ("features", "matches", "mapping")}
table |= {"undistortion": done["capture"]["facts"]["seconds"], "training": final.seconds}
rounds = [measure(final.trainer.gaussians, [view], 8) for _ in range(2 if SHORT else 8)]
iteration = min(rounds, key=lambda parts: parts["iteration"])
pairs = round(iteration.pop("pairs"))
for parts, whole in ((table, sum(table.values())), (iteration, iteration["iteration"])):
    for name, value in parts.items():
        print(f"{name:18} {100 * value / whole:5.1f} %")

# %% [markdown]
# ## How far from the machine's limits
#
# A kernel that is bound by arithmetic is no faster than its operations over the machine's rate of them. At how many
# pixels a splat is above the floor is counted by the rung `tight` of [chapter 11](11_tiles.ipynb). What one of them
# costs is counted by `benchmarks/kernel_operations.py` in the source of the innermost loops: additions, products, both
# fused, minima, comparisons and selections. Each is one vector instruction, for as many pixels as a vector has lanes;
# loads and stores are left out. The rate is that of independent fused multiply-adds, measured.

# %%
g = final.trainer.gaussians
arrays = [a.detach().double().numpy() for a in (g.means, cov3d_t(g.log_scales, g.quats), g.opacities)]
order, means2d, cov2d = project(view.camera, *arrays[:2], Z_NEAR, final.options.config.jacobian_limit)
drawn = from_cov2d(means2d, cov2d, np.zeros((len(order), 3)), arrays[2][order], view.image.shape[:2])
counts = tight(drawn).counts
print(f"{counts.pairs} pairs by the rung, {pairs} by the kernels; {counts.mattered} pixels above the floor")
assert abs(counts.pairs / pairs - 1) < 0.05

lanes = {"v4": 16, "v3": 8}.get(_native.isa(), 4)
peak = torch.get_num_threads() * lanes * max(_native.fma_rate() for _ in range(9))
print(f"peak: {peak / 1e9:.0f} thousand million operations a second, {lanes} lanes a vector")
for name in ("composite", "composite_backward"):
    each = operations(name, lanes)
    share = counts.mattered * each / (1e-3 * iteration[name]) / peak
    print(f"{name:18} {1e6 * iteration[name] / pairs:6.1f} ns a pair,", end=" ")
    print(f"{each} operations a pixel, {100 * share:5.1f} % of the peak")

# %% [markdown]
# The share counts what is useful: lanes outside the ellipse are lost, and what is done once per pair is not counted.
#
# ## The next failure
#
# The first failure is in every scene: it is right where a camera stood. Here is a view from higher up than any photo.
# The fog is the sky of the photos, seen from behind.

# %%
above = garden_camera(0.4, 1.0, frame_size)
R, eye = above.R @ fit.R, (above.eye - fit.t) @ fit.R / fit.s
shown = picture(final, Camera(R, eye, focal, focal, above.cx, above.cy, above.H, above.W))
real = photograph_garden(above).image
print(f"from above: {psnr(shown / 255, real):.2f} dB, held out along the walk: {test['psnr']:.2f} dB")
assert psnr(shown / 255, real) < test["psnr"] - 1
gallery("higher up than any photo", {"render": shown, "what is there": real}, 1, 4.8)

held = 16 * sum(
    tensor[0].numel() for tensor in g.tensors().values()
)  # bytes: its numbers, their gradients and two moments
print(f"{held} bytes a Gaussian while it trains: ten million take {held / 100:.1f} GB")
shutil.rmtree(WORK)

# %% [markdown]
# The others are of one kind: the model absorbs what it has no parameters for into the parameters it has.
#
# - **What moves, what mirrors.** A scene has one state: people become fog, a reflection a room behind the wall.
# - **Light.** A cloud or a lamp that is switched on changes each wall in its own way, which one gain cannot follow.
# - **Scenes larger than memory.** All Gaussians are held at once, in the bytes printed above.
#
# With photos of your own: `gsplat-edu sfm PHOTOS CAPTURE` finds the poses, `gsplat-edu doctor CAPTURE` says what is
# wrong with them and how long a training takes, `gsplat-edu train CAPTURE --out RUN` trains by our
# [fast recipe](../docs/RECIPE.md), and `gsplat-edu view RUN` shows the scene. [Chapter 15](15_cloud_to_surface.ipynb)
# asks where its walls are.
