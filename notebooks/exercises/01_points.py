# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** The pixel (30, 50) of `front_camera` shows a point at depth 7. Where is the point, in the
# camera's axes?

# %%
found_point = 7 * np.array(
    [(30 - front_camera.cx) / front_camera.fx, (50 - front_camera.cy) / front_camera.fy, 1]
)

assert np.allclose(front_camera.project(found_point), [30, 50, 7], rtol=0, atol=1e-12)

# %% [markdown]
# **Exercise 2 (a function).** Write `points_needed(distance, share)`: how many points must the list have so that at
# most this share of the pixels in the middle of the ball are holes in its front? The camera is at `distance` from
# the centre. Then check that a surface half as far away needs four times as many.


# %%
def points_needed(distance, share):
    # The ray in the middle meets the ball at depth distance - 1, squarely: a pixel sees (depth / f)² of 4 pi.
    patch = ((distance - 1) / FX) ** 2 / (4 * np.pi)
    return -np.log(share) / patch  # exp(-n * patch) = share


in_the_middle = expected_points(near_cameras[1])[0][
    0, SIZE // 2, SIZE // 2
]  # what the page expects at distance 4
assert np.isclose(np.exp(-in_the_middle * points_needed(4.0, 0.01) / COUNT), 0.01)
assert np.isclose(points_needed(2.0, 0.01), 4 * points_needed(3.0, 0.01))

# %% [markdown]
# **Exercise 3 (open).** A disc could cover its rim's pixels in part. Cut each pixel into n by n squares and let the
# disc cover those whose centres it contains. Does the loss get a slope? What happens as n grows, and what does that
# not repair?


# %%
def soft_disc(u, n, radius=2.3):
    fine = (np.arange(24 * n) + 0.5) / n - 0.5
    within_disc = (fine - u) ** 2 + (fine[:, None] - 12) ** 2 <= radius**2
    return within_disc.reshape(24, n, 24, n).mean(axis=(1, 3))


def soft_loss(u, n):
    return ((soft_disc(u, n) - soft_disc(14.0, n)) ** 2).sum()


flat_share = {
    n: np.mean([soft_loss(u + h, n) == soft_loss(u - h, n) for u in positions[::3]]) for n in (1, 4, 16)
}
print("positions where the loss does not change within 0.001 px:", flat_share)
# Still a staircase, with steps that become smaller: in the limit the covered area, which has a slope. But where the
# moved disc and the photo's do not overlap, the loss is constant: a rim reaches nothing beyond itself.
assert flat_share[1] > flat_share[4] > flat_share[16]
assert np.isclose(soft_loss(6.0, 16), soft_loss(7.0, 16), rtol=0.02)
