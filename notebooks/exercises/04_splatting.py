# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** At which depth on the axis is a ball of standard deviation 0.1 (`ball_cov`) one pixel
# wide for `CAMERA`?

# %%
one_pixel = CAMERA.fx * 0.1

assert np.isclose(project_cov3d(ball_cov, [0, 0, one_pixel], CAMERA)[0, 0], 1)

# %% [markdown]
# **Exercise 2 (a function).** Write `largest_ratio(error, t)`: the largest ratio of standard deviation and depth at
# which the ellipse's variance is off by no more than `error`, seen at slope `t`. Check it with `relative_error`.


# %%
def largest_ratio(error, t):
    return np.sqrt(error / predicted_factor(t))


for t in (0.0, 1.0):
    e = largest_ratio(1e-3, t)
    found_error, noise = relative_error(e, t)
    print(f"slope {t:.0f}: ratio {e:.4f}, error {found_error:.2e} +- {noise:.0e}")
    # four standard errors, and the next term of the series, which the page bounds by 69/8 e² of the first
    assert abs(found_error - 1e-3) < 4 * noise + 69 / 8 * e**2 * 1e-3

# %% [markdown]
# **Exercise 3 (open).** The bound inside $J$ is 1.3 times the image. What would be lost with 1, and what with 10?
# Compare splats just outside the image and splats far beside it.

# %%
just_outside, far_beside = np.array([1.15 * half, 0, 1.0]), balls[0]
widths = {
    limit: [
        np.sqrt(project_cov3d(ball_cov, m, CAMERA, jacobian_limit=limit)[0, 0])
        for m in (just_outside, far_beside)
    ]
    for limit in (1.0, 1.3, 10.0, None)
}
for limit, (near_rim, beside) in widths.items():
    print(f"limit {limit}: just outside {near_rim:.2f} px, far beside {beside:.0f} px")
# At 1 a splat that reaches into the image is already drawn too narrow; 1.3 does not touch it yet. At 10 the splat far
# beside is wider than the image again, several times: it is a bound in name only.
assert widths[1.0][0] < widths[1.3][0] == widths[None][0]
assert widths[1.3][1] < 0.5 * widths[10.0][1] < 0.5 * widths[None][1] and widths[10.0][1] > 3 * CAMERA.W
