# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** How many times as fast could this kernel be if it made only the evaluations that matter,
# each at the same price?

# %%
at_best = counts.evaluated / counts.mattered

assert np.isclose(1 / at_best, mattered_share) and at_best > 20

# %% [markdown]
# **Exercise 2 (a function).** Write `one_pixel(cloud, x, y)`: the kernel's loop in Python, for one pixel: four
# numbers, from near to far. It must find what the kernel drew.


# %%
def one_pixel(cloud, x, y):
    light, color = 1.0, np.zeros(3)
    for (u, v), (A, B, C), c, o in zip(
        cloud.means2d, cloud.conics, cloud.colors, cloud.opacities, strict=True
    ):
        dx, dy = float(x - u), float(y - v)
        alpha = min(0.99, o * np.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy))
        if alpha < ALPHA_MIN:
            continue
        color += light * alpha * c
        light -= light * alpha
    return color, light


for x, y in ((cloud.W // 2, cloud.H // 2), (cloud.W // 3, cloud.H // 2), (1, 1)):
    color, light = one_pixel(cloud, x, y)
    # float32 against float64: the page's median tolerance is below 1e-4
    assert np.allclose(color, drawn.image[y, x], rtol=0, atol=1e-4)
    assert abs(light - drawn.transmittance[y, x]) < 1e-4

# %% [markdown]
# **Exercise 3 (open).** How many evaluations would a pixel save that stops when less than a ten-thousandth of the
# light is left? Count them before you write a kernel, and say for which scenes the answer would be another one.

# %%
light, still_asked = np.ones((cloud.H, cloud.W)), 0
for layer in log_alpha:
    still_asked += int((light >= 1e-4).sum())
    light *= 1 - np.where(layer >= np.log(ALPHA_MIN), np.minimum(0.99, np.exp(layer)), 0)
print(f"{still_asked:,} of {evaluations:,} evaluations are left, {100 * still_asked / evaluations:.1f} %")
# The sphere is a thin shell: no ray passes enough of it to go dark early, so stopping saves little. A room of opaque
# walls, or a cloud of many layers, would stop after a few splats.
assert np.abs(light - drawn.transmittance).max() < 1e-4 and 0.5 * evaluations < still_asked <= evaluations
