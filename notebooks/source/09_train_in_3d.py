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
# # 09 - A scene that is learned
#
# In two dimensions every gradient could be written down by hand and checked by hand. In three, a splat
# reaches a pixel through a quaternion, a covariance, a perspective that is only linear up close, and a
# sort. Each link has a derivative, and the kernels of later chapters will need each of them written out.
# Today something else is missing: a scene that was *learned*. So the gradients are borrowed. The forward
# pass is rewritten in torch, autograd differentiates it, and this page does two things with the result:
# it checks that what was borrowed is right, and it measures what borrowing costs.
#
# Nothing is captured with a lens here. The NumPy renderer photographs a sphere whose every splat is
# known, and a random cloud has to turn into that sphere. Whatever is missing at the end is the fault of
# the optimisation, because the photos have none.

# %%
import functools
import math
import os
import time

import matplotlib.pyplot as plt
import numpy as np
import torch

from gsplat_edu import Camera, build_cov3d_batch, quat_to_R_batch, render_gaussians, sphere_shell
from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN, C0, DILATION, Z_NEAR
from gsplat_edu.base.threads import one_thread
from gsplat_edu.data.synthetic import sphere_cameras, sphere_capture
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.torch.render import eval_sh_t
from gsplat_edu.train import Start, Views, course, training
from gsplat_edu.train.initialize import random_ball

# GSPLAT_EDU_BUDGET=reduced runs this page in about a minute: smaller images, fewer splats, fewer steps.
SHORT = os.environ.get("GSPLAT_EDU_BUDGET") == "reduced"
SIZE, CAP, ITERATIONS = (32, 800, 300) if SHORT else (128, 1600, 800)
print(f"torch {torch.__version__}, {torch.get_num_threads()} threads")
print(f"budget: {ITERATIONS} iterations, {SIZE} px, at most {CAP} splats{' (reduced)' if SHORT else ''}")

# %% [markdown]
# ## A capture whose truth is known
#
# Three rings of cameras around the sphere look at its centre. One more stands between the rings and
# between the cameras of a ring. No step of the training will see what it sees; at the end it alone
# decides whether a sphere was learned, or only the photos of one.

# %%
capture = sphere_capture(SIZE)
print(f"{len(capture.train)} cameras to train on, 1 to judge with")
assert len(capture.train) == 24

fig, axes = plt.subplots(1, 6, figsize=(14, 2.8), layout="constrained")
for ax, i in zip(axes, [0, 4, 9, 13, 18, 22], strict=True):
    ax.imshow(capture.train[i].image, interpolation="nearest")
    ax.set(title=f"camera {i}", xticks=[], yticks=[])
fig.suptitle("what there is to learn from: the NumPy renderer took these photos")
plt.show()

# %% [markdown]
# ## The same forward pass, in torch
#
# A few functions are the whole renderer, and they do what `render_gaussians` does in the same order: turn
# quaternions into rotations, project, and composite from near to far. Everything is batched, so that
# autograd sees a few large operations instead of a loop over splats. The conic is that of
# [chapter 04](04_splatting.ipynb): with $\Sigma_{2d} = \begin{pmatrix} a & b \\ b & c \end{pmatrix}$, dilated,
# its inverse has the entries $A = c / (ac - b^2)$, $B = -b / (ac - b^2)$ and $C = a / (ac - b^2)$, and a splat
# falls off with $-\tfrac12 (A\,dx^2 + 2B\,dx\,dy + C\,dy^2)$.


# %%
def rotations(quats):
    largest = quats.detach().abs().amax(dim=-1, keepdim=True)  # so that no square overflows or vanishes
    quats = quats / largest
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def conic_of(JW, R, scales):
    N = JW @ (R * scales[:, None, :])
    cov2d = N @ N.mT
    a, b, c = cov2d[:, 0, 0] + DILATION, cov2d[:, 0, 1], cov2d[:, 1, 1] + DILATION
    det = a * c - b * b
    return c / det, -b / det, a / det


