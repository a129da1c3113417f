# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** The pixel (30, 50) of `front_camera` shows a point at depth 7. Where is `found_point`, in
# the camera's axes?

# %%
found_point = 7 * np.array(
    [(30 - front_camera.cx) / front_camera.fx, (50 - front_camera.cy) / front_camera.fy, 1]
)

# %%
assert np.shape(found_point) == (3,), "found_point has three coordinates: right, down and forward"
seen_at = front_camera.project(np.asarray(found_point, dtype=float))
assert np.isclose(seen_at[2], 7), f"its depth is {seen_at[2]:.3f}, not 7"
assert np.allclose(seen_at[:2], [30, 50], rtol=0, atol=1e-9), (
    f"the pixel of your point is ({seen_at[0]:.2f}, {seen_at[1]:.2f})"
)

# %% [markdown]
# **Exercise 2 (a function).** Write `points_needed(distance, share)`: how many points must the list have so that at
# most this share of the pixels in the middle of the ball are holes in its front? The camera is at `distance` from
# the centre. How does the number grow when the surface is half as far away?


# %%
def points_needed(distance, share):
    # The ray in the middle meets the ball at depth distance - 1, squarely: a pixel sees (depth / f)² of 4 pi.
    patch = ((distance - 1) / FX) ** 2 / (4 * np.pi)
    return -np.log(share) / patch  # exp(-n * patch) = share


# %%
# What the page expects in the middle pixel at distance 4, for its list of COUNT points.
in_the_middle = expected_points(near_cameras[1])[0][0, SIZE // 2, SIZE // 2]
for share in (0.01, 0.1):
    holes = np.exp(-in_the_middle * points_needed(4.0, share) / COUNT)
    assert np.isclose(holes, share, rtol=0.02), (
        f"with your number a share of {holes:.3f} are holes, not {share}"
    )
assert np.isclose(points_needed(2.0, 0.01), 4 * points_needed(3.0, 0.01)), (
    "the surface is 1 away instead of 2, so a pixel sees a quarter of the area"
)

# %% [markdown]
# **Exercise 3 (open).** Give the loss a slope. Write `soft_disc(u)`: an image of 24 by 24 pixels, its values between 0
# and 1, of a disc with radius 2.3 around (u, 12). Its squared difference from the disc at 14 must change wherever the
# two overlap. Nothing is said about how. What does your disc not repair?


# %%
def soft_disc(u):
    # Pixels cut into 16 by 16 squares, of which the disc covers those whose centres it contains: still a staircase,
    # with small steps. Where the moved disc and the photo's do not overlap, the loss is constant: a rim reaches nothing
    # beyond itself.
    fine = (np.arange(24 * 16) + 0.5) / 16 - 0.5
    within_disc = (fine - u) ** 2 + (fine[:, None] - 12) ** 2 <= 2.3**2
    return within_disc.reshape(24, 16, 24, 16).mean(axis=(1, 3))


# %%
soft = np.asarray(soft_disc(14.0))
assert soft.shape == (24, 24), f"the image has the shape {soft.shape}"
assert soft.min() >= 0 and soft.max() <= 1, "values are between 0 and 1"
assert soft[12, 14] > 0.9 and soft[12, 4] < 0.05, "it is bright in its middle and dark ten pixels away"
assert np.isclose(soft.sum(), np.pi * 2.3**2, rtol=0.1), "its area is not that of a disc with radius 2.3"
overlapping = np.linspace(11.0, 13.5, 26)
soft_errors = [[((soft_disc(u + h) - soft) ** 2).sum() for h in (-0.01, 0.01)] for u in overlapping]
falling = np.mean([behind > ahead for behind, ahead in soft_errors])
assert falling > 0.9, f"the loss falls towards 14 at {100 * falling:.0f} % of the positions only"


# %%
def soft_disc(u):
    # A rim that fades out over a pixel, by the distance from the centre.
    x = np.arange(24)
    return np.clip(2.3 + 0.5 - np.hypot(x - u, x[:, None] - 12), 0, 1)
