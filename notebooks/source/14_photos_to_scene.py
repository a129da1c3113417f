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
# The photos of this page are taken of a box with painted sides on a painted floor
# ([gsplat_edu.data.textured_box](../src/gsplat_edu/data/textured_box.py)). OpenCV draws them, not a splat of ours,
# and the places they were taken from are put away until there is something to compare with them.

# %%
import functools
import itertools
import json
import os
import shutil
import sqlite3
import sys
import tempfile
import time
import timeit
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib_inline.backend_inline import set_matplotlib_formats

from gsplat_edu import Z_NEAR, Camera, _native
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.textured_box import align_cameras, box_camera, photograph_box
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.doctor.before import examine
from gsplat_edu.doctor.finding import advice_lines, diagnosis_lines
from gsplat_edu.doctor.survey import prepare
from gsplat_edu.evaluate.metrics import psnr, summarize, to_bytes
from gsplat_edu.render.numpy_reference import project
from gsplat_edu.runs.training import CaptureRun, RunOptions
from gsplat_edu.scene.gaussians import cov3d_t
from gsplat_edu.scene.views import View
from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from gsplat_edu.train.config import recipe

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "benchmarks" / "ladder").is_dir())
sys.path.append(str(ROOT / "benchmarks"))
from ladder.forward import tight
from ladder.splats import from_cov2d
from train_step import measure

JPEG = functools.partial(set_matplotlib_formats, "jpeg", pil_kwargs={"quality": 75})
SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
COUNT, WIDTH, ITERATIONS = (25, 320, 500) if SHORT else (41, 480, 3000)
WORK = Path(tempfile.mkdtemp())
JPEG()  # photos of noise are large as PNG
print(f"budget: {COUNT} photos, {WIDTH} px, {ITERATIONS} iterations{' (reduced)' if SHORT else ''}")

# %% [markdown]
# ## Photos, and nothing else
#
# Somebody walks around the box once, in steps that are not even, and holds the phone now higher and now lower. One
# photo is shaken.

