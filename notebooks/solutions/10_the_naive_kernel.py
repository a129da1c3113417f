# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** How many times as fast, `at_best`, could this kernel be if it made only the evaluations that
# matter, each at the same price?

# %%
at_best = counts.evaluated / counts.mattered

# %%
assert np.isclose(at_best * mattered_share, 1), (
    f"of {counts.evaluated:,} evaluations {counts.mattered:,} matter, a share of {mattered_share:.4f}"
)

# %% [markdown]
# **Exercise 2 (a function).** Write `one_pixel(cloud, x, y)`: the kernel's loop in Python, for one pixel, from near to
# far. It returns the colour, three numbers, and the light that is left, and must find what the kernel drew.


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


# %%
for x, y in ((cloud.W // 2, cloud.H // 2), (cloud.W // 3, cloud.H // 2), (1, 1)):
    color, light = one_pixel(cloud, x, y)
    # float32 against float64: the page's median tolerance is below 1e-4
    assert np.allclose(color, drawn.image[y, x], rtol=0, atol=1e-4), (
        f"pixel ({x}, {y}): the kernel drew {drawn.image[y, x].round(4)}, your loop {np.round(color, 4)}"
    )
    assert abs(light - drawn.transmittance[y, x]) < 1e-4, (
        f"pixel ({x}, {y}): the kernel left {drawn.transmittance[y, x]:.4f} of the light, your loop {light:.4f}"
    )

# %% [markdown]
# **Exercise 3 (open).** How many evaluations are left if a pixel stops when less than a ten-thousandth of its light is
# left? Write `asked(log_alpha)`: the number of evaluations, for logarithms of alphas (splats, H, W) from near to far.
# The sphere saves little. Make `opaque`, an array of this kind for at least 50 splats, of a scene that saves nine
# tenths.


# %%
def asked(log_alpha):
    light, evaluations_left = np.ones(log_alpha.shape[1:]), 0
    for layer in log_alpha:
        evaluations_left += int((light >= 1e-4).sum())
        light *= 1 - np.where(layer >= np.log(ALPHA_MIN), np.minimum(0.99, np.exp(layer)), 0)
    return evaluations_left


# The sphere is a thin shell: no ray passes enough of it to go dark early. Walls go dark behind a few splats: layers of
# 0.9 leave a ten-thousandth behind the fourth.
opaque = np.full((100, 8, 8), np.log(0.9))

# %%
left = asked(log_alpha)
print(f"{left:,} of {evaluations:,} evaluations are left, {100 * left / evaluations:.1f} %")
assert 0.5 * evaluations < left <= evaluations, "the sphere saves less than half of its evaluations"
glass = np.full((100, 4, 4), np.log(0.01))
assert asked(glass) == glass.size, "behind 100 layers of glass there is light left: nothing can be saved"
assert asked(np.full((7, 1, 1), np.log(0.95))) == 4, "layers of 0.95 leave 0.05 to the power of their number"
assert np.ndim(opaque) == 3 and len(opaque) >= 50, (
    "opaque has the shape (splats, H, W), with 50 splats or more"
)
assert np.max(opaque) <= 0, "an alpha is not larger than 1"
assert asked(opaque) <= 0.1 * np.size(opaque), f"{100 * asked(opaque) / np.size(opaque):.0f} % are left"


# %%
def asked(log_alpha):
    # The light in front of each splat at once.
    alphas = np.where(log_alpha >= np.log(ALPHA_MIN), np.minimum(0.99, np.exp(log_alpha)), 0)
    behind = np.cumprod(1 - alphas, axis=0)
    return int((np.concatenate([np.ones((1, *behind.shape[1:])), behind[:-1]]) >= 1e-4).sum())


opaque = np.full((60, 3, 5), -0.02)