def falloff(conic, dx, dy):
    A, B, C = conic
    return -0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy


def project_splats(means, R, scales, camera, conic_of):
    view, eye = (torch.tensor(part, dtype=means.dtype) for part in (camera.R, camera.eye))
    in_camera = (means - eye) @ view.T
    seen = torch.nonzero(in_camera[:, 2] > Z_NEAR)[:, 0]
    seen = seen[torch.argsort(in_camera[seen, 2], stable=True)]  # near to far
    x, y, z = in_camera[seen].unbind(-1)
    centres = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=-1)
    zero, x_z, y_z = torch.zeros_like(z), x / z, y / z
    J = [[camera.fx / z, zero, -camera.fx * x_z / z], [zero, camera.fy / z, -camera.fy * y_z / z]]
    JW = torch.stack([torch.stack(row, dim=-1) for row in J], dim=-2) @ view
    return centres, conic_of(JW, R[seen], scales[seen]), seen


def draw_splats(splats, camera, floor=ALPHA_MIN, chunk=16, ellipse=(conic_of, falloff)):
    means, R, scales, colors, opacities = splats
    conic_of, falloff = ellipse  # the end of this page tries another pair
    centres, conics, seen = project_splats(means, R, scales, camera, conic_of)
    if centres.requires_grad:
        centres.retain_grad()  # density control will ask for it
    colors, opacities = colors[seen], opacities[seen]
    image = torch.zeros(camera.H, camera.W, 3, dtype=means.dtype)
    T = torch.ones(camera.H, camera.W, dtype=means.dtype)
    xs, ys = torch.arange(camera.W, dtype=means.dtype), torch.arange(camera.H, dtype=means.dtype)[:, None]
    for first in range(0, len(seen), chunk):
        part = slice(first, first + chunk)
        u, v = (axis[part, None, None] for axis in centres.unbind(-1))
        power = falloff([entry[part, None, None] for entry in conics], xs - u, ys - v)
        alpha = (opacities[part, None, None] * torch.exp(power)).clamp(max=ALPHA_MAX)
        alpha = alpha * (alpha >= floor)
        T_after = T * torch.cumprod(1.0 - alpha, dim=0)
        T_before = torch.cat([T[None], T_after[:-1]], dim=0)
        image, T = image + torch.einsum("nyx,nc->yxc", T_before * alpha, colors[part]), T_after[-1]
    return image, centres, seen


# %% [markdown]
# It differs from the NumPy renderer in two places, and both concern what is *not* computed.
#
# - The NumPy renderer gives every splat a box and looks at no pixel outside it. A batched operation
#   cannot skip like that, so here every splat is evaluated at every pixel.
# - The NumPy renderer stops where hardly any light is left. Here nothing stops.
#
# Neither changes a value that matters, but the box does cut: at three standard deviations a splat may
# still be above the floor, `ALPHA_MIN`, and the dense renderer keeps that tail. So the two cannot agree to
# the last digit, and the check below has to know by how much they may differ. Ask the NumPy renderer for
# exact extents and no stop, and they must agree to rounding.

# %%
rng = np.random.default_rng(9)
quats, log_scales = rng.normal(size=(64, 4)), rng.normal(size=(64, 3)) * 0.3 - 2.0
R = rotations(torch.tensor(quats))
M = R * torch.exp(torch.tensor(log_scales))[:, None, :]
assert np.allclose(R.numpy(), quat_to_R_batch(quats), rtol=0, atol=1e-12)
covariances = build_cov3d_batch(np.exp(log_scales), quat_to_R_batch(quats))
assert np.allclose((M @ M.mT).numpy(), covariances, rtol=0, atol=1e-12)

