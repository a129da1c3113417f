# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** What is `grad_background`, the gradient of the loss by the background's colour, for the tiny
# scene? `T`, `alpha` and `g` are at hand.

# %%
grad_background = np.einsum("hw,hwc->c", T[-1] * (1 - alpha[-1]), g)

# %%
for channel in range(3):
    # what a background of this channel alone would add; the loss is quadratic, so any step is exact
    left_over = (T[-1] * (1 - alpha[-1]))[..., None] * np.eye(3)[channel]
    lighter, darker = (squared_error(image + sign * left_over, wanted_picture)[0] for sign in (1, -1))
    assert np.isclose(grad_background[channel], (lighter - darker) / 2), (
        f"channel {channel}: a difference gives {(lighter - darker) / 2:.6f}, not {grad_background[channel]:.6f}"
    )

# %% [markdown]
# **Exercise 2 (a function).** Write `absolute_error(image, photo)`: the mean absolute difference and its slope by the
# image, like `squared_error`. Where has it none?


# %%
def absolute_error(image, photo):
    return np.abs(image - photo).mean(), np.sign(image - photo) / image.size


# %%
draft = rng.uniform(size=(5, 4, 3))
target = rng.uniform(size=draft.shape)
loss, slope = absolute_error(draft, target)
assert np.isclose(loss, np.mean([abs(a - b) for a, b in zip(draft.flat, target.flat, strict=True)])), (
    f"the mean absolute difference is not {loss:.4f}"
)
for index in np.ndindex(draft.shape):
    nudge = np.zeros_like(draft)
    nudge[index] = (
        1e-7  # no value is that close to its target, where the slope jumps from one sign to the other
    )
    ahead, behind = (absolute_error(draft + sign * nudge, target)[0] for sign in (1, -1))
    assert np.isclose((ahead - behind) / 2e-7, slope[index], rtol=0, atol=1e-8), (
        f"at {index} the slope by differences is {(ahead - behind) / 2e-7:.5f}, not {slope[index]:.5f}"
    )

# %% [markdown]
# **Exercise 3 (open).** What is a splat worth? Write `quality_of(count)`: the PSNR in decibels of a fit of `photo` with
# so many splats, all with the same number of steps. How many decibels does a doubling bring? Would you expect it to go
# on like this?


# %%
def quality_of(count):
    # Each doubling brings a decibel or two. It cannot go on: with a splat for each pixel nothing is left to explain,
    # and long before that the steps are too few for so many numbers.
    fewer = random_splats_2d(count, height, width, np.random.default_rng(8))
    return fit_2d(photo, fewer, Fit2DSettings(TRIAL)).psnrs[-1]


# %%
qualities = {count: quality_of(count) for count in (COUNT // 4, COUNT // 2, COUNT)}
print({count: round(value, 2) for count, value in qualities.items()})
mean_colour = np.broadcast_to(photo.mean(axis=(0, 1)), photo.shape)
without_splats = -10 * np.log10(((photo - mean_colour) ** 2).mean())
assert min(qualities.values()) > without_splats, "a fit is worse than a picture in the mean colour"
assert list(qualities.values()) == sorted(qualities.values()), "more splats did not fit better"
assert qualities[COUNT] < qualities[COUNT // 4] + 12, "two doublings do not bring more than a few decibels"


# %%
def quality_of(count):
    start = random_splats_2d(count, height, width, np.random.default_rng(80))
    return fit_2d(photo, start, Fit2DSettings(TRIAL + 10)).psnrs[-1]
