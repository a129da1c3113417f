# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** Make `larger_by_a_tenth`: the scene `trained` with every splat a tenth larger in each
# direction. `trained` itself stays as it is; exercise 2 draws it.

# %%
larger_by_a_tenth = Gaussians(**trained.tensors() | {"log_scales": trained.log_scales + np.log(1.1)})

# %%
growth = larger_by_a_tenth.scales / trained.scales
assert torch.allclose(growth, torch.full_like(growth, 1.1)), f"splats grew by up to {float(growth.max()):.2f}"
assert torch.equal(larger_by_a_tenth.means, trained.means), "the places of the splats have changed"

# %% [markdown]
# **Exercise 2 (a function).** Write `without_faint(gaussians, floor)`: the scene without splats whose opacity is
# below `floor`. At which floor must the picture stay the same to the last bit, and why?


# %%
def without_faint(gaussians, floor):
    # A splat whose opacity is below 1/255 has no alpha above the floor, at any pixel: it is never composited.
    keep = gaussians.opacities >= floor
    return gaussians.map(lambda tensor: tensor[keep])


# %%
for floor in (1 / 255, 0.05, 0.2):
    fewer = without_faint(trained, floor)
    assert len(fewer) == int((trained.opacities >= floor).sum()), (
        f"floor {floor:.3f}: {len(fewer)} splats are left"
    )
    again = render(fewer, held_out, backend="cpu").image.numpy()
    print(
        f"opacity {floor:.3f} and more: {len(fewer)} splats, largest change {np.abs(again - by_kernels).max():.4f}"
    )
    assert floor > 1 / 255 or np.array_equal(again, by_kernels), (
        "without invisible splats the picture changed"
    )

# %% [markdown]
# **Exercise 3 (open).** Which kind of number has to be stored most exactly? Write `quality_without(key, amount)`: the
# PSNR, against `by_kernels`, of the picture of `trained` after one of its tensors was disturbed by so large a part of
# its own spread. Which spread, which noise? What does the ranking not say?


# %%
def quality_without(key, amount):
    # Standard deviations and normal noise. The ranking compares spreads, not bits, and it is one of this scene: large
    # splats would forgive their means more.
    values = trained.tensors()[key]
    noise = torch.randn(values.shape, generator=torch.Generator().manual_seed(70))
    noisy = trained.tensors() | {key: values + amount * values.std() * noise}
    return psnr(
        render(Gaussians(**noisy), held_out, backend="cpu").image.numpy().clip(0, 1),
        np.clip(by_kernels, 0, 1),
    )


# %%
ranking = {key: quality_without(key, 0.01) for key, values in trained.tensors().items() if values.numel()}
for key in sorted(ranking, key=ranking.get):
    print(f"{key:>15}: {ranking[key]:.1f} dB")
assert max(ranking.values()) < 100, "one of the kinds was not disturbed"
assert all(quality_without(key, 0.1) < ranking[key] for key in ranking), "more noise has to do more harm"
# The means suffer most: a hundredth of the scene's size is a pixel or so, and edges are where they are.
assert min(ranking, key=ranking.get) == "means", "with the usual spreads the means are the most sensitive"


# %%
def quality_without(key, amount):
    # Uniform noise of the width of the middle half.
    values = trained.tensors()[key]
    width = values.quantile(0.75) - values.quantile(0.25)
    noise = torch.rand(values.shape, generator=torch.Generator().manual_seed(7)) - 0.5
    image = render(
        Gaussians(**trained.tensors() | {key: values + amount * width * noise}), held_out, backend="cpu"
    )
    return psnr(image.image.numpy().clip(0, 1), np.clip(by_kernels, 0, 1))
