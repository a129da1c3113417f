# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** A layer of opacity 0.3 stands in front of one of 0.5. Which opacity, `joint`, has a single
# layer that lets as much light through?

# %%
joint = 1 - (1 - 0.3) * (1 - 0.5)

# %%
white_on_black = front_to_back(np.array([0.3, 0.5]), np.ones((2, 3)), np.zeros(3))
assert np.allclose(front_to_back(np.array([joint]), np.ones((1, 3)), np.zeros(3)), white_on_black), (
    "one white layer of your opacity on black is not as bright as the two"
)

# %% [markdown]
# **Exercise 2 (a function).** Write `layers_until_dark(alpha)`: behind how many equal layers is the transmittance
# first below `T_STOP`?


# %%
def layers_until_dark(alpha):
    return int(np.floor(np.log(T_STOP) / np.log(1 - alpha))) + 1


# %%
for alpha in (ALPHA_MIN, 0.05, 0.5, ALPHA_MAX):
    n = layers_until_dark(alpha)
    print(f"alpha {alpha:.4f}: dark behind {n} layers")
    # At 0.99 two layers leave exactly the limit, up to rounding.
    assert (1 - alpha) ** n < T_STOP * (1 + 1e-9), f"behind {n} layers of {alpha:.4f} it is not dark yet"
    assert (1 - alpha) ** (n - 1) > T_STOP * (1 - 1e-9), f"a layer of {alpha:.4f} less would be dark, too"

# %% [markdown]
# **Exercise 3 (open).** Sort by the distance from the eye instead of the depth along the axis. Why does the picture
# of the sphere not change at all? Find two splats for which it does: `two`, their means (2, 3), covariances (2, 3, 3),
# colours (2, 3) and opacities (2,), in front of `view_from(0.0, 0.0)`. A pixel has to change by a tenth. When would
# you prefer which order?

# %%
# The camera of the sphere looks at its centre, and all means are on it: |p - e|² = 1 - 2 p . e + |e|², and p . e is the
# depth turned round. One grows with the other, so the order is the same.
# Here one splat is on the axis, and one beside it is a little less deep, but farther away; both are large enough to
# overlap. Neither order is right where splats pass through each other. The distance stays as it is when the camera
# turns on the spot, so that nothing pops then; the depth is what a projection has at hand.
two = (
    np.array([[0, 0, -1.0], [1.2, 0, -1.1]]),
    np.tile(0.36 * np.eye(3), (2, 1, 1)),
    np.eye(3)[:2],
    np.full(2, 0.9),
)

# %%
to_eye = np.linalg.norm(means - CAMERA.eye, axis=-1)
assert np.array_equal(np.argsort(to_eye, kind="stable"), np.argsort(depths, kind="stable"))  # the sphere's
camera = view_from(0.0, 0.0)
assert [np.shape(part) for part in two] == [(2, 3), (2, 3, 3), (2, 3), (2,)], "the parts have other shapes"
apart = np.linalg.norm(two[0] - camera.eye, axis=-1)
two_by_distance = splat_image(camera, two, np.argsort(apart))[0]
change = np.abs(two_by_distance - splat_image(camera, two)[0]).max()
assert change > 0.1, f"by distance, no pixel of your two splats changes by more than {change:.3f}"

# %%
two = (
    np.array([[-0.3, 0.1, -0.9], [1.4, 0.2, -1.0]]),
    np.tile(0.5 * np.eye(3), (2, 1, 1)),
    np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    np.array([0.8, 0.95]),
)
