# %% [markdown]
# ## Exercises
#
# **Exercise 1 (a line).** In how many lists does a splat with a box of `box` pixels appear on average, with tiles
# of `TILE` pixels?

# %%
lists_each = (1 + (box - 1) / TILE) ** 2

assert (
    abs(lists_each - list_length[list(tile_edges).index(TILE)]) < 0.05 * lists_each
)  # what the page counted

# %% [markdown]
# **Exercise 2 (a function).** A GPU has no use for a sum that is made one after the other. Write
# `exclusive_sum(counts)`: the prefix sum in about $\log_2 n$ steps, each of which adds two whole arrays.


# %%
def exclusive_sum(counts):
    total, step = np.concatenate([[0], counts[:-1]]), 1
    while step < len(total):
        total = total + np.concatenate([np.zeros(step, int), total[:-step]])
        step *= 2  # each entry holds the sum of the last `step` counts before it
    return total


assert np.array_equal(exclusive_sum(length), begin[:-1])

# %% [markdown]
# **Exercise 3 (open).** Let an entry of a list cost as much as $c$ evaluations. Which tile is best for a box of `box`
# pixels, and how does the answer move with $c$ and with the box?


# %%
def best_tile(cost_of_entry, box):
    prices = cost_of_entry * (1 + (box - 1) / tile_edges) ** 2 + (tile_edges + box - 1) ** 2
    return int(tile_edges[np.argmin(prices)])


choices = {cost: best_tile(cost, box) for cost in (1, 30, 100, 300, 1000, 10_000)}
print("best tile by the cost of an entry:", choices)
# With one term falling and one rising, t = (c (box - 1))^(1/3) where their slopes cancel: dear entries and large
# boxes both want larger tiles, but only by the cube root.
assert list(choices.values()) == sorted(choices.values()) and TILE in choices.values()
for cost, tile in choices.items():
    ideal = np.clip((cost * (box - 1)) ** (1 / 3), tile_edges[0], tile_edges[-1])
    assert ideal / 2 < tile < 2 * ideal
