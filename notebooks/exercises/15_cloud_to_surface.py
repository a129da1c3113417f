# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** At which sum of alphas $\kappa$ is the median depth of a slanted wall without bias? How much
# light does this wall let through?

# %%
unbiased = 2 * np.log(2)

assert abs(bias_law(unbiased)[1]) < 1e-9
assert np.isclose(np.exp(-unbiased), 0.25)  # a quarter: such a wall is far from opaque

# %% [markdown]
# **Exercise 2 (a function).** Write `wall_in_space(count, slant, opacity)`: float64 `Gaussians`, round and flat, with
# the standard deviation `SIZE`, on a wall through the optical axis that is turned about the vertical, at random places
# $|s| \le 0.8$ along it and $|y| \le 0.5$. Render it with `render_maps`. The law holds with
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


front = Camera.looking_at([0, 0, 0], [0, 0, 1], fx=1200, fy=1200, H=65, W=97)
facing = np.array([np.sin(tilt), 0, -np.cos(tilt)])
meets = DISTANCE * facing[2] / (front.rays() @ facing)
for splats_laid in (3_000, 20_000):
    maps, _ = render_maps(wall_in_space(splats_laid, tilt, 0.2), front, DEPTHS, backend="cpu")
    kappa = 2 * np.pi * SIZE**2 * 0.2 * splats_laid / 1.6
    biases = [np.median(maps[kind].numpy() - meets) / (SIZE * np.sin(tilt)) for kind in DEPTHS]
    print(f"alphas {kappa:.1f}: depth {biases[0]:.2f}, median {biases[1]:.2f}, law {bias_law(kappa)}")
    assert np.allclose(biases[:2], bias_law(kappa), rtol=0.15, atol=0)
    assert abs(biases[2]) < 1e-6  # exact up to the pixel's rounding

# %% [markdown]
# **Exercise 3 (open).** What does the truncation cost? Fuse the exact depths with a truncation of 1.5, 3 and 8 voxels,
# and look at the error of each object. Which one needs the smallest truncation, and why?

# %%
table = {}
for voxels in (1.5, 3, 8):
    vertices = crossings(fused(exact_depths, cameras, low, shape, VOXEL, voxels * VOXEL), low, VOXEL)
    owner = np.array([part.name for part in solid.parts])[solid.nearest(vertices)]
    away = np.abs(solid.distance(vertices)) / VOXEL
    table[voxels] = {name: away[owner == name].mean() for name in names}
    print(
        f"truncation {voxels}: " + ", ".join(f"{name} {value:.3f}" for name, value in table[voxels].items())
    )
# All suffer. The votes of a front reach behind the back of what is thinner than the truncation, which are the bowl, the
# rods and the plates between the slots. And `looked_up` takes a jump of depth below the truncation for a surface.
assert all(table[8][name] > table[3][name] for name in names)
