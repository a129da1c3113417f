# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** How many Gaussians can be trained in 8 GiB, if the numbers of this page were all there is?

# %%
fits = 8 * 2**30 // held

assert fits * held <= 8 * 2**30 < (fits + 1) * held

# %% [markdown]
# **Exercise 2 (a function).** Write `essential(first, second)`: the matrix $E$ of two cameras. A point that both
# see must satisfy the equation of this page.


# %%
def essential(first, second):
    R = second.R @ first.R.T  # from the axes of the first to those of the second
    t = second.R @ (first.eye - second.eye)
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return cross @ R


left, right = truth[names[0]], truth[names[1]]
for point in ([0.3, -0.4, 0.2], [-0.5, 0.0, 0.6]):
    x1, x2 = (camera.R @ (np.array(point) - camera.eye) for camera in (left, right))
    x1, x2 = x1 / x1[2], x2 / x2[2]
    assert abs(x2 @ essential(left, right) @ x1) < 1e-12
    assert abs(x2 @ essential(right, left) @ x1) > 1e-3  # the other way round it is another motion

# %% [markdown]
# **Exercise 3 (open).** The gain of a photo is a *median* of ratios. Brighten a photo so that its light parts burn
# out, and compare the median with the mean of the ratios. What else would fool the mean, and what would fool the
# median?

# %%
plain = photos[names[0]].astype(float) / 255
burnt = np.minimum(1.6 * plain, 1)
ratios = burnt[plain > 0.02] / plain[plain > 0.02]
print(f"gain 1.6: median {np.median(ratios):.3f}, mean {ratios.mean():.3f}")
# Burnt-out pixels have any ratio below 1.6 and pull the mean down; so would a passer-by. The median gives way when
# more than half of the pixels are wrong: a photo that is mostly burnt out, or mostly of somebody's back.
assert abs(np.median(ratios) - 1.6) <= abs(ratios.mean() - 1.6)
