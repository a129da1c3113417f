# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** Which `coefficient` of degree 0 makes a channel 0.8 from everywhere?

# %%
coefficient = (0.8 - SH_OFFSET) / C0

# %%
channel = eval_sh(0, np.full((1, 1, 3), coefficient), nodes[:1])
assert np.allclose(channel, 0.8), f"with your coefficient the channel is {channel[0, 0]:.3f}"

# %% [markdown]
# **Exercise 2 (a function).** Write `seen_from_behind(c)`: the 16 coefficients of $f(-d)$, for those of $f(d)$. Which
# degrees does a reflection in the centre change?


# %%
def seen_from_behind(c):
    degrees = np.floor(np.sqrt(np.arange(len(c))))  # the polynomials of degree l have (-1)^l under d -> -d
    return c * (-1.0) ** degrees


# %%
some = rng.normal(size=16)
assert np.shape(seen_from_behind(some)) == (16,), "there are 16 coefficients"
assert np.allclose(sh_basis(-nodes) @ some, sh_basis(nodes) @ seen_from_behind(some), rtol=0, atol=1e-12), (
    "with your coefficients a direction does not show what the opposite direction showed"
)

# %% [markdown]
# **Exercise 3 (open).** Files store the 45 numbers behind the first three of a splat in fewer bits. Make `in_8_bits`:
# `sh` with at most 256 different values of each of the 45 numbers, and the first three as they are. Before you look,
# say how wrong the picture can get: `bound`, which holds for every scene that is rounded like this, and is not a
# hundred times too large.

# %%
rest = sh[:, 1:]
step = np.ptp(rest) / 255
in_8_bits = np.concatenate([sh[:, :1], rest.min() + step * np.rint((rest - rest.min()) / step)], axis=1)
# Each coefficient is off by half a step at most. The squares of the 15 harmonics sum to 15 / (4 pi) in every
# direction, so their absolute values to at most 15 / sqrt(4 pi). A pixel is a mean of colours.
bound = step / 2 * 15 / np.sqrt(4 * np.pi)

# %%
assert np.shape(in_8_bits) == sh.shape and np.array_equal(in_8_bits[:, 0], sh[:, 0]), "the first three stay"
kinds = max(len(np.unique(column)) for column in in_8_bits[:, 1:].reshape(len(sh), -1).T)
assert kinds <= 256, f"one of the 45 numbers has {kinds} different values"
d = directions_from(camera)
largest_error = np.abs(picture(camera, eval_sh(3, in_8_bits, d)) - picture(camera, eval_sh(3, sh, d))).max()
print(f"largest error {largest_error:.5f}, your bound {bound:.5f}, a step of an 8-bit image {1 / 255:.5f}")
assert 0 < largest_error <= bound, "the picture is further off than your bound says, or not rounded at all"
assert bound < 100 * largest_error, "your bound is more than a hundred times too large"

# %%
# Each of the 45 numbers between its own least and largest value, and the bound by the largest of the steps.
columns = sh[:, 1:].reshape(len(sh), -1)
steps = np.ptp(columns, axis=0) / 255
rounded = columns.min(axis=0) + steps * np.rint((columns - columns.min(axis=0)) / steps)
in_8_bits = np.concatenate([sh[:, :1], rounded.reshape(sh[:, 1:].shape)], axis=1)
bound = steps.max() / 2 * 15 / np.sqrt(4 * np.pi)
