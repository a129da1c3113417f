// A list of splats for every tile, each near to far, by counting: nothing is sorted again.
#pragma once

#include <algorithm>
#include <vector>

#include "splats.h"

struct Lists {
    int32_t across, down;        // tiles
    std::vector<int64_t> begin;  // where each tile's list starts, and behind the last one
    std::vector<int32_t> splat;  // the lists, one behind the other
};

// `tiles_of(i, visit)` calls visit(row, first, last) for each row of tiles that splat i meets.
template <class TilesOf>
Lists make_lists(const Splats &s, TilesOf tiles_of) {
    Lists lists{(s.W + TILE - 1) / TILE, (s.H + TILE - 1) / TILE, {}, {}};
    lists.begin.assign(int64_t(lists.across) * lists.down + 1, 0);
    int64_t *count = lists.begin.data() + 1;
    const auto each = [&](auto action) {
        for (int64_t i = 0; i < s.count; ++i)
            tiles_of(i, [&](int row, int first, int last) {
                for (int column = first; column <= last; ++column) action(row * lists.across + column, i);
            });
    };
    each([&](int64_t tile, int64_t) { ++count[tile]; });
    for (size_t tile = 1; tile < lists.begin.size(); ++tile) lists.begin[tile] += lists.begin[tile - 1];
    lists.splat.resize(lists.begin.back());
    std::vector<int64_t> next(lists.begin.begin(), lists.begin.end() - 1);
    each([&](int64_t tile, int64_t i) { lists.splat[next[tile]++] = int32_t(i); });
    return lists;
}

// Clamps a range of pixels to the screen before it becomes integer.
inline int clamped(float x, int size) { return int(std::fmin(std::fmax(x, -1.0f), float(size))); }
