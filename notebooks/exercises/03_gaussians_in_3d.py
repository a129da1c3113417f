# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** Which quaternion undoes the rotation of `quat`?

# %%
undo = quat * [1, -1, -1, -1]

assert np.allclose(quat_to_R(undo) @ quat_to_R(quat), np.eye(3), rtol=0, atol=1e-14)

# %% [markdown]
# **Exercise 2 (a function).** Write `turn_from(a, b)`: a quaternion that turns the unit vector $a$ into $b$. The
# axis is perpendicular to both. No sine or arc cosine is needed: what does Hamilton's product make of two vectors?
# When does your function fail?


# %%
def turn_from(a, b):
    # b a* = (a . b, a x b) turns by twice the angle; halfway to the identity turns by once the angle.
    return np.array([1 + a @ b, *np.cross(a, b)])


pairs_of_arrows = rng.normal(size=(50, 2, 3))
for a, b in pairs_of_arrows / np.linalg.norm(pairs_of_arrows, axis=-1, keepdims=True):
    # Near b = -a the four numbers are small, and their relative errors large: 1 + a . b is not below 1e-4 here.
    assert np.allclose(quat_to_R(turn_from(a, b)) @ a, b, rtol=0, atol=1e-10)
assert not turn_from(
    np.array([1.0, 0, 0]), np.array([-1.0, 0, 0])
).any()  # opposite: every perpendicular axis would do

# %% [markdown]
# **Exercise 3 (open).** From which distance on would you call the image of the cloud Gaussian? Choose a measure and a
# limit, and defend both.


# %%
def misfit(way):
    """Largest gap between the shares within 1, 2 and 3 sigma and those of a Gaussian."""
    pixels, _ = seen_from(way)
    offset = pixels - pixels.mean(axis=1, keepdims=True)
    distance2 = np.einsum("in,ij,jn->n", offset, np.linalg.inv(np.cov(pixels)), offset)
    return max(abs((distance2 < k * k).mean() - (1 - np.exp(-0.5 * k * k))) for k in (1, 2, 3))


# One percent of the splat's light in the wrong place is about the step of an 8-bit image for a splat of medium
# opacity, and four standard errors of a share of 40,000 samples.
misfits = np.array([misfit(way) for way in ways])
good_from = ways[np.argmax(misfits < 0.01)]
print("gap by distance:", misfits.round(4), f"; below a percent from {good_from:.1f} on")
assert misfits[0] > 0.01 > misfits[-1] and ways[0] < good_from <= ways[-1]