camera, shell = sphere_cameras(128)[8], sphere_shell()
means, cov3ds, colors, opacities = (torch.tensor(array) for array in shell)
variances, axes = torch.linalg.eigh(cov3ds)  # the shell is given by covariances: Sigma = R S S R'
dense = draw_splats((means, axes, variances.sqrt(), colors, opacities), camera)[0].numpy()
boxed, _ = render_gaussians(camera, *shell)
exact, _ = render_gaussians(camera, *shell, extent="exact", stop="none")
difference, rounding = np.abs(dense - boxed), np.abs(dense - exact)
print(f"dense against 3-sigma boxes:  max {difference.max():.4e}  mean {difference.mean():.4e}")
print(f"dense against exact extents:  max {rounding.max():.4e}")
assert abs(difference.max() / 2.7565e-4 - 1) < 0.01
assert abs(difference.mean() / 7.6515e-9 - 1) < 0.01
assert rounding.max() < 1e-12

# %% [markdown]
# ## Borrowed gradients, checked like our own
#
# Autograd differentiates whatever it is given, a wrong formula as well as a right one; the check above is
# what says that the formula is right. What is left to check is the derivative. Four splats, sixteen
# pixels a side, double precision: every raw parameter is nudged, and the change of every pixel is
# compared with the Jacobian.
#
# A finite difference only makes sense where the function is smooth, so the scene is kept away from its
# edges: the alpha floor is off, no opacity comes near the clamp, no colour near zero, and no two splats
# are so close in depth that a nudge could swap them.


# %%
def activated(means, quats, log_scales, sh0, logits):
    """Turn what is learned into what is drawn."""
    colors = torch.clamp(torch.full_like(sh0[:, 0], 0.5) + C0 * sh0[:, 0], min=0.0)
    return means, rotations(quats), torch.exp(log_scales), colors, torch.sigmoid(logits)


TINY = Camera.looking_at(eye=[0, 0, -3], target=[0, 0, 0], fx=16, fy=16, H=16, W=16)


def tiny_image(*raw):
    return draw_splats(activated(*raw), TINY, floor=0.0, chunk=3)[0]


