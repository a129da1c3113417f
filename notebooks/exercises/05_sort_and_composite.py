# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** A layer of opacity 0.3 stands in front of one of 0.5. Which opacity has a single layer
# that lets as much light through?

# %%
joint = 1 - (1 - 0.3) * (1 - 0.5)

assert np.allclose(front_to_back(np.array([0.3, 0.5]), np.ones((2, 3)), np.zeros(3)), joint)

# %% [markdown]
# **Exercise 2 (a function).** Write `layers_until_dark(alpha)`: behind how many equal layers is the transmittance
# first below `T_STOP`?


# %%
def layers_until_dark(alpha):
    return int(np.floor(np.log(T_STOP) / np.log(1 - alpha))) + 1


for alpha in (ALPHA_MIN, 0.05, 0.5, ALPHA_MAX):
    n = layers_until_dark(alpha)
    print(f"alpha {alpha:.4f}: dark behind {n} layers")
    # At 0.99 two layers leave exactly the limit, up to rounding.
    assert (1 - alpha) ** n < T_STOP * (1 + 1e-9) and (1 - alpha) ** (n - 1) > T_STOP * (1 - 1e-9)

# %% [markdown]
# **Exercise 3 (open).** Sort by the distance from the eye instead of the depth along the axis. Why does the picture
# of the sphere not change at all? Find two splats for which it does. When would you prefer which order?

# %%
to_eye = np.linalg.norm(means - CAMERA.eye, axis=-1)
# The camera looks at the centre of the sphere, and all means are on it: |p - e|² = 1 - 2 p . e + |e|², and p . e is the
# depth turned round. One grows with the other, so the order is the same.
assert np.array_equal(np.argsort(to_eye, kind="stable"), np.argsort(depths, kind="stable"))

# One splat on the axis, one beside it that is a little less deep, but farther away; both large enough to overlap.
camera = view_from(0.0, 0.0)
two = (
    np.array([[0, 0, -1.0], [1.2, 0, -1.1]]),
    np.tile(0.36 * np.eye(3), (2, 1, 1)),
    np.eye(3)[:2],
    np.full(2, 0.9),
)
apart = np.linalg.norm(two[0] - camera.eye, axis=-1)
two_by_distance = splat_image(camera, two, np.argsort(apart))[0]
print(f"two splats: {np.abs(two_by_distance - splat_image(camera, two)[0]).max():.2f}")
assert apart[0] < apart[1] and np.abs(two_by_distance - splat_image(camera, two)[0]).max() > 0.2
# Neither is right where splats pass through each other. The distance stays as it is when the camera turns on the spot,
# so that nothing pops then; the depth is what a projection has at hand.
