# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** What is the gradient of the loss by the background's colour, for the tiny scene? `T`,
# `alpha` and `g` are at hand.

# %%
grad_background = np.einsum("hw,hwc->c", T[-1] * (1 - alpha[-1]), g)

left_over = (T[-1] * (1 - alpha[-1]))[..., None] * np.array([1.0, 0, 0])  # what a red background would add
lighter, darker = (squared_error(image + sign * left_over, wanted_picture)[0] for sign in (1, -1))
assert np.isclose(grad_background[0], (lighter - darker) / 2)  # the loss is quadratic: any step is exact

# %% [markdown]
# **Exercise 2 (a function).** Write `absolute_error(image, photo)`: the mean absolute difference and its slope by the
# image, like `squared_error`. Check the slope by differences. Where has it none?


# %%
def absolute_error(image, photo):
    return np.abs(image - photo).mean(), np.sign(image - photo) / image.size


draft = rng.uniform(size=(5, 4, 3))
target = rng.uniform(size=draft.shape)
loss, slope = absolute_error(draft, target)
for index in np.ndindex(draft.shape):
    nudge = np.zeros_like(draft)
    nudge[index] = (
        1e-7  # no value is that close to its target, where the slope jumps from one sign to the other
    )
    ahead, behind = (absolute_error(draft + sign * nudge, target)[0] for sign in (1, -1))
    assert np.isclose((ahead - behind) / 2e-7, slope[index], rtol=0, atol=1e-8)

# %% [markdown]
# **Exercise 3 (open).** What is a splat worth? Fit the photo with a quarter and with half of the splats, for the same
# number of steps, and say how many decibels a doubling brings. Would you expect it to go on like this?

# %%
qualities = {}
for count in (COUNT // 4, COUNT // 2, COUNT):
    fewer = random_splats_2d(count, height, width, np.random.default_rng(8))
    qualities[count] = fit_2d(photo, fewer, Fit2DSettings(TRIAL)).psnrs[-1]
    print(f"{count:4d} splats: {qualities[count]:.2f} dB")
# Each doubling brings a decibel or two. It cannot go on: with a splat for each pixel nothing is left to explain, and
# long before that the steps are too few for so many numbers.
assert list(qualities.values()) == sorted(qualities.values())
