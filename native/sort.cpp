#include "sort.h"

#include <algorithm>
#include <utility>

#include "buffers.h"
#include "scan.h"
#include "threads.h"

namespace gsplat {
namespace {

constexpr int DIGIT = 11, BINS = 1 << DIGIT;
constexpr int64_t CHUNK = 1 << 13;  // keys per task at least: four times the bins

}  // namespace

// A radix sort, least digit first. Every chunk of keys counts its digits; the running sums of the counts, digit by digit and
// chunk by chunk within each, are where it writes them. So the order is the same for any number of chunks.
template <class T>
void sort_by_depth(int threads, int64_t count, DepthKey<T> *keys, uint32_t *sorted) {
    const int64_t chunks = std::clamp<int64_t>(count / CHUNK, 1, 2 * int64_t(threads));
    auto begin = [&](int64_t chunk) { return count * chunk / chunks; };
    Buffer other, table;
    DepthKey<T> *from = keys, *to = static_cast<DepthKey<T> *>(other.reserve(size_t(count + 1) * sizeof(DepthKey<T>)));
    auto *places = static_cast<uint32_t *>(table.reserve(size_t(chunks) * BINS * 4));
    for (int shift = 0; shift < int(8 * sizeof keys->key); shift += DIGIT) {
        auto digit = [&](const DepthKey<T> &item) { return size_t(item.key >> shift) & (BINS - 1); };
        parallel(threads, chunks, [&](int64_t chunk, int) {
            uint32_t counts[BINS] = {};
            for (int64_t k = begin(chunk); k < begin(chunk + 1); ++k) ++counts[digit(from[k])];
            for (int64_t bin = 0; bin < BINS; ++bin) places[bin * chunks + chunk] = counts[bin];
        });
        exclusive_sums(threads, BINS * chunks, places);
        parallel(threads, chunks, [&](int64_t chunk, int) {
            uint32_t next[BINS];
            for (int64_t bin = 0; bin < BINS; ++bin) next[bin] = places[bin * chunks + chunk];
            for (int64_t k = begin(chunk); k < begin(chunk + 1); ++k) to[next[digit(from[k])]++] = from[k];
        });
        std::swap(from, to);
    }
    parallel(threads, chunks, [&](int64_t chunk, int) {
        for (int64_t k = begin(chunk); k < begin(chunk + 1); ++k) sorted[k] = from[k].id;
    });
}

template void sort_by_depth<float>(int, int64_t, DepthKey<float> *, uint32_t *);
template void sort_by_depth<double>(int, int64_t, DepthKey<double> *, uint32_t *);

}  // namespace gsplat
