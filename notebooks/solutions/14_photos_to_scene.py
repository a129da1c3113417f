# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** How many Gaussians, `fits`, can be trained in 8 GiB, if the numbers of this page were all
# there is?

# %%
fits = 8 * 2**30 // held

# %%
assert int(fits) == fits, "a Gaussian is there or not"
assert fits * held <= 8 * 2**30 < (fits + 1) * held, f"{fits:,} Gaussians hold {fits * held / 2**30:.3f} GiB"

# %% [markdown]
# **Exercise 2 (a function).** Write `essential(first, second)`: the matrix $E$ of two cameras. A point that both
# see must satisfy the equation of this page.


# %%
def essential(first, second):
    R = second.R @ first.R.T  # from the axes of the first to those of the second
    t = second.R @ (first.eye - second.eye)
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return cross @ R


# %%
left, right = truth[names[0]], truth[names[1]]
assert np.linalg.norm(essential(left, right)) > 1e-3, "a matrix of zeros satisfies any equation"
for point in ([0.3, -0.4, 0.2], [-0.5, 0.0, 0.6]):
    x1, x2 = (camera.R @ (np.array(point) - camera.eye) for camera in (left, right))
    x1, x2 = x1 / x1[2], x2 / x2[2]
    missed_by = abs(x2 @ essential(left, right) @ x1)
    assert missed_by < 1e-10, f"for a point that both see the equation gives {missed_by:.1e}, not 0"
    assert abs(x2 @ essential(right, left) @ x1) > 1e-3, "the other way round it is another motion"

# %% [markdown]
# **Exercise 3 (open).** The gain of a photo is a *median* of ratios. What would fool the mean of the ratios, and what
# would fool the median? Write `fools_mean(photo)`, which returns a photo (values from 0 on, as in a camera's raw file)
# with at most a tenth of its pixels changed, whose mean ratio to the original is off by more than 0.05; and
# `fools_median(photo)`, which changes at most three fifths, and after which the median is off by more than 0.05.


# %%
def fools_mean(photo):
    spoiled = photo.copy()
    spoiled[: len(photo) // 12] *= (
        5  # the sun at the top; a passer-by would do as well, if he is bright or dark enough
    )
    return spoiled


def fools_median(photo):
    spoiled = photo.copy()
    spoiled[: int(0.55 * len(photo))] *= 0.5  # a shadow over more than half; a photo that is mostly burnt out
    return spoiled


# %%
plain = np.maximum(photos[names[0]].astype(float) / 255, 0.02)
for fool, most, measure in ((fools_mean, 0.1, np.mean), (fools_median, 0.6, np.median)):
    ratios = fool(plain.copy()) / plain
    assert ratios.shape == plain.shape and ratios.min() >= 0, "it returns a photo, with values from 0 on"
    changed_share = (np.abs(ratios - 1) > 1e-9).any(axis=-1).mean()
    others = [f"{each.__name__} {each(ratios):.3f}" for each in (np.mean, np.median)]
    print(f"{fool.__name__}: {100 * changed_share:.0f} % of the pixels changed, {', '.join(others)}")
    assert changed_share <= most, f"{fool.__name__} changes {100 * changed_share:.0f} % of the pixels"
    assert abs(measure(ratios) - 1) > 0.05, f"the {measure.__name__} of the ratios is {measure(ratios):.3f}"
assert abs(np.median(fools_mean(plain.copy()) / plain) - 1) < 1e-6  # a tenth never fools the median


# %%
def fools_mean(photo):
    spoiled = photo.copy()
    spoiled[::11] *= 3
    return spoiled


def fools_median(photo):
    spoiled = photo.copy()
    spoiled[np.arange(len(photo)) % 9 < 5] *= 1.3
    return spoiled
