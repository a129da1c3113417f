# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** $\bar\Sigma$ is by each of four entries. What is `by_xy`, the derivative by the one number
# $\Sigma_{xy}$ of a matrix that stays symmetric?

# %%
by_xy = Sigma_bar[0, 1] + Sigma_bar[1, 0]

# %%
both_entries = np.array([[0.0, 1.0], [1.0, 0.0]])
nudged = differences(lambda xy: shares @ np.linalg.inv(Sigma + xy[0] * both_entries).ravel(), np.zeros(1))
assert np.allclose(nudged, by_xy, rtol=1e-7, atol=0), f"a difference gives {nudged[0]:.6f}, not {by_xy:.6f}"

# %% [markdown]
# **Exercise 2 (a function).** For a unit quaternion $1 - 2(y^2 + z^2)$ is also $w^2 + x^2 - y^2 - z^2$, and so on along
# the diagonal. Write `other_backward(R_bar, q)` for this form. It has another $\bar n$. Why is $\bar q$ the same?


# %%
def other_backward(R_bar, q):
    # The two forms differ by a multiple of |n|² - 1, whose gradient is along n. unit_backward removes what is along n.
    w, x, y, z = 2 * q / np.linalg.norm(q)
    by_w, by_x = [[w, -z, y], [z, w, -x], [-y, x, w]], [[x, y, z], [y, -x, -w], [z, w, -x]]
    by_y, by_z = [[-y, x, w], [x, y, z], [-w, z, -y]], [[-z, -w, x], [w, -z, y], [x, y, z]]
    return unit_backward(np.einsum("jik,ik->j", [by_w, by_x, by_y, by_z], R_bar), q)


# %%
again_q = other_backward(R_bar, central.quats)
assert np.shape(again_q) == np.shape(quat_bar), (
    f"the gradient of a quaternion has the shape {np.shape(quat_bar)}"
)
assert np.allclose(again_q, quat_bar, rtol=0, atol=1e-10 * np.abs(quat_bar).max()), (
    f"it is {np.round(again_q, 6)}, and the page's form gives {np.round(quat_bar, 6)}"
)

# %% [markdown]
# **Exercise 3 (open).** Leave $J$'s derivative out of the mean's gradient. For which Gaussians would nobody notice?
# Write `missing(factor)`: which part of the gradient of `near`'s mean would be missing if the splat had `factor` times
# its size. You choose the picture to compare with, and how to measure a part.


# %%
def missing(factor):
    # It shrinks with size over distance: a small splat is moved by its position alone, a large or a near one is not.
    small = near["log_scales"] + np.log(factor)
    x, beside = changed(log_scales=small), changed(log_scales=small, means=near["means"] + 0.2 * factor)
    error = paint([x], camera)[0] - paint([beside], camera)[0]  # the photo has it a little to the side
    u_share, conic_share, *_ = next(screen_slopes([x], camera, error))
    by_position = mean_backward(u_share, np.zeros((2, 3)), x)
    ellipse = 2 * conic_backward(conic_share, x.conic) @ x.N @ (W @ x.M).T
    by_ellipse = mean_backward(np.zeros(2), ellipse, x)
    return np.linalg.norm(by_ellipse) / np.linalg.norm(by_position + by_ellipse)


# %%
parts_missing = {factor: missing(factor) for factor in (0.04, 0.2, 1.0)}
for factor, part in parts_missing.items():
    print(f"{factor} of the size: {100 * part:.2f} % of the mean's gradient comes through J")
assert min(parts_missing.values()) > 0, "a part is positive: the derivative of J is never exactly 0 here"
assert list(parts_missing.values()) == sorted(parts_missing.values()), "smaller splats have to miss less"
assert parts_missing[0.04] < 0.1 * parts_missing[1.0], "a splat 25 times smaller should hardly notice"


# %%
def missing(factor):
    # Another photo, and the largest component instead of the length.
    small = near["log_scales"] + np.log(factor)
    moved = near["means"] + np.array([0.3, 0.1, 0]) * factor
    x, beside = changed(log_scales=small), changed(log_scales=small, means=moved)
    u_share, conic_share, *_ = next(
        screen_slopes([x], camera, paint([x], camera)[0] - paint([beside], camera)[0])
    )
    ellipse = 2 * conic_backward(conic_share, x.conic) @ x.N @ (W @ x.M).T
    by_position, by_ellipse = (
        mean_backward(u_share, np.zeros((2, 3)), x),
        mean_backward(np.zeros(2), ellipse, x),
    )
    return np.abs(by_ellipse).max() / np.abs(by_position).max()
