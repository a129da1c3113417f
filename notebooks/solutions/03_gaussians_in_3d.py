# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** Which quaternion, `undo`, reverses the rotation of `quat`?

# %%
undo = quat * [1, -1, -1, -1]

# %%
assert np.shape(undo) == (4,), "a quaternion has four numbers: w, x, y, z"
assert np.allclose(quat_to_R(np.asarray(undo)) @ quat_to_R(quat), np.eye(3), rtol=0, atol=1e-12), (
    "one rotation behind the other is not the identity"
)

# %% [markdown]
# **Exercise 2 (a function).** Write `turn_from(a, b)`: a quaternion that turns the unit vector $a$ into $b$. The
# axis is perpendicular to both. No sine or arc cosine is needed: what does Hamilton's product make of two vectors?
# When does your function fail?


# %%
def turn_from(a, b):
    # b a* = (a . b, a x b) turns by twice the angle; halfway to the identity turns by once the angle. For opposite
    # vectors all four numbers are 0: every perpendicular axis would do.
    return np.array([1 + a @ b, *np.cross(a, b)])


# %%
pairs_of_arrows = rng.normal(size=(50, 2, 3))
for a, b in pairs_of_arrows / np.linalg.norm(pairs_of_arrows, axis=-1, keepdims=True):
    R = quat_to_R(turn_from(a, b))
    # Near b = -a the four numbers are small, and their relative errors large: 1 + a . b is not below 1e-4 here.
    assert np.allclose(R @ a, b, rtol=0, atol=1e-8), (
        f"{a.round(2)} becomes {(R @ a).round(2)}, not {b.round(2)}"
    )
    axis = np.cross(a, b)
    assert np.allclose(R @ axis, axis, rtol=0, atol=1e-8), "the axis of the turn is not perpendicular to both"

# %% [markdown]
# **Exercise 3 (open).** From which distance on would you call the image of the cloud Gaussian? Choose a measure and a
# limit, and defend both. Write `misfit(way)`, which is 0 or larger and becomes smaller the more Gaussian the pixels of
# `seen_from(way)` are, and `good_enough`, the limit below which you call them so.


# %%
def misfit(way):
    """Largest gap between the shares within 1, 2 and 3 sigma and those of a Gaussian."""
    pixels, _ = seen_from(way)
    offset = pixels - pixels.mean(axis=1, keepdims=True)
    distance2 = np.einsum("in,ij,jn->n", offset, np.linalg.inv(np.cov(pixels)), offset)
    return max(abs((distance2 < k * k).mean() - (1 - np.exp(-0.5 * k * k))) for k in (1, 2, 3))


# One percent of the splat's light in the wrong place is about the step of an 8-bit image for a splat of medium
# opacity, and four standard errors of a share of 40,000 samples.
good_enough = 0.01

# %%
misfits = np.array([misfit(way) for way in ways])
assert misfits.min() >= 0, "a measure of a misfit is not negative"
assert misfits[0] > good_enough > misfits[-1], "the nearest cloud is not Gaussian, and the farthest is"
good_from = ways[np.argmax(misfits < good_enough)]
print("misfit by distance:", misfits.round(4), f"; Gaussian from {good_from:.1f} on")
places = [np.argsort(np.argsort(values)) for values in (ways, -misfits)]
assert np.corrcoef(*places)[0, 1] > 0.8, "farther away, your measure does not become smaller"


# %%
def misfit(way):
    # Skewness and excess kurtosis along rows and columns, which are 0 for a Gaussian.
    pixels, _ = seen_from(way)
    z = (pixels - pixels.mean(axis=1, keepdims=True)) / pixels.std(axis=1, keepdims=True)
    return float(np.abs((z**4).mean(axis=1) - 3).max() + np.abs((z**3).mean(axis=1)).max())


good_enough = 0.2
