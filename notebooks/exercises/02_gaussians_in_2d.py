# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** What is the area of the ellipse at one standard deviation, from the conic alone? Compare
# with `mass`.

# %%
area = np.pi / np.sqrt(np.linalg.det(np.linalg.inv(leaning)))

assert np.isclose(2 * area, mass)

# %% [markdown]
# **Exercise 2 (a function).** Write `after_a_turn(cov2d, angle)`: the covariance of the splat after a turn. A turned
# splat must have at a turned place the value that the splat had at the place.


# %%
def after_a_turn(cov2d, angle):
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return R @ cov2d @ R.T


place = np.array([1.5, -0.7])
quarter = np.array([-place[1], place[0]])
assert np.isclose(
    footprint(after_a_turn(leaning, np.pi / 2), *quarter), footprint(leaning, *place), rtol=1e-12
)

# %% [markdown]
# **Exercise 3 (open).** How small may the dilation be if the light of no splat may vary by more than a percent along
# one axis? Derive it from the formula, check it with `light`, and say what half of it would do.

# %%
# 2 exp(-2 pi² delta) = 0.01, for a splat without any width of its own
enough = np.log(2 / 0.01) / (2 * np.pi**2)
print(f"dilation for one percent: {enough:.3f} px², the page has {DILATION}")
# `light` moves along both axes, so the two ripples add, and their product comes on top.
assert np.abs(light(0.01, enough) - 1).max() < 2.2 * 0.01
# The exponent is halved, so the ripple becomes the root of what it was: fourteen percent in each axis.
assert np.abs(light(0.01, enough / 2) - 1).max() > 0.1
