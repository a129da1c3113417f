# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** By how much does a pixel behind layers of 0.2, 0.5 and 0.9 change if its background becomes
# lighter by one?

# %%
shows_through = np.prod(1 - np.array([0.2, 0.5, 0.9]))

three = np.array([0.2, 0.5, 0.9])
assert np.allclose(
    pixel(three, colors[:3], background + 1) - pixel(three, colors[:3], background), shows_through
)

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


draw_layers = np.random.default_rng(120)
for _ in range(20):
    layers, ray = draw_layers.uniform(0, 0.9, 12), draw_layers.normal(size=3)
    by_remainder = pixel_gradient(layers, colors, background, ray)
    assert np.allclose(back_to_front(layers, colors, background, ray), by_remainder, rtol=0, atol=1e-12)

# %% [markdown]
# **Exercise 3 (open).** Would atomic additions in float64 give the same bits every time, if the result is rounded to
# float32 at the end? Try many orders, and say what you have shown and what not.

# %%
parts = draw_layers.normal(size=5000).astype(np.float32)
shuffled = [draw_layers.permutation(parts) for _ in range(50)]
single = {float(np.cumsum(order, dtype=np.float32)[-1]) for order in shuffled}
double = {float(np.float32(np.cumsum(order, dtype=np.float64)[-1])) for order in shuffled}
print(f"50 orders: {len(single)} sums in float32, {len(double)} when added in float64 and rounded")
# Very likely one result, but no promise: the sums in float64 differ in their last bits too, and if they lie on both
# sides of a boundary between two floats, rounding separates them. Over millions of sums that happens.
assert len(double) < len(single) and len(single) > 10
