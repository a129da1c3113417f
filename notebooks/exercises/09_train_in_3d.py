# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** After which iteration did the scene first have more splats than it began with? Ask
# `counts`.

# %%
grown_at = next(i for i, count in enumerate(counts) if count > counts[0])

assert max(counts[:grown_at]) == counts[0] < counts[grown_at]

# %% [markdown]
# **Exercise 2 (a function).** The curve of the loss is noisy, because each iteration looks at another view; the
# [held-out view](../docs/GLOSSARY.md#held-out-view) is looked at too seldom for a curve. Write
# `smoothed(values, window)`: the mean over each run of so many iterations. Which window would you choose here?


# %%
def smoothed(values, window):
    sums = np.cumsum(np.concatenate([[0.0], values]))
    return (sums[window:] - sums[:-window]) / window


smooth = smoothed(curve, len(capture.train))  # about once through all views
assert len(smooth) == ITERATIONS - len(capture.train) + 1
assert np.isclose(smooth[-1], np.mean(curve[-len(capture.train) :]))
assert np.abs(np.diff(smooth)).mean() < 0.2 * np.abs(np.diff(curve)).mean()

# %% [markdown]
# **Exercise 3 (open).** The threshold of [densification](../docs/GLOSSARY.md#densification) is 2e-4, in normalised
# device coordinates ([NDC](../docs/GLOSSARY.md#ndc)), in which the image is two wide. Why not in pixels? Work out
# for one splat how its pull depends on the resolution of the photo.


# %%
def pull(edge):
    """Slope of the mean absolute difference by the centre of a splat that is a fiftieth of the image off."""
    x, y = np.meshgrid(np.arange(edge), np.arange(edge))

    def loss(u):
        shown, wanted = (
            np.exp(-((x - place) ** 2 + (y - edge / 2) ** 2) / (2 * (edge / 16) ** 2))
            for place in (u, 0.52 * edge)
        )
        return np.abs(shown - wanted).mean()

    step = 1e-3 * edge
    return (loss(edge / 2 + step) - loss(edge / 2 - step)) / (2 * step)


for edge in (64, 128, 256):
    print(
        f"{edge} px: {abs(pull(edge)):.2e} a pixel, {abs(pull(edge)) * edge / 2:.2e} in units of half the image"
    )
# The loss is a mean, so it does not know the resolution; a pixel is half as long in an image twice as wide, so the
# slope by pixels halves. A threshold in pixels would densify less the better the camera.
assert np.isclose(pull(64) * 32, pull(128) * 64, rtol=0.02)
assert np.isclose(pull(64), 2 * pull(128), rtol=0.02)
assert config.adc.grad_threshold == 2e-4
