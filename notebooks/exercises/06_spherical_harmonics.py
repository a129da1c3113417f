# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** Which coefficient of degree 0 makes a channel 0.8 from everywhere?

# %%
coefficient = (0.8 - SH_OFFSET) / C0

assert np.allclose(eval_sh(0, np.full((1, 1, 3), coefficient), nodes[:1]), 0.8)

# %% [markdown]
# **Exercise 2 (a function).** Write `seen_from_behind(c)`: the 16 coefficients of $f(-d)$, for those of $f(d)$. Which
# degrees does a reflection in the centre change?


# %%
def seen_from_behind(c):
    degrees = np.floor(np.sqrt(np.arange(len(c))))  # the polynomials of degree l have (-1)^l under d -> -d
    return c * (-1.0) ** degrees


some = rng.normal(size=16)
assert np.allclose(sh_basis(-nodes) @ some, sh_basis(nodes) @ seen_from_behind(some), rtol=0, atol=1e-13)

# %% [markdown]
# **Exercise 3 (open).** Files store the 45 numbers behind the first three of a splat in fewer bits. Round each to 8
# bits between the least and the largest of the scene, and say how wrong the picture can get before you look.

# %%
rest = sh[:, 1:]
step = np.ptp(rest) / 255
in_8_bits = sh.copy()
in_8_bits[:, 1:] = rest.min() + step * np.rint((rest - rest.min()) / step)
d = directions_from(camera)
largest_error = np.abs(picture(camera, eval_sh(3, in_8_bits, d)) - picture(camera, eval_sh(3, sh, d))).max()
# Each coefficient is off by half a step at most. The squares of the 15 harmonics sum to 15 / (4 pi) in every
# direction, so their absolute values to at most 15 / sqrt(4 pi). A pixel is a mean of colours.
limit = step / 2 * 15 / np.sqrt(4 * np.pi)
print(f"largest error {largest_error:.5f}, bound {limit:.5f}, a step of an 8-bit image {1 / 255:.5f}")
assert 0 < largest_error <= limit
