# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** The cap of the training `capped` was reached after iteration `full_at`. Which share of all
# its births, `early`, came before? Its changes are in `capped.events`, and `tally` counts.

# %%
early = tally([event for event in capped.events if event.iteration < full_at])[0] / tally(capped.events)[0]

# %%
late = sum(e.num_cloned + e.num_split_children for e in capped.events if e.iteration >= full_at)
every_birth = len(capped.gaussians) - capped.start + tally(capped.events)[1]  # who is there, and who has died
assert 0 < early < 1, f"a share lies between 0 and 1, and is not {early}"
assert np.isclose(early, 1 - late / every_birth), f"{late} of {every_birth} births came later"

# %% [markdown]
# **Exercise 2 (a function).** [Relocation](../docs/GLOSSARY.md#relocation) keeps the integral of alpha along a line
# through the centre. Keep that over the whole ellipse instead: write `area_factor(opacity, count)`, the factor on the
# scales with which `count` equal splats have the integral of the one of this opacity before. Their own opacity is as
# before. Is the factor larger or smaller than that of the line?

# %%
import math


def area_factor(opacity, count):
    # Over an area the k-th power of the shape integrates to 1 / k of the first, and the scale enters squared.
    each = 1 - (1 - opacity) ** (1 / count)
    powers = (math.comb(count, k) * (-1) ** (k + 1) * each**k / k for k in range(1, count + 1))
    return (opacity / sum(powers)) ** 0.5


# %%
radius = np.linspace(0, 12, 24_001)
for o, n in ((0.3, 1), (0.3, 2), (0.9, 2), (0.9, 7)):
    shrunk = np.exp(-((radius / area_factor(o, n)) ** 2) / 2)
    covered = np.trapezoid(radius * (1 - (1 - (1 - (1 - o) ** (1 / n)) * shrunk) ** n), radius)
    assert np.isclose(covered, o, rtol=1e-5), (
        f"{n} splats for one of opacity {o} cover {covered / o:.5f} of its area"
    )
    on_line = shared_shape(torch.tensor([o], dtype=torch.float64), torch.tensor([n]))[1]
    assert n == 1 or area_factor(o, n) > float(on_line), "it is below that of the line"

# %% [markdown]
# **Exercise 3 (open).** A splat with a score of zero may be in the wrong place or of the wrong shape. Write
# `stuck(size)`: a photo, an array of `size` by `size` pixels and three channels of type `np.uint8`, that is very
# different from `ball((0.1, -0.05, 0.15), 0.4, 0.6)`, which every camera of this page sees in the middle of its image,
# and yet pulls it nowhere.


# %%
def stuck(size):
    # Two bright squares, one on either side: each pixel's pull is that of its mirror image, in the other direction.
    photo = np.zeros((size, size, 3), dtype=np.uint8)
    width = 2 * (size // 24)
    for left in (size // 4, size - size // 4 - width):
        photo[(size - width) // 2 : (size + width) // 2, left : left + width] = 255
    return photo


# %%
wrong = SimpleNamespace(camera=view.camera, image=stuck(SIZE))
assert wrong.image.shape == (SIZE, SIZE, 3) and wrong.image.dtype == np.uint8, "it is no such array"
drawing, _, lengths = pulls(ball((0.1, -0.05, 0.15), 0.4, 0.6), wrong)
off = np.abs(drawing - wrong.image / 255).mean()
signed, unsigned = lengths[:, 0].tolist()
print(f"mean difference {off:.3f}; pull {signed:.1e}, sum of absolute values {unsigned:.1e}")
assert wrong.image.max() > 127, "the photo is dark everywhere"
assert off > 0.02, f"the splat differs by {off:.3f} on average, which is not much"
assert signed < 0.03 * unsigned, f"it is pulled: {signed:.1e}, where the absolute values are {unsigned:.1e}"


# %%
def stuck(size):
    # A ring around the middle.
    x = np.arange(size) - (size - 1) / 2
    radius = np.hypot(x, x[:, None])
    ring = (radius > 0.2 * size) & (radius < 0.27 * size)
    return np.repeat(255 * ring[..., None], 3, axis=2).astype(np.uint8)
