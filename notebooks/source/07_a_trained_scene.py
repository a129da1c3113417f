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
# # 07 - A trained scene
#
# The description of a splat is complete: 59 numbers. What is missing is anything to put into them. So far every number
# came out of a formula, because a sphere has one. Without a formula, one can guess:

# %%
import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.colors import PowerNorm

from gsplat_edu import C0, Camera, build_cov3d_batch, eval_sh, render_gaussians
from gsplat_edu.base.constants import POINT_SUFFIXES
from gsplat_edu.cli.sphere import Budget, SphereOptions, run_sphere
from gsplat_edu.data.synthetic import sphere_capture
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.io.axes import half_turned
from gsplat_edu.io.formats import FORMATS, read_scene, stored_bytes, write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.api import render
from gsplat_edu.scene.gaussians import Gaussians

SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
budget = Budget(iters=300, cap=800, size=64) if SHORT else Budget(iters=800, cap=1600, size=128)
print(f"budget: {budget.iters} iterations, {budget.size} px{' (reduced)' if SHORT else ''}")


def guessed(count, coefficients, generator):
    """Gaussians whose numbers are all drawn at random, with so many coefficients per channel behind the first."""
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "sh0": (1, 3), "sh_rest": (coefficients, 3)}
    shapes["logit_opacities"] = ()
    draws = {key: torch.randn(count, *shape, generator=generator) for key, shape in shapes.items()}
    return Gaussians(**draws | {"log_scales": 0.5 * draws["log_scales"] - 2.5})


generator = torch.Generator().manual_seed(7)
capture = sphere_capture(budget.size)
noise = guessed(1600, 15, generator)
each = sum(values[0].numel() for values in noise.tensors().values())
print(f"{each} numbers a splat, {len(noise) * each:,} in all, every one a guess")
assert each == 59


def show_images(axes, images):
    for ax, (title, image) in zip(axes, images.items(), strict=False):
        ax.imshow(np.clip(image, 0, 1), interpolation="nearest")
        ax.set(title=title, xticks=[], yticks=[])


fig, axes = plt.subplots(1, 4, figsize=(12, 3.4), layout="constrained")
cameras = {f"guessed, camera {i}": capture.train[i].camera for i in (8, 10, 12, 14)}
show_images(axes, {title: render(noise, camera).image for title, camera in cameras.items()})
plt.show()

# %% [markdown]
# Random numbers in, noise out, from every side. Guessing again will not help: of all the settings of so many numbers,
# those that show anything are as good as none.
#
# ## A file that somebody trained
#
# `gsplat-edu demo` finds such a setting. It is shown renders of a sphere, moves the numbers of a random cloud until
# its own renders look like them, and writes them down. How it knows where to move them is the question this page ends
# on. Here it is run unchanged, for the file that it writes.

# %%
scratch = tempfile.TemporaryDirectory()
folder = Path(scratch.name)
run_sphere(
    SphereOptions(budget, k0=400, seed=9, backend="cpu", out=folder / "sphere.png"),
    say=lambda line: print(line.replace(f"{folder}/", "")),
)
path = folder / "sphere.ply"
content = path.read_bytes()
header = content[: content.index(b"end_header\n") + len(b"end_header\n")]
print(f"\n{len(content):,} bytes, of which {len(header)} are text:\n\n{header.decode('ascii')}")

# %% [markdown]
# A PLY begins by saying what it holds: so many vertices, and of each these properties, in this order, each a float of
# four bytes. Behind the last line of text the numbers follow, splat after splat, with nothing in between. That is a
# table, and NumPy has a type for tables whose columns have names.


# %%
def read_by_hand(path):
    """The vertices of a binary little-endian PLY whose properties are all floats, as a structured array."""
    text, _, body = path.read_bytes().partition(b"end_header\n")
    words = [line.split() for line in text.decode("ascii").splitlines()]
    (count,) = (int(line[2]) for line in words if line[:2] == ["element", "vertex"])
    names = [line[2] for line in words if line[0] == "property"]
    return np.frombuffer(body, dtype=[(name, "<f4") for name in names], count=count)


def columns(table, *names):
    return np.stack([table[name] for name in names], axis=-1)


