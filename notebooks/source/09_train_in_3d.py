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
import inspect
import os

import matplotlib.pyplot as plt
import numpy as np
import torch

from gsplat_edu import C0, Camera, build_cov3d_batch, quat_to_R_batch, render_gaussians, sphere_shell
from gsplat_edu.data.synthetic import sphere_cameras, sphere_capture
from gsplat_edu.ops.losses import l1
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.torch_reference import eval_sh_t, render_t
from gsplat_edu.scene.gaussians import cov3d_t, quat_to_R_t
from gsplat_edu.train import Start, Views, course, training
from gsplat_edu.train.density.adc import AdaptiveDensityControl
from gsplat_edu.train.events import DensifyEvent
from gsplat_edu.train.initialize import random_ball
from gsplat_edu.train.stepper import TensorStepper
from gsplat_edu.train.trainer import Trainer

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
# `render_t` ([gsplat_edu.render.torch_reference](../src/gsplat_edu/render/torch_reference.py)) does what
# `render_gaussians` does, in the same order: project, dilate, invert, sort by depth,
# composite from near to far. It differs in two places, and both concern what is *not* computed.
#
# - The NumPy renderer gives every splat a box and looks at no pixel outside it. A batched operation
#   cannot skip like that, so here every splat is evaluated at every pixel.
# - The NumPy renderer stops where hardly any light is left. Here nothing stops.
#
# Neither changes a value that matters, but the box does cut: at three standard deviations a splat may
# still be above the floor of 1/255, and the dense renderer keeps that tail. So the two cannot agree to
# the last digit, and the check below has to know by how much they may differ. Ask the NumPy renderer for
# exact extents and no stop, and they must agree to rounding.

# %%
rng = np.random.default_rng(9)
quats, log_scales = rng.normal(size=(64, 4)), rng.normal(size=(64, 3)) * 0.3 - 2.0
rotations = quat_to_R_batch(quats)
covariances = build_cov3d_batch(np.exp(log_scales), rotations)
assert np.allclose(quat_to_R_t(torch.tensor(quats)).numpy(), rotations, rtol=0, atol=1e-12)
assert np.allclose(
    cov3d_t(torch.tensor(log_scales), torch.tensor(quats)).numpy(), covariances, rtol=0, atol=1e-12
)

camera, shell = sphere_cameras(128)[8], sphere_shell()
dense = render_t(*(torch.tensor(array) for array in shell), camera).image.numpy()
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
TINY = Camera.looking_at(eye=[0, 0, -3], target=[0, 0, 0], fx=16, fy=16, H=16, W=16)


def tiny_image(means, log_scales, quats, sh0, logits):
    colors = torch.clamp(C0 * sh0 + 0.5, min=0.0)
    covariances, opacities = cov3d_t(log_scales, quats), torch.sigmoid(logits)
    return render_t(means, covariances, colors, opacities, TINY, alpha_min=0.0, chunk=3).image


