# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** $\bar\Sigma$ is by each of four entries. What is the derivative by the one number
# $\Sigma_{xy}$ of a matrix that stays symmetric?

# %%
by_xy = Sigma_bar[0, 1] + Sigma_bar[1, 0]

both_entries = np.array([[0.0, 1.0], [1.0, 0.0]])
nudged = differences(lambda xy: shares @ np.linalg.inv(Sigma + xy[0] * both_entries).ravel(), np.zeros(1))
assert np.allclose(nudged, by_xy, rtol=1e-9, atol=0)

# %% [markdown]
# **Exercise 2 (a function).** For a unit quaternion $1 - 2(y^2 + z^2)$ is also $w^2 + x^2 - y^2 - z^2$, and so on along
# the diagonal. Write `other_backward(R_bar, q)` for this form. It has another $\bar n$. Why is $\bar q$ the same?


# %%
def other_backward(R_bar, q):
    w, x, y, z = 2 * q / np.linalg.norm(q)
    by_w, by_x = [[w, -z, y], [z, w, -x], [-y, x, w]], [[x, y, z], [y, -x, -w], [z, w, -x]]
    by_y, by_z = [[-y, x, w], [x, y, z], [-w, z, -y]], [[-z, -w, x], [w, -z, y], [x, y, z]]
    return unit_backward(np.einsum("jik,ik->j", [by_w, by_x, by_y, by_z], R_bar), q)


# The two forms differ by a multiple of |n|² - 1, whose gradient is along n, and unit_backward removes what is along n.
assert np.allclose(
    other_backward(R_bar, central.quats), quat_bar, rtol=0, atol=1e-12 * np.abs(quat_bar).max()
)

# %% [markdown]
# **Exercise 3 (open).** Leave $J$'s derivative out of the mean's gradient. For which Gaussians would nobody notice?

# %%
missing = []
for factor in (0.04, 0.2, 1.0):
    small = near["log_scales"] + np.log(factor)
    x, beside = changed(log_scales=small), changed(log_scales=small, means=near["means"] + 0.2 * factor)
    error = paint([x], camera)[0] - paint([beside], camera)[0]  # the photo has it a little to the side
    u_share, conic_share, *_ = next(screen_slopes([x], camera, error))
    by_position = mean_backward(u_share, np.zeros((2, 3)), x)
    ellipse = 2 * conic_backward(conic_share, x.conic) @ x.N @ (W @ x.M).T
    by_ellipse = mean_backward(np.zeros(2), ellipse, x)
    missing.append(np.linalg.norm(by_ellipse) / np.linalg.norm(by_position + by_ellipse))
    print(f"{factor} of the size: {100 * missing[-1]:.2f} % of the mean's gradient comes through J")
# It shrinks with size over distance: a small splat is moved by its position alone, a large or a near one is not.
assert missing == sorted(missing) and missing[0] < 0.1 * missing[-1]