table = read_by_hand(path)
assert len(content) == len(header) + table.nbytes, "nothing is left over"
scene = read_scene(path)
trained = scene.gaussians
by_hand = {
    "means": columns(table, "x", "y", "z"),
    "sh0": columns(table, "f_dc_0", "f_dc_1", "f_dc_2")[:, None],
    "log_scales": columns(table, "scale_0", "scale_1", "scale_2"),
    "quats": columns(table, "rot_0", "rot_1", "rot_2", "rot_3"),
    "logit_opacities": table["opacity"],
}
for key, values in by_hand.items():
    assert np.array_equal(values, trained.tensors()[key].numpy()), key
    print(f"{key:>15}: from {values.min():7.3f} to {values.max():6.3f}, median {np.median(values):6.3f}")

# %% [markdown]
# To the bit what [gsplat_edu.io.ply](../src/gsplat_edu/io/ply.py) reads, which also takes other orders of the
# properties, other types and ASCII, and finds damage. It goes by the names alone.
#
# But look at the numbers. Scales below zero. Opacities far above 1 and below 0. These are not the numbers that are
# drawn.
#
# ## What happens when one forgets
#
# The file holds what was trained: [*raw* values](../docs/GLOSSARY.md#raw-value). Each passes through a function of
# its own before it is drawn. Nothing in the file says so, and a reader that forgets one of them gets a picture all
# the same:
#
# > **Predict.** Four readers forget one function each: that of scales, of opacities, of colours, of quaternions.
# > Which mistake do you see at once, and which would you pass on?

# %%
held_out = capture.held_out.camera