sample = functools.partial(torch.randn, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
tiny = (
    0.3 * sample(4, 3),
    torch.tensor([1.0, 0, 0, 0], dtype=torch.float64) + 0.1 * sample(4, 4),
    0.3 * sample(4, 3) - 1.0,
    0.3 * sample(4, 1, 3),
    0.3 * sample(4),
)
assert torch.sort(tiny[0][:, 2]).values.diff().min() > 1e-3
assert torch.sigmoid(tiny[4]).max() < 0.95 and (C0 * tiny[3] + 0.5).min() > 0.01
assert torch.autograd.gradcheck(tiny_image, [t.requires_grad_() for t in tiny], eps=1e-6, atol=1e-5)
print("whole chain: autograd agrees with finite differences")

for degree in range(4):
    sh, dirs = 0.1 * sample(5, 16, 3), sample(5, 3)
    dirs = dirs / dirs.norm(dim=-1, keepdim=True)
    inputs = [sh.requires_grad_(), dirs.requires_grad_()]
    assert torch.autograd.gradcheck(functools.partial(eval_sh_t, degree), inputs, eps=1e-6, atol=1e-7)
print("spherical harmonics, degrees 0 to 3: autograd agrees with finite differences")

# %% [markdown]
# ## Where this run departs from the paper
#
# The recipe is that of Kerbl et al. (2023), who train for 30,000 iterations on photos of a thousand pixels and
# more. This page trains for 800, on photos of 128, and nearly everything below follows from that. Here is all of it,
# before a line of it runs.
#
# **What is fitted.** The loss is the mean absolute difference alone; the paper mixes in a fifth of $1 -$ SSIM.
# Colour is one coefficient of spherical harmonics per channel, because the sphere looks the same from
# everywhere; the paper ends at degree 3, one degree more every 1,000 iterations. Photos keep one size; the
# paper's first iterations see smaller ones. Splats nearer than 0.05 are left out (0.2 in the paper's code), and
# the slope of the perspective is not clamped (there, at 1.3 times half the field of view).
#
# **How it moves.** The start is a random cloud of one size, not the points of structure from motion, each as
# large as the distance to its neighbours. The rate of the means is 1e-3 from first to last, because a splat may
# have to cross the ball in 800 steps; the paper's is 1.6e-4 times the extent of the scene and falls a
# hundredfold. The extent is the radius of the orbit, 3; there, 1.1 times the largest distance of a camera from
# the middle of all. Adam's $\epsilon$ is 1e-8 (1e-15). Each iteration draws its view at random, so that one may come
# twice before another comes once; the paper goes through all of them first.
#
# **How the number of splats changes.** It changes every 100 iterations from the 100th until before the 600th
# (there, from the 500th to the 15,000th), and never beyond a cap of 1,600, because a dense renderer pays for every
# splat at every pixel: survivors come first, then copies, then children, and what is over the cap is dropped from
# the end, even where the parent is gone already. Opacities are never reset, which the paper does every 3,000
# iterations. Nothing is pruned for being large. And the pull on a splat is averaged over the renders in which
# it lies in front of the camera; the paper counts those in which it touches the image.

# %%
config = course.course_config(ITERATIONS, seed=9, max_gaussians=CAP)
assert config.ssim_weight == config.sh_degree == config.adc.reset_every == 0 and config.jacobian_limit is None
assert np.isclose(config.means_rate * course.EXTENT, 1e-3) and config.means_rate_final == config.means_rate
assert (config.adam_eps, config.view_order, config.adc.over_cap) == (1e-8, "random", "cut")
assert (config.densify_every, config.adc.densify_stop, config.max_gaussians) == (100, 600, CAP)
assert course.EXTENT == 3.0 and Z_NEAR == 0.05

# %% [markdown]
# ## A cloud that knows nothing
#
# The start is a ball of 400 faint grey blobs, all of one size: a scale of 0.09, a logit of -2.2, an opacity of about a
# tenth. Positions are uniform by volume, which is why the radius is a cube root. Quaternions are a hundredth
# away from no rotation at all, and the coefficients of colour 0.2 away from grey. Opacity is stored as a logit and
# scale as a logarithm, so that no step of the optimiser can leave the range where they make sense.

# %%
SEED = 9
RATES = {"means": 1e-3, "quats": 1e-3, "log_scales": 5e-3, "sh0": 2.5e-3, "logit_opacities": 5e-2}


def random_cloud(count, generator):
    normal = functools.partial(torch.randn, generator=generator)
    directions = normal(count, 3)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    radii = torch.rand(count, 1, generator=generator) ** (1 / 3)
    raw = {
        "means": directions * radii,
        "quats": torch.tensor([1.0, 0, 0, 0]) + 0.01 * normal(count, 4),
        "log_scales": torch.full((count, 3), math.log(0.09)),
        "sh0": 0.2 * normal(count, 1, 3),
        "logit_opacities": torch.full((count,), -2.2),
    }
    return {name: tensor.requires_grad_() for name, tensor in raw.items()}


cloud = random_cloud(400, torch.Generator().manual_seed(SEED))
package = random_ball(400, torch.Generator().manual_seed(SEED)).tensors()
assert all(torch.equal(raw, package[name]) for name, raw in cloud.items())
opacity = float(torch.sigmoid(cloud["logit_opacities"].detach()[0]))
print(f"{len(cloud['means'])} splats of opacity {opacity:.4f}")
assert abs(opacity - 0.1) < 0.001


# %% [markdown]
# Adam is that of chapter 08, with a rate for each kind of parameter. Its two moments have a row for every
# splat, because the number of splats is about to change.


# %%
class AdamByHand:
    def __init__(self, scene):
        self.steps = 0
        self.first, self.second = ({name: torch.zeros_like(scene[name]) for name in RATES} for _ in range(2))

    @torch.no_grad()
    @one_thread()
    def move(self, scene, b1=0.9, b2=0.999, eps=1e-8):
        self.steps += 1
        for name, rate in RATES.items():
            m, v, gradient = self.first[name], self.second[name], scene[name].grad
            m.mul_(b1).add_(gradient, alpha=1 - b1)
            v.mul_(b2).addcmul_(gradient, gradient, value=1 - b2)
            scene[name] -= rate * (m / (1 - b1**self.steps)) / ((v / (1 - b2**self.steps)).sqrt() + eps)
            scene[name].grad = None


# %% [markdown]
# ## Where splats are missing, and where they are not needed
#
# A fixed number of splats can only move and stretch. The gradient of the loss with respect to a splat's
# *image* position says more than where to move it: a splat that is pulled strongly, view after view, is
# covering a place that one splat cannot explain. If it is small it is copied. If it is large, larger than a
# hundredth of the scene's extent, two children drawn from its own distribution take its place, each with scales
# divided by 1.6. A splat whose opacity has sunk below 0.005 goes. Those that stay keep what Adam has learned about
# them; the new ones start without a past.
#
# Strongly means more than 2e-4 on average, where the image is two units wide (normalised device
# coordinates), so that the threshold does not depend on the number of pixels.


# %%
@torch.no_grad()
def densified(scene, adam, pull, generator):
    faint = torch.sigmoid(scene["logit_opacities"]) < 0.005
    large = torch.exp(scene["log_scales"]).amax(dim=-1) > 0.01 * course.EXTENT
    pulled = ~faint & (pull > 2e-4)
    clones, parents = (
        {name: raw[rows] for name, raw in scene.items()} for rows in (pulled & ~large, pulled & large)
    )
    newborn = [clones]
    for _ in range(2):
        noise = torch.randn(len(parents["means"]), 3, generator=generator)
        offset = (rotations(parents["quats"]) @ (torch.exp(parents["log_scales"]) * noise)[..., None])[..., 0]
        moved = {"means": parents["means"] + offset, "log_scales": parents["log_scales"] - math.log(1.6)}
        newborn.append(parents | moved)
    keep = ~faint & ~(pulled & large)
    for moments in (adam.first, adam.second):
        for name, rows in moments.items():
            moments[name] = torch.cat([rows[keep], *(torch.zeros_like(part[name]) for part in newborn)])[:CAP]
    grown = {name: torch.cat([scene[name][keep], *(part[name] for part in newborn)])[:CAP] for name in scene}
    told = f"+{len(clones['means'])} cloned, +{2 * len(parents['means'])} split children, -{int(faint.sum())} pruned"
    print(f"  densify: {told} -> K={len(grown['means'])}")
    return {name: raw.requires_grad_() for name, raw in grown.items()}


# %% [markdown]
# ## The loop
#
# One view, one render, one comparison, one step, and every 100 iterations until the 600th a
# densification. That is all there is. The camera that was held out looks on, right before each densification, right
# after it and 20 iterations later; nothing of what it sees comes back.
#
# > **Predict.** What does the loss do in the iterations right after a densification: does it fall at once, because
# > there are more splats, or rise first? And does the number of splats grow by the same factor every time?


# %%
def held_out_image(scene):
    with torch.no_grad():
        return draw_splats(activated(*scene.values()), capture.held_out.camera)[0].numpy()


@one_thread()  # torch's sums round differently on another number of threads
def mean_difference(image, photo):
    return (image - photo).abs().mean()


MIDDLE = 3 * ITERATIONS // 8
photos = [torch.tensor(view.image, dtype=torch.float32) for view in capture.train]
half = torch.tensor([SIZE / 2, SIZE / 2])


def learned(iterations, ellipse=(conic_of, falloff)):
    generator, choice = torch.Generator().manual_seed(SEED), np.random.default_rng(SEED)
    scene = random_cloud(400, generator)
    adam = AdamByHand(scene)
    norms, visits = torch.zeros(2, len(scene["means"]))
    curve, counts, looks = [], [], {"start": held_out_image(scene)}
    for iteration in range(iterations):
        i = int(choice.integers(len(photos)))
        camera = capture.train[i].camera
        image, centres, seen = draw_splats(activated(*scene.values()), camera, ellipse=ellipse)
        loss = mean_difference(image, photos[i])
        loss.backward()
        norms[seen] += torch.linalg.vector_norm(centres.grad * half, dim=-1)
        visits[seen] += 1
        adam.move(scene)
        curve.append(loss.item())
        counts.append(len(scene["means"]))
        if iteration % 100 in (0, 20) or iteration == MIDDLE:
            looks[iteration] = held_out_image(scene)
        if iteration % 100 == 0:
            print(f"iter {iteration:4d}  L1 {curve[-1]:.4f}  K {counts[-1]}")
            if 0 < iteration < 600:
                scene = densified(scene, adam, norms / visits.clamp(min=1), generator)
                norms, visits = torch.zeros(2, len(scene["means"]))
                looks[iteration, "grown"] = held_out_image(scene)
    return scene, curve, counts, looks | {iterations: held_out_image(scene)}


began = time.process_time()
scene, curve, counts, looks = learned(ITERATIONS)
milliseconds = 1e3 * (time.process_time() - began) / ITERATIONS
print(f"{ITERATIONS} iters -> {milliseconds:.0f} ms of processor time per iteration at {SIZE} px")

# %% [markdown]
# ## The camera that was held out

# %%
truth = capture.held_out.image
judged = {moment: float(np.abs(image - truth).mean()) for moment, image in looks.items()}
before, after = judged["start"], judged[ITERATIONS]
print(f"held-out L1: init {before:.4f} -> final {after:.4f}")
assert after < 0.3 * before
assert counts[-1] <= CAP

panels = [("start", looks["start"])] + [(f"iteration {i}", looks[i]) for i in (MIDDLE, ITERATIONS)]
panels += [("truth", truth)]
fig, axes = plt.subplots(1, 4, figsize=(13, 3.7), layout="constrained")
for ax, (title, image) in zip(axes, panels, strict=True):
    ax.imshow(np.clip(image, 0, 1), interpolation="nearest")
    ax.set(title=title, xticks=[], yticks=[])
fig.suptitle("the held-out camera: no step of the training saw this view")
plt.show()

# %%
fig, (loss_ax, count_ax) = plt.subplots(1, 2, figsize=(11, 3.4), layout="constrained")
loss_ax.semilogy(curve, linewidth=0.8)
loss_ax.set(title="training loss", xlabel="iteration", ylabel="L1 of the iteration's view")
count_ax.plot(counts)
count_ax.set(title="density control", xlabel="iteration", ylabel="number of splats", ylim=(0, None))
plt.show()

# %% [markdown]
# Nobody trained on this view, and it is there: made of a random cloud, a sum of absolute differences and
# a rule for making copies. What the two curves owe to density control, the camera that was held out says more plainly:

# %%
grown = [moment[0] for moment in looks if isinstance(moment, tuple)]
factors = [counts[at + 1] / counts[at] for at in grown]
print("after iteration     splats   factor   held-out L1: before   right after   20 later")
for at, factor in zip(grown, factors, strict=True):
    seen_then = f"{judged[at]:.4f}         {judged[at, 'grown']:.4f}        {judged[at + 20]:.4f}"
    print(f"{at:15d}  {counts[at]:4d} -> {counts[at + 1]:4d}    {factor:.2f}                {seen_then}")
assert factors == sorted(factors, reverse=True) and counts[-1] == CAP
assert all(judged[at] < judged[at, "grown"] > judged[at + 20] for at in grown)

# %% [markdown]
# The error rises first, each time: two children drawn at random are a worse guess than the parent that was fitted.
# Twenty iterations later it is below what it was right after. And the factor falls from one densification to the
# next: the fewer splats are still pulled beyond the threshold, the closer it comes to one. At the end it is the cap
# that makes it one, at a price: a parent goes before its children are counted, and those beyond the cap are dropped,
# so that splats are lost where they were wanted most.
#
# To run this without a notebook: `python train/train_3d.py --help`, or `gsplat-edu demo`.

# %% [markdown]
# ## To the last bit
#
# The package's own backend `torch` is this page's renderer, and `training` its loop
# ([render.torch.render](../src/gsplat_edu/render/torch/render.py),
# [density.adc](../src/gsplat_edu/train/density/adc.py), [trainer](../src/gsplat_edu/train/trainer.py),
# [step](../src/gsplat_edu/train/step.py)); they serve every other training too, so they are longer. Do they take
# the same steps? Not to the last digit as it stands, because the package is more careful in one place. For a splat seen
# edge-on the products $ac$ and $b^2$ agree in nearly all their digits, and float32 has only seven. With
# $\Sigma_{2d} = N N^\top$ before it is dilated, and $n$ the cross product of the two rows of $N = J W R S$, their
# difference is $|n|^2$, a sum of squares, which loses nothing. And the ellipse is kept as
# $A (dx - m\,dy)^2 + C\,dy^2$, which cannot become negative by rounding: the same mathematics, in other operations.


# %%
def careful_conic_of(JW, R, scales):
    N = JW @ (R * scales[:, None, :])
    cov2d = N @ N.mT
    (s0, s1, s2), across = scales.unbind(-1), torch.linalg.cross(JW[:, 0], JW[:, 1])
    n = (across[:, None, :] @ R)[:, 0] * torch.stack([s1 * s2, s2 * s0, s0 * s1], dim=-1)
    a, b, c = cov2d[:, 0, 0], cov2d[:, 0, 1], cov2d[:, 1, 1]
    det = (n * n).sum(dim=-1) + DILATION * (a + c) + DILATION * DILATION
    c = c + DILATION
    return c / det, b / c, 1 / c


def careful_falloff(conic, dx, dy):
    A, m, C = conic
    return -0.5 * A * (dx - m * dy) ** 2 - 0.5 * C * dy * dy


FEW = 120  # the first densification is among them
_, careful_curve, careful_counts, _ = learned(FEW, (careful_conic_of, careful_falloff))
again = torch.Generator().manual_seed(SEED)
start = Start(random_ball(400, again), extent=course.EXTENT, generator=again)
result = training(config.changed(iterations=FEW), Views(capture.train), load_backend("torch"), start).run()
same = sum(mine == theirs for mine, theirs in zip(careful_curve, result.losses, strict=True))
apart = np.abs(np.array(curve[:FEW]) - careful_curve).max()
print(f"{same} of {FEW} losses are equal; the plain conic differs from them by at most {apart:.1e}")
assert result.losses == careful_curve
assert result.counts == careful_counts

# %% [markdown]
# ## The next failure
#
# Look at the time an iteration takes, for a toy. Then count what it spends it on: the dense renderer
# evaluates every splat at every pixel, and almost all of those evaluations come out below the floor and
# are thrown away.

# %%
with torch.no_grad():
    means, R, scales, colors, opacities = activated(*scene.values())
    needed, looked_at, white = 0, len(means) * SIZE * SIZE, torch.ones(1, 3)
    for i in range(len(means)):
        one = (means[i : i + 1], R[i : i + 1], scales[i : i + 1], white, opacities[i : i + 1])
        needed += int((draw_splats(one, capture.held_out.camera)[0][..., 0] > 0).sum())
share = needed / looked_at
print(f"{looked_at:,} evaluations for one image, {needed:,} of them above the floor: {100 * share:.2f} %")
print(f"at {milliseconds:.0f} ms, 30,000 iterations of this toy take {30 * milliseconds / 3600:.1f} hours")
assert share < 0.1

# %% [markdown]
# That is a toy. A capture made with a phone has millions of pixels where this has thousands, and as many
# splats, and both factors multiply. The mathematics does not have to change: we need a renderer that does
# only the work that shows. It will be made of kernels that do what this page did, formula for formula,
# and it will have to give the same image and the same gradients. The first of them is going to be the
# plainest thing that works, so that there is something to be faster than.