# %%
rng = np.random.default_rng(13)
walk = 2 * np.pi * (np.arange(COUNT) + rng.uniform(-0.3, 0.3, COUNT)) / COUNT
heights = 0.45 + 0.15 * np.sin(3 * walk) + rng.uniform(-0.05, 0.05, COUNT)
names = [f"IMG_{i:02d}.png" for i in range(COUNT)]
frame_size, shaken = (WIDTH, 3 * WIDTH // 4), names[5]
truth = {n: box_camera(a, h, frame_size) for n, a, h in zip(names, walk, heights, strict=True)}
photos = {name: photograph_box(camera) for name, camera in truth.items()}
streak = WIDTH // 64  # px that the hand moved while the shutter was open
photos[shaken] = cv2.blur(photos[shaken], (streak, 1))
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
# The obvious thing is to guess. The walk was about a circle, the steps were about even, the phone was held about so
# high, and the lens is known. The guess becomes a capture with random points where the box must be, and
# [gsplat_edu.runs.training](../src/gsplat_edu/runs/training.py) trains on it: what `gsplat-edu train` calls.


# %%
def trained(data, out, iterations, strategy="adc", appearance="none", **reading):
    config = recipe(iterations, strategy=strategy, appearance=appearance, max_gaussians=20_000)
    options = RunOptions(WORK / data, WORK / out, config, DataSettings(**reading), eval_every=0, save_every=0)
    before = time.perf_counter()
    job = CaptureRun(options)
    loaded = time.perf_counter() - before
    job.train()
    before = time.perf_counter()
    scores = job.finish()
    return job, {"reading": loaded, "training": job.seconds, "judging": time.perf_counter() - before}, scores


def picture(job, camera):
    with torch.no_grad():
        return to_bytes(job.options.renderer(job.trainer.gaussians, camera).image)


even = 2 * np.pi * np.arange(COUNT) / COUNT
guess = {name: box_camera(a, 0.45, frame_size) for name, a in zip(names, even, strict=True)}
cloud = rng.uniform([-2, -1.5, -2], [2, 0, 2], (4000, 3))
views = [View(guess[name], photos[name], name=name) for name in names]
write_colmap(WORK / "guess", views, cloud, np.full(cloud.shape, 0.5))
BRIEFLY, SIDE_PX = 300, 160
mush, _, scores = trained("guess", "mush", BRIEFLY, resolution=SIDE_PX)
mushy, seen = (summarize(part)["psnr"] for part in (scores.test, scores.train))
print(f"guessed poses, {BRIEFLY} iterations at {SIDE_PX} px: {mushy:.2f} dB held out, {seen:.2f} dB seen")
shown = {}
for v in mush.dataset.test[:2]:
    shown |= {f"render, {v.name}": picture(mush, v.camera), f"photo, {v.name}": v.image}
gallery("trained on guessed poses: every photo contradicts the next", shown)

# %% [markdown]
# A few degrees around the box move its corners by many pixels, and each photo is off by another amount. The cameras
# have to be found, and the only thing to find them with is the photos.
#
# ## What two photos say about each other
#
# A point of the scene lies on a ray through each photo that shows it. Let $x_1 = ((u_1 - c_x)/f, (v_1 - c_y)/f, 1)$
# be its direction in the first camera and $x_2$ that in the second, and let the second camera see the first one's
# coordinates through $R$ and $t$: $z_2 x_2 = R\, z_1 x_1 + t$. Cross with $t$, then take the product with $x_2$. Both
# $t$ and the left side fall out, and so do the unknown depths:
#
# $$ x_2^\top [t]_\times R\, x_1 = 0 . $$
#
# One equation per match, linear in the nine numbers of $E = [t]_\times R$, and true only for the right motion. The
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
# What the stages saw is kept in a database: the features of each photo, and the matches of two.
reader = sqlite3.connect(f"{(WORK / 'capture/sfm/database.db').as_uri()}?mode=ro", uri=True)
number = {name: i + 1 for i, name in enumerate(names)}


def matrix_from(dtype, table, key, value):
    query = f"SELECT rows, cols, data FROM {table} WHERE {key} = ?"
    rows, cols, data = reader.execute(query, (value,)).fetchone()
    return np.frombuffer(data or b"", dtype).reshape(rows, cols)


def matched(*pair):
    """Return where two photos match, px; COLMAP has the first pixel's centre at (0.5, 0.5)."""
    i, j = (number[name] for name in pair)
    chosen = matrix_from(np.uint32, "two_view_geometries", "pair_id", (2**31 - 1) * i + j).T
    points = (matrix_from(np.float32, "keypoints", "image_id", k) for k in (i, j))
    return [xy[rows, :2] - 0.5 for xy, rows in zip(points, chosen, strict=True)]


points, (a, b) = matrix_from(np.float32, "keypoints", "image_id", number[one]), matched(one, two)
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
for what, distances in off.items():
    print(f"{what}: half of {len(distances)} matches lie within {np.median(distances):.2f} px of their line")
assert np.median(off["found"]) < 1 < np.median(off["guess"])

# %% [markdown]
# ## Found, up to a similarity
#
# Photos know no north and no metre. Turn, move and enlarge the whole world, cameras and all, and every photo stays as
# it is. So poses are compared with the truth after the similarity $x' = s R x + t$ that brings the centres closest
# (Umeyama 1991).
#
# The size of the remaining error can be predicted. A lens of $f$ pixels sees a pixel as $1/f$ radians, and from the
# distance $4$ a pixel is $4/f$ world units. Features are better than a pixel, but focal length and distortion are
# found from the same few photos and take up some of the poses: two pixels' worth is allowed, of angle and of place.

# %%
fit = align_cameras(found, truth)
eyes = np.stack([truth[name].eye for name in found])
allowed = 2 * 4 / focal / np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max()
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
# Now the recipe of Kerbl et al. 2023 (`gsplat-edu train --strategy adc`), from the points that were triangulated,
# every eighth photo held out: the loss is $0.8\,L_1 + 0.2\,(1 - \mathrm{SSIM})$, where
# [SSIM](../docs/GLOSSARY.md#ssim) (Wang et al. 2004) is 1 if two photos agree in mean, contrast and pattern around
# every pixel: $L_1$ alone forgives blur. Harmonics rise by degrees, splats are cloned and split. The field compares
# the mean peak signal-to-noise ratio of held-out photos, $10 \log_{10}(1/\mathrm{MSE})$ in decibels
# ([gsplat_edu.evaluate.metrics](../src/gsplat_edu/evaluate/metrics.py)): 3 dB are half the squared error. Held
# against the guess, the first line below credits the poses with their points as well: the guess had to begin with
# random ones.

# %%
posed = summarize(trained("capture", "small", BRIEFLY, resolution=SIDE_PX)[2].test)["psnr"]
print(f"{BRIEFLY} iterations at {SIDE_PX} px: {posed:.2f} dB held out, on guessed poses {mushy:.2f} dB")
assert posed > mushy + 1
final, seconds, scores = trained("capture", "scene", ITERATIONS)
test, train = summarize(scores.test), summarize(scores.train)
print(
    f"{ITERATIONS} iterations, {len(final.trainer.gaussians)} Gaussians, {len(scores.test)} photos held out"
)
print(f"held out: PSNR {test['psnr']:.2f} dB, SSIM {test['ssim']:.3f}; seen: PSNR {train['psnr']:.2f} dB")
assert test["psnr"] > (17 if SHORT else 22)

view = final.dataset.test[len(final.dataset.test) // 2]
image = picture(final, view.camera)
error = np.minimum(3 * np.abs(image.astype(int) - view.image), 255)
panels = {"render": image, "photo": view.image, "difference, times 3": error}
gallery(f"{view.name}, which was held out", panels, height=3.6)

# %% [markdown]
# Those were the steps of 2023. `gsplat-edu train` takes others unless asked: photos of a quarter of their width at
# first, where a step is cheap and only coarse structure is to be learned; splits of the splats with the largest
# gradients, up to a planned number; a small weight on opacity, so that what no photo needs fades; rates twice as high,
# which fall to the end. [RECIPE.md](../docs/RECIPE.md) says where each piece comes from. A third of the steps will do:

# %%
steps = ITERATIONS if SHORT else ITERATIONS // 3
quick, spent, judged = trained("capture", "quick", steps, "fast")
faster, share = summarize(judged.test)["psnr"], spent["training"] / seconds["training"]
print(f"{steps} iterations, {share:.2f} of the time: {faster:.2f} dB held out,", end=" ")
print(f"{len(quick.trainer.gaussians)} Gaussians")
assert faster > test["psnr"] - 1

# %% [markdown]
# ## When the phone decides
#
# These photos agree about the colour of every wall. Those of a phone left on automatic do not: it sets exposure and
# white balance anew for each photo. Here every photo is made up to 0.7 stops brighter or darker, and its red and blue
# change a little. A stop doubles the light, and a pixel's value is about the light to the power of 1/2.2.
#
# > **Predict.** A scene is trained on these photos as if they agreed. Where do you look for the damage first: at the
# > edges of the box, on its painted sides, or on the plain wall behind it?

# %%
shutil.copytree(WORK / "capture", WORK / "automatic")
for path in sorted((WORK / "automatic/images").iterdir()):
    light = rng.uniform(-0.7, 0.7) + rng.uniform(-0.2, 0.2, 3) * (1, 0, 1)  # stops of blue, green and red
    changed = cv2.imread(str(path)) * 2 ** (light / 2.2)
    cv2.imwrite(str(path), np.clip(np.round(changed), 0, 255).astype(np.uint8))

wavering = {}
for appearance in ("none", "exposure"):
    job, _, scores = trained("automatic", appearance, 2 * BRIEFLY, "fast", appearance, resolution=SIDE_PX)
    wavering[appearance] = job, summarize(scores.test)["psnr_fitted"]
    print(f"appearance {appearance}: {wavering[appearance][1]:.2f} dB held out, exposure fitted")
assert wavering["exposure"][1] > wavering["none"][1]

held_out = wavering["none"][0].dataset.test[1]
shown = {f"render, {name}": picture(job, held_out.camera) for name, (job, _) in wavering.items()}
gallery(f"{held_out.name}, held out", shown | {"photo": held_out.image}, height=3.6)

# %% [markdown]
# The plain wall behind the box shows it best: it has lighter and darker patches if nothing is done. With
# `--appearance exposure`, each photo has one gain per channel, measured whenever it is drawn: the median of photo
# over render. The render is multiplied by it before the loss compares the two, so that the scene need not change its
# colour with the viewpoint. The gains of all photos have the geometric mean 1: otherwise a scene half as bright with
# gains twice as large would be as good.
#
# A held-out photo has no gain. It is measured on the left half, and the right half is scored: that is "exposure
# fitted". `gsplat-edu train` looks at the photos and chooses by itself. Other faults have their own remedies:
# `--refine` for poses that are a little off, `--transients` for passers-by, `--sky` for what is at infinity, and
# `gsplat-edu clean` for floaters. [GUIDE.md](../docs/GUIDE.md) shows what they do.
#
# ## Where the time went
#
# Poses are paid for once; training is what a budget decides. `benchmarks/train_step.py` takes its iteration apart, here
# on the trained scene: each row is a median of its own, so on a busy machine they need not add up to the whole.

# %%
done = json.loads((WORK / "capture/sfm/stages.json").read_text())["stages"]
table = {name: done[name]["facts"]["seconds"] for name in ("features", "matches", "mapping")}
table |= {"undistortion": done["capture"]["facts"]["seconds"]} | seconds
iteration = measure(final.trainer.gaussians, [view], 10 if SHORT else 40)
pairs = round(iteration.pop("pairs"))
for unit, parts, whole in (("s ", table, sum(table.values())), ("ms", iteration, iteration["iteration"])):
    for name, value in parts.items():
        print(f"{name:18} {value:8.3f} {unit} {100 * value / whole:5.1f} %")

# %% [markdown]
# ## How far from the machine's limits
#
# A kernel that is bound by arithmetic is no faster than its operations over the machine's rate of them. At how many
# pixels a splat is above the floor is counted by the rung `tight` of [chapter 11](11_tiles.ipynb). What one of them
# costs is counted by hand: in `native/composite.cpp` 2 operations for the exponent, 10 for its power of two, 3 for
# the colour and 4 around them, 19 in all; in `native/composite_backward.cpp` 35. They are vector instructions that
# compute, each for as many pixels as a vector has lanes; loads and stores are left out. The rate is that of
# independent fused multiply-adds, measured. Adam does little with many numbers, so beside it stands the rate at which
# one thread goes through memory in a plain sum of two arrays; Adam has all threads.

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
for name, each in (("composite", 19), ("composite_backward", 35)):
    share = counts.mattered * each / (1e-3 * iteration[name]) / peak
    print(f"{name:18} {1e6 * iteration[name] / pairs:6.1f} ns a pair, {100 * share:5.1f} % of the peak")

numbers_each = sum(tensor.numel() for tensor in g.tensors().values()) // len(g)
moved = 4 * 7 * numbers_each * len(g)  # bytes: four arrays are read, three written
print(f"Adam moves {moved / 1e6:.1f} MB, {moved / iteration['Adam'] / 1e6:.1f} GB/s")
for what, count in (("as many", moved // 12), ("30 million", 30_000_000)):
    a, b, c = np.ones((3, count), np.float32)
    rate = 12e-9 * count / min(timeit.repeat(lambda a=a, b=b, c=c: np.add(a, b, out=c), number=1, repeat=12))
    print(f"a sum of two arrays of {what} numbers: {rate:.1f} GB/s")

# %% [markdown]
# The share counts what is useful: lanes outside the ellipse are lost, and what is done once per pair is not counted.
# Where arrays fit into the caches, the rate is theirs.
#
# ## The next failure
#
# There is no next chapter, but failures remain. The first is in every scene: it is right where a camera stood. Here
# is a view from higher up than any photo. Part of what it loses is only that no plain sky is in it, which is easy.

# %%
above = box_camera(0.4, 1.25, frame_size)
R, eye = above.R @ fit.R, (above.eye - fit.t) @ fit.R / fit.s
shown = picture(final, Camera(R, eye, focal, focal, above.cx, above.cy, above.H, above.W))
real = photograph_box(above)
print(f"from above: {psnr(shown / 255, real):.2f} dB, held out along the walk: {test['psnr']:.2f} dB")
assert psnr(shown / 255, real) < test["psnr"] - 1
gallery("higher up than any photo", {"render": shown, "what is there": real}, 1, 4.8)

held = 16 * numbers_each  # bytes: its numbers, their gradients and two moments
print(f"{held} bytes a Gaussian while it trains: ten million take {held / 100:.1f} GB")
shutil.rmtree(WORK)

# %% [markdown]
# The others are of one kind: the model absorbs what it has no parameters for into the parameters it has.
#
# - **What moves, what mirrors.** A scene has one state: people become fog, a reflection a room behind the wall.
# - **Light.** Exposure has its gain, but a cloud or a lamp that is switched on changes each wall in its own way. The
#   colour that depends on the direction takes up the difference.
# - **Scenes larger than memory.** All Gaussians are held at once, in the bytes printed above.
#
# With photos of your own: `gsplat-edu sfm PHOTOS CAPTURE` finds the poses, `gsplat-edu doctor CAPTURE` says what is
# wrong with them and how long a training takes, `gsplat-edu train CAPTURE --out RUN` trains by our
# [fast recipe](../docs/RECIPE.md), and `gsplat-edu view RUN` shows the scene. It began with [a point](01_points.ipynb).