def unit(q):
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def rotations_by_hand(q):
    """The matrices of quaternions that are taken to have length 1."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def drawn(scale=np.exp, opacity=lambda x: 1 / (1 + np.exp(-x)), quat=unit, colour=lambda f: C0 * f + 0.5):
    """The trained scene, each activation a choice; opacities are cut to what a renderer takes."""
    raw = {key: values.astype(np.float64) for key, values in by_hand.items()}
    covariances = build_cov3d_batch(np.abs(scale(raw["log_scales"])), rotations_by_hand(quat(raw["quats"])))
    colours = np.maximum(colour(raw["sh0"][:, 0]), 0)
    faint_to_full = np.clip(opacity(raw["logit_opacities"]), 0, 1)
    splats = (raw["means"], covariances, colours, faint_to_full)
    return render_gaussians(held_out, *splats, extent="exact", stop="tile")[0]


complete = drawn()
forgotten = {
    "nothing forgotten": complete,
    "scales as stored": drawn(scale=np.asarray),
    "opacities as stored": drawn(opacity=np.asarray),
    "colours as stored": drawn(colour=np.asarray),
    "quaternions as stored": drawn(quat=np.asarray),
}
fig, axes = plt.subplots(2, 5, figsize=(14, 5.8), layout="constrained")
show_images(axes[0], forgotten)
for ax, (title, image) in zip(axes[1], forgotten.items(), strict=True):
    wrong = np.abs(np.clip(image, 0, 1) - np.clip(complete, 0, 1)).max(axis=2)
    bar = ax.imshow(wrong, norm=PowerNorm(0.4, 0, 1), cmap="magma", interpolation="nearest")
    ax.set(title=f"off by up to {wrong.max():.2f}", xticks=[], yticks=[])
    print(f"{title:>21}: {psnr(image, np.clip(complete, 0, 1)):5.1f} dB, worst channel {wrong.max():.2f}")
    assert title == "nothing forgotten" or wrong.max() > 0.02
ticks = (0, 0.02, 0.1, 0.3, 0.6, 1)  # the scale is stretched towards zero
fig.colorbar(bar, ax=axes[1], label="largest error of a channel", ticks=ticks, format="%g")
plt.show()

# %% [markdown]
# The loudest mistake is the least dangerous. A logarithm around $-3$ taken as a length, its sign lost in a square, is
# as large as the scene, and there is fog. Colours as stored lack a factor and an offset, and it is another sphere. The
# other two are the kind that is passed on. Opacities as stored drop every splat below one half and make most others
# solid; here the solid ones cover the rest, and it hardly shows. A quaternion that is not of length 1 is no rotation:
# a short one turns too little and shrinks across its axis, and the rim frays. It looks like a fault of the training.
#
# ## Why not store what is drawn
#
# Because an optimiser adds. It adds a small number, of either sign, to every parameter, thousands of times, and knows
# of no fences. A scale has to stay above zero. Cutting it off at a bound has no slope beyond the bound, so what has
# once gone over never comes back. We need a function from all numbers to the positive ones, and one more requirement
# selects it: equal steps should be equal factors, since ten per cent matter as much for a pebble as for a house. With
# $f(x + h) = k(h) f(x)$ for all $x$, the slope is $f' = k'(0) f$, and that leaves the exponential.
#
# $$s = e^{x}, \qquad \frac{\partial s}{\partial x} = s$$
#
# An opacity has two fences, 0 and 1. Its odds $o / (1 - o)$ have only one again, and the same wish makes them an
# exponential:
#
# $$\frac{o}{1 - o} = e^{\ell} \quad\Rightarrow\quad o = \frac{1}{1 + e^{-\ell}}, \qquad
# \frac{\partial o}{\partial \ell} = o\,(1 - o)$$
#
# A quaternion needs no function of its own, only its length divided out, and a degree-0 colour is a harmonic:
# $c = C_0 f + 1/2$. The slopes above are checked by central differences with step $h = \epsilon^{1/3}$: third
# derivatives of a function no larger than its own value $f$ put them off by $h^2 f / 6$, rounding by $\epsilon f / h$,
# so $2 \epsilon^{2/3}$ of the value is enough.

# %%
h, tolerance = np.finfo(float).eps ** (1 / 3), 2 * np.finfo(float).eps ** (2 / 3)
s, logits = np.exp(by_hand["log_scales"].astype(float)), by_hand["logit_opacities"].astype(float)
o = 1 / (1 + np.exp(-logits))
measured = (1 / (1 + np.exp(-logits - h)) - 1 / (1 + np.exp(-logits + h))) / (2 * h)
assert np.all(np.abs((s * np.exp(h) - s * np.exp(-h)) / (2 * h) - s) < tolerance * s)
assert np.all(np.abs(measured - o * (1 - o)) < tolerance * o)
assert np.allclose(s, trained.scales.numpy(), rtol=4 * np.finfo(np.float32).eps, atol=0)
assert np.allclose(o, trained.opacities.numpy(), rtol=8 * np.finfo(np.float32).eps, atol=0)

lengths = np.linalg.norm(by_hand["quats"], axis=1)
panels = {
    ("stored", "logarithm of a scale"): np.log(s).ravel(),
    ("stored", "logit of an opacity"): logits,
    ("stored", "length of a quaternion"): lengths,
    ("drawn", "scale, world units"): s.ravel(),
    ("drawn", "opacity"): o,
    ("drawn", "length of a quaternion, divided out"): np.linalg.norm(unit(by_hand["quats"]), axis=1),
}
fig, axes = plt.subplots(2, 3, figsize=(12, 5), layout="constrained")
for ax, ((title, label), values) in zip(axes.flat, panels.items(), strict=True):
    ax.hist(values, bins=40, range=(0.6, 1.2) if "length" in label else None)
    ax.set(title=title, xlabel=label, ylabel="splats" if values.size == len(table) else "axes of splats")
plt.show()
print(f"lengths of quaternions from {lengths.min():.3f} to {lengths.max():.3f}")
print(f"scales from {s.min():.4f} to {s.max():.3f}, opacities above one half: {100 * np.mean(o > 0.5):.0f} %")

# %% [markdown]
# Stored, the numbers are spread out, and a step finds room on either side. As they are drawn they are crowded: scales
# towards zero, opacities against both fences, where a parameter that was cut off would have stuck. Nothing pulls the
# length of a quaternion anywhere, because nothing shows it, so it drifts.
# [gsplat_edu.scene.gaussians](../src/gsplat_edu/scene/gaussians.py) keeps the raw values and has the others as
# properties; a name says which it is, `log_` or `logit_` or neither, and no function takes both.
#
# ## The same picture twice
#
# If all of that is right, the renderer of chapter 05, fed by hand in double precision, and `render`, fed with the
# file, have to draw the same thing, up to the single precision of the latter. How far is that? The exponent of a
# visible splat is at most $\ln 255 < 6$ and some 20 roundings of half an $\epsilon$ go into it: at most $60\,\epsilon$
# of an alpha. Weights add up to 1, so it is no more in a pixel; as much again comes in through the transmittance, and
# colours are about 1. Together $120\,\epsilon$. One thing can break it: an alpha that rounds to the other side of the
# floor is lost whole. That takes a coincidence to one part in a million, so it is allowed to one pixel in a thousand.

# %%
by_kernels = render(trained, held_out, backend="cpu").image.numpy()
gap, eps = np.abs(by_kernels - complete).max(axis=2), np.finfo(np.float32).eps
print(
    f"largest gap {gap.max() / eps:.0f} eps = {gap.max():.1e}; pixels beyond 120 eps: {np.sum(gap > 120 * eps)}"
)
assert np.mean(gap > 120 * eps) < 1e-3 and gap.max() < 1 / 255

# %% [markdown]
# ## Which way is up
#
# The file has coordinates, and no axes. Here $+y$ is down; half of the programs that will open the file have $+y$ up
# and look along $-z$. Between the two lies half a turn about $x$: $y$ and $z$ change their signs. A reader that turns
# the means and leaves it at that has every splat in its place and facing the wrong way, because the quaternions turn
# things in the same axes: $q' = i\, q\, i^*$, which changes two signs of $q$ as well. Turn both, and the camera with
# them, and not a bit of the picture may change.

# %%
flip = np.array([1.0, -1.0, -1.0])
lens = (held_out.fx, held_out.fy, held_out.cx, held_out.cy, budget.size, budget.size)
turned_camera = Camera(held_out.R * flip, held_out.eye * flip, *lens)
both = half_turned(trained)
torn = Gaussians(**trained.tensors() | {"means": trained.means * torch.tensor(flip, dtype=torch.float32)})
images = {
    "our axes": by_kernels,
    "means turned, quaternions not": render(torn, turned_camera, backend="cpu").image.numpy(),
    "both turned": render(both, turned_camera, backend="cpu").image.numpy(),
}
assert np.array_equal(images["both turned"], by_kernels)
assert np.abs(images["means turned, quaternions not"] - by_kernels).max() > 0.1

fig, axes = plt.subplots(1, 3, figsize=(9, 3.3), layout="constrained")
show_images(axes, images)
plt.show()

# %% [markdown]
# ## Forty-five numbers in the wrong order
#
# The sphere looks the same from everywhere, so its file stops at degree 0. A scene with harmonics has 45 more
# properties, `f_rest_0` to `f_rest_44`: fifteen coefficients of three channels. In memory they are (15, 3), a
# coefficient at a time. In the file they are a channel at a time, all fifteen of red first. Nothing but custom says
# so, and both are 45 floats. A scene of nine splats shows what becomes of the other reading.

# %%
lattice = torch.cartesian_prod(*[torch.linspace(-0.6, 0.6, 3)] * 2)
nine_splats = guessed(9, 15, generator).tensors() | {
    "means": torch.cat([lattice, torch.zeros(9, 1)], dim=1),
    "log_scales": torch.full((9, 3), -2.0),
    "logit_opacities": torch.full((9,), 6.0),
}
nine_splats["sh_rest"] *= 0.4
write_scene(folder / "nine.ply", Scene(Gaussians(**nine_splats)))
nine = read_by_hand(folder / "nine.ply")
rest = columns(nine, *(f"f_rest_{i}" for i in range(45)))
readings = {"by channel": rest.reshape(9, 3, 15).swapaxes(1, 2), "by triple": rest.reshape(9, 15, 3)}
package_says = read_scene(folder / "nine.ply").gaussians.sh_rest.numpy()
for expected in (package_says, nine_splats["sh_rest"].numpy()):
    assert np.array_equal(readings["by channel"], expected)

pictures, fx = {}, 1.1 * budget.size
for eye, side in ((-1, "left"), (1, "right")):
    camera = Camera.looking_at((eye, 0, -3), (0, 0, 0), fx, fx, budget.size, budget.size)
    for key, values in readings.items():
        image = render(Gaussians(**nine_splats | {"sh_rest": torch.tensor(values)}), camera).image
        truth = " (the scene)" if key == "by channel" else ""
        pictures[f"{key}{truth}, from the {side}"] = image.numpy()
fig, axes = plt.subplots(1, 4, figsize=(12, 3.4), layout="constrained")
show_images(axes, pictures)
plt.show()

dirs = unit(nine_splats["means"].numpy() - np.array([-1.0, 0, -3]))
sh0 = nine_splats["sh0"].numpy()
seen = {key: eval_sh(3, np.concatenate([sh0, values], axis=1), dirs) for key, values in readings.items()}
wrong = np.abs(seen["by channel"] - seen["by triple"])
print(f"colours from the left: off by {wrong.mean():.2f} in the mean, {wrong.max():.2f} at most")
assert wrong.mean() > 0.1

# %% [markdown]
# Neither reading looks broken. Only who knows the scene sees that one of them is.
#
# ## What it weighs
#
# A row of the sphere's file is 17 floats, three of which are normals that have been zero in every file since the first
# program wrote them. With harmonics it is 62. Other formats hold the same [scene](../src/gsplat_edu/io/scene.py) and
# pay less, with bits. What a bit is worth is not for the file to say but for the picture, so each file is read again
# and drawn, and scored against the scene that was written.

# %%
print(f"{'file':>14}  {'bytes':>7}  per splat  PSNR against the .ply")
kept = {}
for found in FORMATS:
    if found.suffix in POINT_SUFFIXES:
        continue  # points for surveyors, which nothing reads as a scene
    written = folder / f"again{found.suffix}"
    write_scene(written, scene)
    image = render(read_scene(written).gaussians, held_out, backend="cpu").image.numpy()
    kept[found.suffix], size_now = psnr(image, np.clip(by_kernels, 0, 1)), stored_bytes(written)
    print(f"{found.suffix:>14}  {size_now:7,}  {size_now / len(trained):9.1f}  {kept[found.suffix]:.1f} dB")
scratch.cleanup()
trained_to = psnr(by_kernels, capture.held_out.image)
print(f"for comparison, what was trained against the photo: {trained_to:.1f} dB")
assert table.dtype.itemsize == 4 * 17 and nine.dtype.itemsize == 4 * 62
assert kept[".ply"] == 100 and min(kept.values()) > trained_to + 15

# %% [markdown]
# 100 dB stands for no difference at all. Even the smallest files lose far less than the training left open.
#
# ## The next failure
#
# The numbers work, and can be read, and passed on. They came from an optimiser that was shown pixels. But what does a
# pixel know of a logarithm? Take one splat, make it half as large again, and look at what changes.

# %%
_, _, z = held_out.project(held_out.world_to_cam(by_hand["means"]))
index = int(np.argmin(np.where((o > 0.9) & (np.median(s, axis=1) < 0.06), z, np.inf)))  # in front, small
larger = trained.log_scales.clone()
larger[index] += np.log(1.5)
changed = Gaussians(**trained.tensors() | {"log_scales": larger})
nudged = render(changed, held_out, backend="cpu").image.numpy()
touched = int((np.abs(nudged - by_kernels).max(axis=2) > 1 / 255).sum())
numbers = sum(values.numel() for values in trained.tensors().values())
trained_mse, nudged_mse = (np.mean((image - capture.held_out.image) ** 2) for image in (by_kernels, nudged))
print(f"splat {index}: {touched} of {budget.size**2:,} pixels change by more than 1/255")
print(f"mean squared error against the photo: {trained_mse:.4e} -> {nudged_mse:.4e}")
print(f"to ask that of every number: {numbers:,} pictures, for a single step")
assert 0 < touched < 0.2 * budget.size**2 and nudged_mse != trained_mse

fig, axes = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained")
show_images(axes, {"as trained": by_kernels, "one splat larger": nudged})
change = axes[2].imshow(np.abs(nudged - by_kernels).max(axis=2), cmap="magma", interpolation="nearest")
axes[2].set(title="the pixels that heard of it", xticks=[], yticks=[])
fig.colorbar(change, ax=axes[2], label="largest change of a channel")
plt.show()

# %% [markdown]
# So a number can be asked: change it, draw again, see whether the picture got better. It is the only way there has
# been up to here, and it takes a picture for each number of each step. We need the way back: from the wrong pixels to
# all the numbers at once, in one pass. It exists, and without the third dimension it is short enough to derive by
# hand: [chapter 08](08_fit_an_image.ipynb).
