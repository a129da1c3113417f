#include "sort.h"

#include <cstring>
#include <type_traits>
#include <utility>
#include <vector>

#include "buffers.h"

namespace gsplat {

// A stable radix sort by the bits of the depths: positive floats have the same order as their bits.
template <class T>
void sort_by_depth(const Splat<T> *splats, const uint32_t *ids, int64_t visible, uint32_t *sorted) {
    using Key = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;
    struct Item {
        Key key;
        uint32_t id;
    };
    constexpr int DIGIT = 11, BINS = 1 << DIGIT;
    const size_t count = size_t(visible);
    Buffer a, b;
    auto *from = static_cast<Item *>(a.reserve((count + 1) * sizeof(Item)));
    auto *to = static_cast<Item *>(b.reserve((count + 1) * sizeof(Item)));
    for (size_t k = 0; k < count; ++k) {
        from[k].id = ids[k];
        std::memcpy(&from[k].key, &splats[from[k].id].depth, sizeof(Key));
    }
    for (int shift = 0; shift < int(8 * sizeof(Key)); shift += DIGIT) {
        std::vector<uint32_t> next(BINS + 1);
        for (size_t k = 0; k < count; ++k) ++next[((from[k].key >> shift) & (BINS - 1)) + 1];
        if (count && next[((from[0].key >> shift) & (BINS - 1)) + 1] == count) continue;  // all keys share this digit
        for (int bin = 0; bin < BINS; ++bin) next[bin + 1] += next[bin];
        for (size_t k = 0; k < count; ++k) to[next[(from[k].key >> shift) & (BINS - 1)]++] = from[k];
        std::swap(from, to);
    }
    for (size_t k = 0; k < count; ++k) sorted[k] = from[k].id;
}

template void sort_by_depth<float>(const Splat<float> *, const uint32_t *, int64_t, uint32_t *);
template void sort_by_depth<double>(const Splat<double> *, const uint32_t *, int64_t, uint32_t *);

}  // namespace gsplat
