# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** After which iteration, `grown_at`, did the scene first have more splats than it began with?
# Ask `counts`.

# %%
grown_at = next(i for i, count in enumerate(counts) if count > counts[0])

# %%
assert counts[grown_at] > counts[0], (
    f"after {grown_at} it has {counts[grown_at]} splats, and began with {counts[0]}"
)
assert max(counts[:grown_at]) == counts[0], "it had more splats before"

# %% [markdown]
# **Exercise 2 (a function).** The curve of the loss is noisy, because each iteration looks at another view; the
# [held-out view](../docs/GLOSSARY.md#held-out-view) is looked at too seldom for a curve. Write
# `smoothed(values, window)`: the mean over each run of so many iterations. Which window would you choose here?


# %%
def smoothed(values, window):
    sums = np.cumsum(np.concatenate([[0.0], values]))
    return (sums[window:] - sums[:-window]) / window


# %%
window = len(capture.train)  # about once through all views
smooth = np.asarray(smoothed(curve, window))
assert len(smooth) == ITERATIONS - window + 1, f"there are {ITERATIONS - window + 1} runs, not {len(smooth)}"
for start in (0, 1, len(smooth) // 2, len(smooth) - 1):
    wanted = np.mean(curve[start : start + window])
    assert np.isclose(smooth[start], wanted), (
        f"the mean of run {start} is {wanted:.5f}, not {smooth[start]:.5f}"
    )
assert np.abs(np.diff(smooth)).mean() < 0.2 * np.abs(np.diff(curve)).mean(), "it is as noisy as the curve"

# %% [markdown]
# **Exercise 3 (open).** The threshold of [densification](../docs/GLOSSARY.md#densification) is 2e-4, in normalised
# device coordinates ([NDC](../docs/GLOSSARY.md#ndc)), in which the image is two wide. Why not in pixels? Write
# `pull(edge)`: the slope, by the centre's pixel, of the mean absolute difference between two pictures of `edge` by
# `edge` pixels of one splat each, the second of which is a fiftieth of the image off. You choose the splat.


# %%
def pull(edge):
    # The loss is a mean, so it does not know the resolution; a pixel is half as long in an image twice as wide, so the
    # slope by pixels halves. A threshold in pixels would densify less the better the camera.
    x, y = np.meshgrid(np.arange(edge), np.arange(edge))

    def loss(u):
        shown, wanted = (
            np.exp(-((x - place) ** 2 + (y - edge / 2) ** 2) / (2 * (edge / 16) ** 2))
            for place in (u, 0.52 * edge)
        )
        return np.abs(shown - wanted).mean()

    step = 1e-3 * edge
    return (loss(edge / 2 + step) - loss(edge / 2 - step)) / (2 * step)


# %%
pulls = {edge: abs(pull(edge)) for edge in (64, 128, 256)}
for edge, value in pulls.items():
    print(f"{edge} px: {value:.2e} a pixel, {value * edge / 2:.2e} in units of half the image")
assert 0 < pulls[256] < pulls[128] < pulls[64], "by pixels the slope has to fall with the resolution"
assert np.isclose(pulls[64] * 32, pulls[128] * 64, rtol=0.05), "in units of half the image it has to stay"
assert config.adc.grad_threshold == 2e-4


# %%
def pull(edge):
    # A splat along one axis only, wider, and a one-sided difference.
    x = np.arange(edge)

    def line(place):
        return np.exp(-(((x - place) / (edge / 10)) ** 2) / 2)

    def loss(u):
        return np.abs(line(u) - line(0.52 * edge)).mean()

    return (loss(edge / 2 + 1e-4 * edge) - loss(edge / 2)) / (1e-4 * edge)
