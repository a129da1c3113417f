#include "scan.h"

#include <utility>
#include <vector>

#include "threads.h"

namespace gsplat {

uint64_t exclusive_sums(int threads, int64_t count, uint32_t *numbers) {
    constexpr int64_t RANGE = 1 << 14;
    const int64_t ranges = (count + RANGE - 1) / RANGE;
    auto end = [&](int64_t range) { return range + 1 < ranges ? (range + 1) * RANGE : count; };
    std::vector<uint64_t> before(size_t(ranges), 0);
    parallel(threads, ranges, [&](int64_t range, int) {
        uint64_t sum = 0;
        for (int64_t i = range * RANGE; i < end(range); ++i) sum += numbers[i];
        before[size_t(range)] = sum;
    });
    uint64_t total = 0;
    for (uint64_t &sum : before) total += std::exchange(sum, total);
    parallel(threads, ranges, [&](int64_t range, int) {
        uint32_t running = uint32_t(before[size_t(range)]);
        for (int64_t i = range * RANGE; i < end(range); ++i) running += std::exchange(numbers[i], running);
    });
    return total;
}

}  // namespace gsplat
