# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** At which sum of alphas $\kappa$, `unbiased`, is the median depth of a slanted wall without
# bias? How much light does this wall let through?

# %%
unbiased = 2 * np.log(2)  # it lets a quarter through: such a wall is far from opaque

# %%
assert unbiased > 0, "a sum of alphas is positive"
assert abs(bias_law(unbiased)[1]) < 1e-6, f"at your sum the bias of the median is {bias_law(unbiased)[1]:.4f}"

# %% [markdown]
# **Exercise 2 (a function).** Write `wall_in_space(count, slant, opacity)`: float64 `Gaussians`, round and flat, with
# the standard deviation `SIZE`, on a wall through the optical axis that is turned about the vertical, at random places
# $|s| \le 0.8$ along it and $|y| \le 0.5$. It is rendered with `render_maps`. The law holds with
# $\kappa = 2\pi\sigma^2\rho\,o$ and $\rho$ splats per unit of area. Is the planar depth still exact?

# %%
from gsplat_edu.scene.gaussians import Gaussians


def wall_in_space(count, slant, opacity):
    s, y = rng.uniform(-0.8, 0.8, count), rng.uniform(-0.5, 0.5, count)
    means = np.stack([s * np.cos(slant), y, DISTANCE + s * np.sin(slant)], axis=1)
    quat = torch.tensor([np.cos(slant / 2), 0, -np.sin(slant / 2), 0])
    logs = torch.tensor(np.log([SIZE, SIZE, 1e-4]))
    return Gaussians(
        means=torch.tensor(means),
        quats=quat.repeat(count, 1),
        log_scales=logs.repeat(count, 1),
        sh0=torch.zeros(count, 1, 3, dtype=torch.float64),
        sh_rest=torch.zeros(count, 0, 3, dtype=torch.float64),
        logit_opacities=torch.full((count,), np.log(opacity / (1 - opacity)), dtype=torch.float64),
    )


# %%
front = Camera.looking_at([0, 0, 0], [0, 0, 1], fx=1200, fy=1200, H=65, W=97)
facing = np.array([np.sin(tilt), 0, -np.cos(tilt)])
meets = DISTANCE * facing[2] / (front.rays() @ facing)
for splats_laid in (3_000, 20_000):
    wall = wall_in_space(splats_laid, tilt, 0.2)
    assert len(wall) == splats_laid, f"the wall has {len(wall)} splats, not {splats_laid}"
    maps, _ = render_maps(wall, front, DEPTHS, backend="cpu")
    kappa = 2 * np.pi * SIZE**2 * 0.2 * splats_laid / 1.6
    biases = [np.median(maps[kind].numpy() - meets) / (SIZE * np.sin(tilt)) for kind in DEPTHS]
    print(f"alphas {kappa:.1f}: depth {biases[0]:.2f}, median {biases[1]:.2f}, law {bias_law(kappa)}")
    assert np.allclose(biases[:2], bias_law(kappa), rtol=0.15, atol=0), (
        f"depth and median are off by {biases[0]:.2f} and {biases[1]:.2f}, and the law says {bias_law(kappa)}"
    )
    assert abs(biases[2]) < 1e-6, f"the planar depth is off by {biases[2]:.1e}: splats are not in the wall"

# %% [markdown]
# **Exercise 3 (open).** What does the truncation cost? Write `mean_errors(voxels)`: for each object's name, the mean
# distance of the fused surface from the truth, in voxels, with the exact depths and a truncation of so many voxels.
# How is a vertex given to an object? Which object needs the smallest truncation, and why?


# %%
def mean_errors(voxels):
    # All suffer. The votes of a front reach behind the back of what is thinner than the truncation, which are the
    # bowl, the rods and the plates between the slots. And `looked_up` takes a jump of depth below the truncation for
    # a surface.
    vertices = crossings(fused(exact_depths, cameras, low, shape, VOXEL, voxels * VOXEL), low, VOXEL)
    owner = np.array([part.name for part in solid.parts])[solid.nearest(vertices)]
    away = np.abs(solid.distance(vertices)) / VOXEL
    return {name: away[owner == name].mean() for name in names}


# %%
table = {voxels: mean_errors(voxels) for voxels in (1.5, 3, 8)}
for voxels, errors in table.items():
    print(f"truncation {voxels}: " + ", ".join(f"{name} {value:.3f}" for name, value in errors.items()))
assert all(set(errors) == set(names) for errors in table.values()), f"name each of {', '.join(names)}"
assert all(0 < value < 8 for errors in table.values() for value in errors.values()), "errors are in voxels"
assert sum(table[8][name] > 1.2 * table[3][name] for name in names) >= 4, (
    "a truncation of 8 voxels is worse by a fifth for at least four of the five objects"
)


# %%
def mean_errors(voxels):
    # Every third vertex is enough.
    vertices = crossings(fused(exact_depths, cameras, low, shape, VOXEL, voxels * VOXEL), low, VOXEL)[::3]
    named, away = np.array([part.name for part in solid.parts]), np.abs(solid.distance(vertices)) / VOXEL
    return {name: away[named[solid.nearest(vertices)] == name].mean() for name in names}
