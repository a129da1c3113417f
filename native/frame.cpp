#include "frame.h"

#include <algorithm>
#include <cstring>
#include <numeric>

#include "dispatch.h"
#include "scan.h"
#include "sort.h"
#include "system.h"
#include "threads.h"

namespace gsplat {
namespace {

// Adds its lifetime to a stage's times.
class Timer {
  public:
    explicit Timer(StageTime &stage) : stage_(stage) {}
    ~Timer() {
        stage_.seconds += wall_seconds() - start_;
        stage_.processor += thread_seconds() - processor_, stage_.parallel += parallel_time().seconds - parallel_;
    }

  private:
    StageTime &stage_;
    double processor_ = thread_seconds(), parallel_ = parallel_time().seconds;
    double start_ = wall_seconds();
};

}  // namespace

template <class T>
Frame<T>::Frame(const Scene<T> &scene, const Camera &camera, const Settings &settings, const uint8_t *needed, int threads)
    : n_(scene.n), camera_(camera), settings_(settings), threads_(threads) {
    grid_.tiles_x = (camera.W + TILE - 1) / TILE, grid_.tiles_y = (camera.H + TILE - 1) / TILE;
    if (scene.n >= (int64_t(1) << 32)) refuse("more than 4,294,967,295 Gaussians");
    project(scene);
    sort(scene.order);
    intersect(needed);
}

template <class T>
void Frame<T>::project(const Scene<T> &scene) {
    Timer timer(stages_[0]);
    const size_t n = size_t(std::max<int64_t>(n_, 1));
    ProjectArgs<T> args{scene,
                        camera_,
                        settings_,
                        static_cast<Splat<T> *>(splats_.reserve(n * sizeof(Splat<T>))),
                        static_cast<uint32_t *>(block_ids_.reserve(n * 4)),
                        static_cast<uint32_t *>(block_begin_.reserve(size_t(blocks() + 1) * 4))};
    parallel(threads_, blocks(), [&](int64_t block, int) { kernels<T>().project(args, block); });
    args.block_visible[blocks()] = 0;
    visible_count_ = int64_t(exclusive_sums(threads_, blocks() + 1, args.block_visible));
}

template <class T>
void Frame<T>::sort(const T *order) {
    Timer timer(stages_[1]);
    const size_t count = size_t(visible_count_) + 1;
    Buffer key_buffer;
    auto *keys = static_cast<DepthKey<T> *>(key_buffer.reserve(count * sizeof(DepthKey<T>)));
    auto *ids = static_cast<uint32_t *>(visible_.reserve(count * 4));
    const uint32_t *begin = block_begin_.as<uint32_t>();
    parallel(threads_, blocks(), [&](int64_t block, int) {
        const uint32_t *from = block_ids_.as<uint32_t>() + block * BLOCK;
        for (uint32_t k = begin[block]; k < begin[block + 1]; ++k) {
            ids[k] = keys[k].id = *from++;
            std::memcpy(&keys[k].key, order ? order + ids[k] : &splats()[ids[k]].depth, sizeof(T));
        }
    });
    sort_by_depth(threads_, visible_count_, keys, static_cast<uint32_t *>(sorted_.reserve(count * 4)));
}

template <class T>
void Frame<T>::list_visible(int64_t *ids, T *radii) const {
    const uint32_t *begin = block_begin_.as<uint32_t>(), *visible = visible_.as<uint32_t>();
    parallel(threads_, blocks(), [&](int64_t block, int) {
        for (uint32_t k = begin[block]; k < begin[block + 1]; ++k) {
            const T *extent = splats()[visible[k]].extent;
            ids[k] = visible[k], radii[2 * k] = extent[0], radii[2 * k + 1] = extent[1];
        }
    });
}

template <class T>
void Frame<T>::list_pairs(int64_t *begin, int64_t *ids) const {
    std::copy_n(tile_begin_.as<uint32_t>(), grid_.tiles() + 1, begin);
    std::transform(pairs_.as<Pair>(), pairs_.as<Pair>() + pairs_count_, ids, [](const Pair &pair) { return int64_t(pair.gaussian); });
}

// Turns the counts of pairs, a row of tiles for each chunk, into the places where the chunks write theirs, and computes where
// each tile's list begins.
static void lay_out(int threads, int64_t tiles, int64_t chunks, uint32_t *table, uint32_t *tile_begin) {
    constexpr int64_t RANGE = 1 << 10;
    const int64_t ranges = (tiles + RANGE - 1) / RANGE;
    auto end = [&](int64_t range) { return std::min((range + 1) * RANGE, tiles); };
    parallel(threads, ranges, [&](int64_t range, int) {
        std::fill(tile_begin + range * RANGE, tile_begin + end(range), 0);
        for (int64_t c = 0; c < chunks; ++c)
            for (int64_t tile = range * RANGE; tile < end(range); ++tile) tile_begin[tile] += table[c * tiles + tile];
    });
    tile_begin[tiles] = 0;
    exclusive_sums(threads, tiles + 1, tile_begin);
    parallel(threads, ranges, [&](int64_t range, int) {
        uint32_t next[RANGE];
        std::copy(tile_begin + range * RANGE, tile_begin + end(range), next);
        for (int64_t c = 0; c < chunks; ++c)
            for (int64_t tile = range * RANGE; tile < end(range); ++tile) {
                const uint32_t count = table[c * tiles + tile];
                table[c * tiles + tile] = next[tile - range * RANGE];
                next[tile - range * RANGE] += count;
            }
    });
}

// Counts the tiles with a needed pixel before each tile, and in all; null if all pixels are needed.
template <class T>
const uint32_t *Frame<T>::find_drawn(const uint8_t *needed, Buffer &buffer) const {
    if (!needed) return nullptr;
    auto *before = static_cast<uint32_t *>(buffer.reserve(size_t(grid_.tiles() + 1) * 4));
    std::fill(before, before + grid_.tiles(), 0);
    parallel(threads_, grid_.tiles_y, [&](int64_t row, int) {
        for (int64_t y = row * TILE; y < std::min((row + 1) * TILE, int64_t(camera_.H)); ++y)
            for (int64_t tx = 0; tx < grid_.tiles_x; ++tx) {
                const uint8_t *begin = needed + y * camera_.W + tx * TILE;
                const int64_t width = std::min(int64_t(TILE), camera_.W - tx * TILE);
                if (std::any_of(begin, begin + width, [](uint8_t pixel) { return pixel != 0; })) before[row * grid_.tiles_x + tx] = 1;
            }
    });
    before[grid_.tiles()] = 0;
    exclusive_sums(threads_, grid_.tiles() + 1, before);
    return before;
}

// Counts pairs per chunk and tile, lays out the lists, and writes them. Every list is in depth order and is the same for any
// number of chunks.
template <class T>
void Frame<T>::intersect(const uint8_t *needed) {
    Timer timer(stages_[2]);
    const int64_t tiles = grid_.tiles();
    const int64_t chunks =
        std::clamp<int64_t>(visible_count_ / 512, 1, std::min<int64_t>(8 * int64_t(threads_), 1 + 8 * visible_count_ / tiles));
    Buffer table_buffer, runs, drawn;
    auto *table = static_cast<uint32_t *>(table_buffer.reserve(size_t(chunks * tiles) * 4));
    const size_t n = size_t(std::max<int64_t>(n_, 1));
    auto *pairs_of = static_cast<uint32_t *>(pairs_of_.reserve(n * 4));
    auto *slot_begin = static_cast<uint32_t *>(slot_begin_.reserve(n * 4));
    auto *kept = static_cast<TileRuns *>(runs.reserve(size_t(visible_count_ + 1) * sizeof(TileRuns)));
    IntersectArgs<T> args{splats(), sorted_.as<uint32_t>(), grid_, camera_, kept, pairs_of, slot_begin, nullptr, find_drawn(needed, drawn)};
    auto begin = [&](int64_t chunk) { return visible_count_ * chunk / chunks; };
    parallel(threads_, blocks(),
             [&](int64_t block, int) { std::fill(pairs_of + block * BLOCK, pairs_of + std::min((block + 1) * BLOCK, n_), 0); });
    parallel(threads_, chunks, [&](int64_t c, int) {
        std::fill(table + c * tiles, table + (c + 1) * tiles, 0);
        kernels<T>().count(args, begin(c), begin(c + 1), table + c * tiles);
    });
    parallel(threads_, blocks(), [&](int64_t block, int) {
        std::copy(pairs_of + block * BLOCK, pairs_of + std::min((block + 1) * BLOCK, n_), slot_begin + block * BLOCK);
    });
    const uint64_t total = exclusive_sums(threads_, n_, slot_begin);
    if (total >= (uint64_t(1) << 32)) refuse("more than 4,294,967,295 pairs of Gaussian and tile");
    pairs_count_ = int64_t(total);
    lay_out(threads_, tiles, chunks, table, static_cast<uint32_t *>(tile_begin_.reserve(size_t(tiles + 1) * 4)));
    args.pairs = static_cast<Pair *>(pairs_.reserve((size_t(total) + 1) * sizeof(Pair)));
    parallel(threads_, chunks, [&](int64_t c, int) { kernels<T>().scatter(args, begin(c), begin(c + 1), table + c * tiles); });
}

template <class T>
CompositeArgs<T> Frame<T>::composite_args(const Images<T> &out, const T *features) const {
    return {splats(), pairs_.as<Pair>(),    tile_begin_.as<uint32_t>(), grid_, camera_, settings_, out,
            features, done_.as<uint32_t>(), rows_.as<uint8_t>()};
}

template <class T>
void Frame<T>::composite(const Images<T> &out, const T *features) {
    Timer timer(stages_[3]);
    done_.reserve(size_t(grid_.tiles()) * 4);
    rows_.reserve(size_t(first_batch(tile_begin_.as<uint32_t>(), grid_.tiles()) + 1) * size_t(kernels<T>().rows_bytes));
    const CompositeArgs<T> args = composite_args(out, features);
    parallel(threads_, grid_.tiles(), [&](int64_t tile, int) { kernels<T>().composite(args, int32_t(tile)); });
}

template <class T>
CompositeBackwardArgs<T> Frame<T>::composite_backward(const Drawn<T> &drawn, const ImageGrads<T> &in, SlotBuffers &to) {
    Timer timer(stages_[4]);
    const size_t pairs = size_t(pairs_count_) + 1;
    auto room = [](Buffer &buffer, size_t count) { return static_cast<T *>(buffer.reserve(count * sizeof(T))); };
    CompositeBackwardArgs<T> args{composite_args(drawn.images, drawn.features),
                                  in,
                                  room(to.slots, pairs * SLOT),
                                  room(to.tile_background, size_t(grid_.tiles()) * 3),
                                  in.features ? room(to.features, pairs * size_t(drawn.images.channels)) : nullptr,
                                  drawn.collected.values ? room(to.statistics, pairs * STATISTICS) : nullptr,
                                  drawn.collected.errors};
    parallel(threads_, grid_.tiles(), [&](int64_t tile, int) { kernels<T>().composite_backward(args, int32_t(tile)); });
    if (args.statistic_slots) sum_statistics(args.statistic_slots, drawn.collected.values);
    return args;
}

template <class T>
void Frame<T>::sum_features(const T *slots, int32_t channels, T *to) const {
    const uint32_t *pairs_of = pairs_of_.as<uint32_t>(), *begin = slot_begin_.as<uint32_t>();
    parallel(threads_, blocks(), [&](int64_t block, int) {
        for (int64_t i = block * BLOCK; i < std::min((block + 1) * BLOCK, n_); ++i) {
            T *sums = to + i * channels;
            std::fill_n(sums, channels, T(0));
            for (const T *slot = slots + int64_t(begin[i]) * channels, *end = slot + int64_t(pairs_of[i]) * channels; slot < end;
                 slot += channels)
                for (int32_t k = 0; k < channels; ++k) sums[k] += slot[k];
        }
    });
}

template <class T>
void Frame<T>::sum_statistics(const T *slots, T *to) const {
    sum_features(slots, STATISTICS, to);
    const uint32_t *pairs_of = pairs_of_.as<uint32_t>(), *begin = slot_begin_.as<uint32_t>();
    parallel(threads_, blocks(), [&](int64_t block, int) {
        for (int64_t i = block * BLOCK; i < std::min((block + 1) * BLOCK, n_); ++i) {
            T most = 0;
            for (int64_t slot = begin[i]; slot < int64_t(begin[i]) + pairs_of[i]; ++slot)
                most = std::max(most, slots[STATISTICS * slot + WEIGHT_MAX]);
            to[STATISTICS * i + WEIGHT_MAX] = most;
        }
    });
}

template <class T>
ProjectBackwardArgs<T> Frame<T>::last_stage(const Scene<T> &scene, const T *slots) const {
    return {scene, camera_, settings_, pairs_of_.as<uint32_t>(), slot_begin_.as<uint32_t>(), slots, {}, nullptr};
}

template <class T>
void Frame<T>::backward(const Scene<T> &scene, const Drawn<T> &drawn, const ImageGrads<T> &in, const SceneGrads<T> &out, T *background,
                        double *camera) {
    SlotBuffers slots;
    Buffer camera_sums;
    const CompositeBackwardArgs<T> done = composite_backward(drawn, in, slots);
    Timer timer(stages_[5]);
    if (done.feature_slots) sum_features(done.feature_slots, drawn.images.channels, out.features);
    background[0] = background[1] = background[2] = 0;
    for (int32_t tile = 0; tile < grid_.tiles(); ++tile)
        for (int k = 0; k < 3; ++k) background[k] += done.tile_background[3 * tile + k];
    ProjectBackwardArgs<T> args = last_stage(scene, done.slots);
    args.grads = out;
    const int numbers = camera_numbers(camera_);
    if (camera) args.camera_sums = static_cast<double *>(camera_sums.reserve(size_t(blocks() + 1) * size_t(numbers) * sizeof(double)));
    parallel(threads_, blocks(), [&](int64_t block, int) { kernels<T>().project_backward(args, block); });
    if (!camera) return;
    std::fill_n(camera, numbers, 0.0);
    for (int64_t block = 0; block < blocks(); ++block)  // in this order for any number of threads
        for (int k = 0; k < numbers; ++k) camera[k] += args.camera_sums[block * numbers + k];
}

template <class T>
void Frame<T>::adam(const Scene<T> &scene, const Drawn<T> &drawn, const ImageGrads<T> &in, const AdamArgs<T> *groups, T *means2d_norm) {
    SlotBuffers slots;
    Buffer scratch;
    const CompositeBackwardArgs<T> done = composite_backward(drawn, in, slots);
    Timer timer(stages_[5]);
    AdamBackwardArgs<T> args{last_stage(scene, done.slots), {}, {3, 4, 3, 3, 3 * int64_t(scene.rest), 1}};
    args.backward.grads.means2d_norm = means2d_norm;
    std::copy_n(groups, int(GROUPS), args.groups);
    const int64_t size = BLOCK * std::accumulate(args.widths, args.widths + GROUPS, int64_t(0));
    auto *room = static_cast<T *>(scratch.reserve(size_t(threads_ * size) * sizeof(T)));
    parallel(threads_, blocks(), [&](int64_t block, int worker) { kernels<T>().adam_backward(args, block, room + worker * size); });
}

template class Frame<float>;
template class Frame<double>;

}  // namespace gsplat
