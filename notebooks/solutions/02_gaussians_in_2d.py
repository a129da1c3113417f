# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** What is the `area` of the ellipse of `leaning` at one standard deviation, from the conic
# alone? How does it compare with `mass`?

# %%
area = np.pi / np.sqrt(np.linalg.det(np.linalg.inv(leaning)))

# %%
around = np.linspace(0, 2 * np.pi, 2001)
outline = np.linalg.cholesky(leaning) @ [np.cos(around), np.sin(around)]
enclosed = 0.5 * abs(np.sum(outline[0, :-1] * outline[1, 1:] - outline[0, 1:] * outline[1, :-1]))
assert np.isclose(area, enclosed, rtol=1e-4), (
    f"a polygon along the ellipse encloses {enclosed:.3f} px², not {area:.3f}"
)
assert np.isclose(2 * area, mass), "the mass of a splat is twice the area"

# %% [markdown]
# **Exercise 2 (a function).** Write `after_a_turn(cov2d, angle)`: the covariance of the splat after a turn from x to y.
# A turned splat must have at a turned place the value that the splat had at the place.


# %%
def after_a_turn(cov2d, angle):
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return R @ cov2d @ R.T


# %%
assert np.shape(after_a_turn(leaning, 0.3)) == (2, 2), "a covariance is a matrix of 2 by 2"
for angle in (0.0, 0.4, np.pi / 2, -2.0):
    there = np.array([1.5, -0.7])
    moved = np.cos(angle) * there + np.sin(angle) * np.array([-there[1], there[0]])
    assert np.isclose(
        footprint(after_a_turn(leaning, angle), *moved), footprint(leaning, *there), rtol=1e-9
    ), f"after a turn by {angle:.1f} the value at the turned place is another one"

# %% [markdown]
# **Exercise 3 (open).** How small may the dilation be if the light of no splat may vary by more than a given share
# along one axis? Write `dilation_for(ripple)`, for shares from 0.002 to 0.2: from a formula, or by a search with
# `light`. A dilation a tenth larger than needed is good enough, a smaller one is not. What would half of it do?


# %%
def dilation_for(ripple):
    # 2 exp(-2 pi² delta) = ripple, for a splat without any width of its own. At half of it the ripple becomes the root
    # of what it was, but for the factor 2: fourteen percent instead of one.
    return np.log(2 / ripple) / (2 * np.pi**2)


# %%
for ripple in (0.002, 0.01, 0.05, 0.2):
    # `light` moves along both axes, so two ripples add, and their product comes on top.
    at_yours, at_less = (np.abs(light(0.01, part * dilation_for(ripple)) - 1).max() for part in (1, 0.9))
    assert at_yours < 2 * ripple + ripple**2 + 0.02 * ripple, (
        f"with your dilation for {ripple} the light varies by {at_yours:.4f} along both axes together"
    )
    assert at_less > 2 * ripple, f"nine tenths of your dilation for {ripple} would do as well"


# %%
def dilation_for(ripple):
    # By bisection: two ripples, and their product.
    low, high = 0.01, 2.0
    for _ in range(40):
        middle = (low + high) / 2
        if np.abs(light(0.01, middle) - 1).max() <= 2 * ripple + ripple**2:
            high = middle
        else:
            low = middle
    return high