draw = functools.partial(torch.randn, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
tiny = (
    0.3 * draw(4, 3),
    0.3 * draw(4, 3) - 1.0,
    torch.tensor([1.0, 0, 0, 0], dtype=torch.float64) + 0.1 * draw(4, 4),
    0.3 * draw(4, 3),
    0.3 * draw(4),
)
assert torch.sort(tiny[0][:, 2]).values.diff().min() > 1e-3
assert torch.sigmoid(tiny[4]).max() < 0.95 and (C0 * tiny[3] + 0.5).min() > 0.01
assert torch.autograd.gradcheck(tiny_image, [t.requires_grad_() for t in tiny], eps=1e-6, atol=1e-5)
print("whole chain: autograd agrees with finite differences")

for degree in range(4):
    sh, dirs = 0.1 * draw(5, 16, 3), draw(5, 3)
    dirs = dirs / dirs.norm(dim=-1, keepdim=True)
    inputs = [sh.requires_grad_(), dirs.requires_grad_()]
    assert torch.autograd.gradcheck(functools.partial(eval_sh_t, degree), inputs, eps=1e-6, atol=1e-7)
print("spherical harmonics, degrees 0 to 3: autograd agrees with finite differences")

# %% [markdown]
# ## A cloud that knows nothing
#
# The start is a ball of faint grey blobs, all of one size. Positions are uniform by volume; colour is a
# single harmonic coefficient per channel, because the sphere looks the same from everywhere. Opacity is
# stored as a logit and scale as a logarithm, so that no step of the optimiser can leave the range where
# they make sense.
#
# The parameters of the run, and every way in which it is simpler than the original recipe, are listed
# in one place:

# %%
print(inspect.getdoc(course))

# %%
SEED = 9
generator = torch.Generator().manual_seed(SEED)
cloud = random_ball(400, generator)
config = course.course_config(ITERATIONS, SEED, CAP)
print(f"{len(cloud)} splats at scale {float(cloud.scales[0, 0].detach()):.3f}")
print(f"opacity {float(cloud.opacities[0]):.4f}, cap {config.max_gaussians}")

# %% [markdown]
# ## Where splats are missing, and where they are not needed
#
# A fixed number of splats can only move and stretch. The gradient of the loss with respect to a splat's
# *image* position says more than where to move it: a splat that is pulled strongly, view after view, is
# covering a place that one splat cannot explain. If it is small it is copied; if it is large, two smaller
# ones drawn from its own distribution take its place. A splat too faint to be seen goes. Those that stay
# keep what Adam has learned about them; the new ones start without a past.
#
# The rule, as it runs below ([gsplat_edu.train.density.adc](../src/gsplat_edu/train/density/adc.py)):

# %%
print(inspect.getsource(AdaptiveDensityControl._densify))

# %% [markdown]
# ## The loop
#
# One view, one render, one comparison, one step, and now and then a densification. The loop
# ([gsplat_edu.train.trainer](../src/gsplat_edu/train/trainer.py)) draws the views, and a stepper
# ([gsplat_edu.train.stepper](../src/gsplat_edu/train/stepper.py)) holds what a step changes. Neither asks which
# backend renders.

# %%
print(inspect.getsource(Trainer.run))
print(inspect.getsource(Trainer._step))
print(inspect.getsource(TensorStepper._single_step))

# %%
RENDER = functools.partial(render, backend="torch")
MIDDLE = 3 * ITERATIONS // 8
snapshots = {}


def held_out_image(gaussians):
    with torch.no_grad():
        return RENDER(gaussians, capture.held_out.camera).image.numpy()


def follow(trainer, event):
    if isinstance(event, DensifyEvent):
        print(
            f"  densify: +{event.num_cloned} cloned, +{event.num_split_children} split children, "
            f"-{event.num_pruned} pruned -> K={event.num_gaussians}"
        )
    elif event.iteration % 100 == 0:
        print(f"iter {event.iteration:4d}  L1 {event.loss:.4f}  K {event.num_gaussians}")
    if event.iteration == MIDDLE:
        snapshots[MIDDLE] = held_out_image(trainer.gaussians)


start = Start(cloud, extent=course.EXTENT, generator=generator)
trainer = training(config, Views(capture.train), load_backend("torch"), start, callbacks=[follow])
snapshots[0] = held_out_image(trainer.gaussians)
result = trainer.run()
snapshots[ITERATIONS] = held_out_image(trainer.gaussians)
milliseconds = 1e3 * result.seconds / ITERATIONS
print(f"{ITERATIONS} iters in {result.seconds:.0f} s -> {milliseconds:.3f} ms/iter at {SIZE} px")

# %% [markdown]
# ## The camera that was held out

# %%
truth = torch.tensor(capture.held_out.image)
before, after = (float(l1(torch.tensor(snapshots[i]), truth)) for i in (0, ITERATIONS))
print(f"held-out L1: init {before:.4f} -> final {after:.4f}")
assert after < 0.3 * before
assert len(trainer.gaussians) <= CAP

panels = [(f"iteration {i}", snapshots[i]) for i in (0, MIDDLE, ITERATIONS)] + [("truth", truth.numpy())]
fig, axes = plt.subplots(1, 4, figsize=(13, 3.7), layout="constrained")
for ax, (title, image) in zip(axes, panels, strict=True):
    ax.imshow(np.clip(image, 0, 1), interpolation="nearest")
    ax.set(title=title, xticks=[], yticks=[])
fig.suptitle("the held-out camera: no step of the training saw this view")
plt.show()

# %%
fig, (loss_ax, count_ax) = plt.subplots(1, 2, figsize=(11, 3.4), layout="constrained")
loss_ax.semilogy(result.losses, linewidth=0.8)
loss_ax.set(title="training loss", xlabel="iteration", ylabel="L1 of the iteration's view")
count_ax.plot(result.counts)
count_ax.set(title="density control", xlabel="iteration", ylabel="number of splats", ylim=(0, None))
plt.show()

# %% [markdown]
# Nobody trained on this view, and it is there: made of a random cloud, a sum of absolute differences and
# a rule for making copies. In the right-hand plot each densification is a step up, until the cap. In the
# left-hand one each step costs something first, since two children are a worse guess than the parent that
# was fitted, and pays a little later.
#
# To run this without a notebook: `python train/train_3d.py --help`, or `gsplat-edu demo`.

# %% [markdown]
# ## The next failure
#
# Look at the time an iteration takes, for a toy. Then count what it spends it on: the dense renderer
# evaluates every splat at every pixel, and almost all of those evaluations come out below the floor and
# are thrown away.

# %%
with torch.no_grad():
    final = trainer.gaussians
    black = torch.zeros_like(final.means)
    arguments = (final.means, cov3d_t(final.log_scales, final.quats), black, final.opacities)
    needed, looked_at = 0, len(final) * SIZE * SIZE
    for i in range(len(final)):
        one = [argument[i : i + 1] for argument in arguments]
        needed += int((render_t(*one, capture.held_out.camera).transmittance < 1).sum())
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
