# %% [markdown]
# ## Exercises
#
# Write each answer into the cell below its question; the cell behind it says whether it is right.
#
# **Exercise 1 (a line).** In how many lists, `lists_each`, does a splat with a box of `box` pixels appear on average,
# with tiles of `TILE` pixels?

# %%
lists_each = (1 + (box - 1) / TILE) ** 2

# %%
counted = list_length[list(tile_edges).index(TILE)]  # what the page counted
assert abs(lists_each - counted) < 0.05 * counted, f"the page counted {counted:.2f}, not {lists_each:.2f}"

# %% [markdown]
# **Exercise 2 (a function).** A GPU has no use for a sum that is made one after the other. Write
# `exclusive_sum(counts)`: the sum of all counts before each one, in about $\log_2 n$ steps, each of which adds two
# whole arrays.


# %%
def exclusive_sum(counts):
    total, step = np.concatenate([[0], counts[:-1]]), 1
    while step < len(total):
        total = total + np.concatenate([np.zeros(step, int), total[:-step]])
        step *= 2  # each entry holds the sum of the last `step` counts before it
    return total


# %%
few = exclusive_sum(np.array([3, 1, 4, 1, 5]))
assert np.array_equal(few, [0, 3, 4, 8, 9]), f"for 3, 1, 4, 1, 5 the sums are 0, 3, 4, 8, 9, not {few}"
assert np.array_equal(exclusive_sum(length), begin[:-1]), "for the page's lists it finds other beginnings"

# %% [markdown]
# **Exercise 3 (open).** Let an entry of a list cost as much as so many evaluations. Write
# `best_tile(cost_of_entry, box)`: which of `tile_edges` is best for a box of `box` pixels? A tile whose price is within
# a tenth of the least is good enough. How does the answer move with the cost and with the box?


# %%
def best_tile(cost_of_entry, box):
    # With one term falling and one rising, t = (c (box - 1))^(1/3) where their slopes cancel: dear entries and large
    # boxes both want larger tiles, but only by the cube root.
    prices = cost_of_entry * (1 + (box - 1) / tile_edges) ** 2 + (tile_edges + box - 1) ** 2
    return int(tile_edges[np.argmin(prices)])


# %%
def price(tile, cost_of_entry, box):
    """Entries of a splat, and evaluations in the tiles that list it, at random places of its box."""
    places = np.arange(tile)
    tiles_along = (places + box - 1) // tile + 1  # tiles along one axis by the box's place in its first tile
    number = tiles_along.mean() ** 2
    return cost_of_entry * number + number * tile**2


for cost in (1, 30, 100, 300, 1000, 10_000):
    for pixels in (9, 21):
        chosen = best_tile(cost, pixels)
        assert chosen in tile_edges, f"{chosen} is not one of {list(tile_edges)}"
        cheapest = min(price(int(tile), cost, pixels) for tile in tile_edges)
        assert price(chosen, cost, pixels) < 1.1 * cheapest, (
            f"at cost {cost} and a box of {pixels} px, tiles of {chosen} px are "
            f"{price(chosen, cost, pixels) / cheapest:.2f} times as dear as the best"
        )


# %%
def best_tile(cost_of_entry, box):
    return int(min(tile_edges, key=lambda tile: abs(tile - (cost_of_entry * (box - 1)) ** (1 / 3))))
