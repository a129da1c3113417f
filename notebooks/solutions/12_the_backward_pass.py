# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** By how much, `shows_through`, does a pixel behind layers of 0.2, 0.5 and 0.9 change if its
# background becomes lighter by one?

# %%
shows_through = np.prod(1 - np.array([0.2, 0.5, 0.9]))

# %%
three = np.array([0.2, 0.5, 0.9])
lighter_by = pixel(three, colors[:3], background + 1) - pixel(three, colors[:3], background)
assert np.allclose(lighter_by, shows_through), f"the pixel changes by {lighter_by.round(4)}"

# %% [markdown]
# **Exercise 2 (a function).** Write `back_to_front(alphas, colors, background, g)`: the textbook's walk, which
# begins with the last transmittance and what is behind. It must agree with `pixel_gradient`.


# %%
def back_to_front(alphas, colors, background, g):
    light = np.prod(1 - alphas)
    behind, out = light * (background @ g), np.zeros(len(alphas))
    for i in range(len(alphas) - 1, -1, -1):
        light = light / (1 - alphas[i])  # the transmittance in front of layer i
        out[i] = light * (colors[i] @ g) - behind / (1 - alphas[i])
        behind += light * alphas[i] * (colors[i] @ g)
    return out


# %%
draw_layers = np.random.default_rng(120)
for _ in range(20):
    layers, ray = draw_layers.uniform(0, 0.9, 12), draw_layers.normal(size=3)
    by_remainder = pixel_gradient(layers, colors, background, ray)
    by_walk = back_to_front(layers, colors, background, ray)
    assert np.allclose(by_walk, by_remainder, rtol=0, atol=1e-10), (
        f"the largest difference from pixel_gradient is {np.abs(by_walk - by_remainder).max():.2e}"
    )

# %% [markdown]
# **Exercise 3 (open).** Would atomic additions in float64 give the same bits every time, if the result is rounded to
# float32 at the end? Very likely, but it is no promise. Find `unlucky`, float32 numbers whose sum in float64, one
# after the other and rounded to float32 at the end, is another one in another `order` (a permutation of their indices).

# %%
# 1 + 2^-24 lies in the middle between two float32 numbers, and rounds to 1. A little more rounds to the next one up.
# The little more is 256 numbers of 2^-60: added first they make 2^-52, which float64 still adds to 1; one by one behind
# the 1 each of them is lost.
unlucky = np.float32([1, 2**-24] + [2**-60] * 256)
order = np.arange(len(unlucky))[::-1]

# %%
assert unlucky.dtype == np.float32 and np.isfinite(unlucky).all(), "the numbers are finite float32"
assert sorted(order) == list(range(len(unlucky))), "the order names each number once"
sums = [np.float32(np.cumsum(numbers, dtype=np.float64)[-1]) for numbers in (unlucky, unlucky[order])]
print(f"the two sums are {sums[0]:.9f} and {sums[1]:.9f}")
assert sums[0] != sums[1], "both orders give the same float32"

# %%
unlucky = np.float32([-1, -(2**-24)] + [-(2**-58)] * 100)
order = np.roll(np.arange(102), -2)
