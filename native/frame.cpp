#include "frame.h"

#include <pthread.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <mutex>
#include <new>
#include <stdexcept>
#include <type_traits>
#include <utility>
#include <vector>

#include "threads.h"

namespace gsplat {
namespace {

constexpr size_t MAX_SPARES = 32;
constexpr size_t LARGE_BLOCK = size_t(256) << 20;

FreeMemory free_memory = nullptr;

class OutOfMemory : public std::bad_alloc {
  public:
    OutOfMemory(size_t bytes, int64_t free) {
        const double gib = 1.0 / double(1 << 30);
        std::snprintf(text_, sizeof text_, "the renderer needs a block of %.2f GiB, but %.2f GiB are free", double(bytes) * gib, double(free) * gib);
    }
    const char *what() const noexcept override { return text_; }

  private:
    char text_[128];
};

void check_room(size_t bytes) {
    if (bytes < LARGE_BLOCK || !free_memory) return;
    const int64_t free = free_memory();
    if (free >= 0 && bytes > size_t(free)) throw OutOfMemory(bytes, free);
}

struct Spare {
    void *data;
    size_t capacity;
};

// Spares live as long as the process: frames may still be freed while it ends.
// A forked child gets a new mutex: the thread that held it may not exist there.
std::mutex *spares_lock = new std::mutex;
[[maybe_unused]] const int registered = pthread_atfork(nullptr, nullptr, [] { spares_lock = new std::mutex; });

std::vector<Spare> &spares() {
    static auto *list = [] {
        auto *made = new std::vector<Spare>;
        made->reserve(MAX_SPARES + 2);  // a destructor adds to it and must not throw
        return made;
    }();
    return *list;
}

// Adds the time until it goes to a figure.
class Timer {
  public:
    explicit Timer(double &seconds) : seconds_(seconds) {}
    ~Timer() { seconds_ += std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count(); }

  private:
    double &seconds_;
    std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

}  // namespace

void ask_before_large_blocks(FreeMemory function) { free_memory = function; }

#ifdef GSPLAT_SANITIZE
// Exact sizes and real frees, so that the sanitizer sees every overrun; filled with what no kernel may rely on.
Buffer::~Buffer() { std::free(data_); }

void *Buffer::reserve(size_t bytes) {
    std::free(std::exchange(data_, nullptr));
    check_room(bytes);
    data_ = std::malloc(bytes);
    if (!data_) throw std::bad_alloc();
    std::memset(data_, 0xFF, bytes);
    return data_;
}
#else
Buffer::~Buffer() {
    if (!data_) return;
    std::lock_guard<std::mutex> lock(*spares_lock);
    spares().push_back({data_, capacity_});
    if (spares().size() > MAX_SPARES) {
        auto smallest = std::min_element(spares().begin(), spares().end(),
                                         [](const Spare &a, const Spare &b) { return a.capacity < b.capacity; });
        std::free(smallest->data);
        spares().erase(smallest);
    }
}

void *Buffer::reserve(size_t bytes) {
    if (data_ && capacity_ >= bytes) return data_;
    std::unique_lock<std::mutex> lock(*spares_lock);
    if (data_) spares().push_back({std::exchange(data_, nullptr), capacity_});
    auto best = spares().end();
    for (auto it = spares().begin(); it != spares().end(); ++it)
        if (it->capacity >= bytes && (best == spares().end() || it->capacity < best->capacity)) best = it;
    if (best != spares().end() && best->capacity <= 4 * bytes + (1 << 20)) {
        data_ = best->data, capacity_ = best->capacity;
        spares().erase(best);
        return data_;
    }
    // Nothing fits: grow the largest spare that is too small instead of keeping both.
    auto grow = spares().end();
    for (auto it = spares().begin(); it != spares().end(); ++it)
        if (it->capacity < bytes && (grow == spares().end() || it->capacity > grow->capacity)) grow = it;
    if (grow != spares().end()) {
        std::free(grow->data);
        spares().erase(grow);
    }
    lock.unlock();  // asking may wait for Python, which may wait for this lock
    const size_t rounded = (bytes + bytes / 4 + 4095) / 4096 * 4096;
    check_room(rounded);
    data_ = std::aligned_alloc(4096, rounded);
    if (!data_) throw std::bad_alloc();
    capacity_ = rounded;
    return data_;
}
#endif

template <class T>
Frame<T>::Frame(const Scene<T> &scene, const Camera &camera, const Settings &settings, int threads)
    : n_(scene.n), camera_(camera), settings_(settings), threads_(threads) {
    grid_.tiles_x = (camera.W + TILE - 1) / TILE, grid_.tiles_y = (camera.H + TILE - 1) / TILE;
    if (scene.n >= (int64_t(1) << 32)) throw std::length_error("more than 4,294,967,295 Gaussians");
    project(scene);
    sort();
    intersect();
}

template <class T>
void Frame<T>::project(const Scene<T> &scene) {
    Timer timer(seconds_[0]);
    const size_t n = size_t(std::max<int64_t>(n_, 1));
    Buffer block_visible;
    ProjectArgs<T> args{scene, camera_, settings_, static_cast<Splat<T> *>(splats_.reserve(n * sizeof(Splat<T>))),
                        static_cast<uint32_t *>(visible_.reserve(n * 4)),
                        static_cast<uint32_t *>(block_visible.reserve(size_t(blocks() + 1) * 4))};
    parallel(threads_, blocks(), [&](int64_t block, int) { kernels<T>().project(args, block); });
    for (int64_t block = 0; block < blocks(); ++block) {
        std::memmove(args.visible + visible_count_, args.visible + block * BLOCK, args.block_visible[block] * 4);
        visible_count_ += args.block_visible[block];
    }
}

// Stable radix sort of the visible ids by the bits of their depths, which are positive.
template <class T>
void Frame<T>::sort() {
    Timer timer(seconds_[1]);
    using Key = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;
    struct Item {
        Key key;
        uint32_t id;
    };
    constexpr int DIGIT = 11, BINS = 1 << DIGIT;
    const size_t count = size_t(visible_count_);
    Buffer a, b;
    auto *from = static_cast<Item *>(a.reserve((count + 1) * sizeof(Item)));
    auto *to = static_cast<Item *>(b.reserve((count + 1) * sizeof(Item)));
    for (size_t k = 0; k < count; ++k) {
        from[k].id = visible()[k];
        std::memcpy(&from[k].key, &splats()[from[k].id].depth, sizeof(Key));
    }
    for (int shift = 0; shift < int(8 * sizeof(Key)); shift += DIGIT) {
        std::vector<uint32_t> next(BINS + 1);
        for (size_t k = 0; k < count; ++k) ++next[((from[k].key >> shift) & (BINS - 1)) + 1];
        if (count && next[((from[0].key >> shift) & (BINS - 1)) + 1] == count) continue;  // all alike
        for (int bin = 0; bin < BINS; ++bin) next[bin + 1] += next[bin];
        for (size_t k = 0; k < count; ++k) to[next[(from[k].key >> shift) & (BINS - 1)]++] = from[k];
        std::swap(from, to);
    }
    auto *sorted = static_cast<uint32_t *>(sorted_.reserve((count + 1) * 4));
    for (size_t k = 0; k < count; ++k) sorted[k] = from[k].id;
}

// Counts pairs per chunk and tile, lays the lists out, and writes them: every list comes out in depth order, and
// the same for any number of chunks.
template <class T>
void Frame<T>::intersect() {
    Timer timer(seconds_[2]);
    const int64_t tiles = grid_.tiles();
    const int64_t chunks = std::clamp<int64_t>(visible_count_ / 512, 1, std::min<int64_t>(16 * int64_t(threads_), 1 + 8 * visible_count_ / tiles));
    Buffer next_buffer;
    auto *next = static_cast<uint32_t *>(next_buffer.reserve(size_t(chunks * tiles) * 4));
    std::memset(next, 0, size_t(chunks * tiles) * 4);
    const size_t n = size_t(std::max<int64_t>(n_, 1));
    auto *pairs_of = static_cast<uint32_t *>(pairs_of_.reserve(n * 4));
    auto *slot_begin = static_cast<uint32_t *>(slot_begin_.reserve(n * 4));
    std::memset(pairs_of, 0, n * 4);
    IntersectArgs<T> args{splats(), sorted_.as<uint32_t>(), grid_, camera_, pairs_of, slot_begin, nullptr};
    auto begin = [&](int64_t chunk) { return visible_count_ * chunk / chunks; };
    parallel(threads_, chunks, [&](int64_t c, int) { kernels<T>().count(args, begin(c), begin(c + 1), next + c * tiles); });

    uint64_t total = 0;
    for (int64_t i = 0; i < n_; ++i) slot_begin[i] = uint32_t(total), total += pairs_of[i];
    if (total >= (uint64_t(1) << 32)) throw std::length_error("more than 4,294,967,295 pairs of Gaussian and tile");
    pairs_count_ = int64_t(total);
    auto *tile_begin = static_cast<uint32_t *>(tile_begin_.reserve(size_t(tiles + 1) * 4));
    uint32_t running = 0;
    for (int64_t tile = 0; tile < tiles; ++tile) {
        tile_begin[tile] = running;
        for (int64_t c = 0; c < chunks; ++c) running += std::exchange(next[c * tiles + tile], running);
    }
    tile_begin[tiles] = running;
    args.pairs = static_cast<Pair *>(pairs_.reserve((size_t(total) + 1) * sizeof(Pair)));
    parallel(threads_, chunks, [&](int64_t c, int) { kernels<T>().scatter(args, begin(c), begin(c + 1), next + c * tiles); });
}

template <class T>
void Frame<T>::composite(const Outputs<T> &out) {
    Timer timer(seconds_[3]);
    CompositeArgs<T> args{splats(), pairs_.as<Pair>(), tile_begin_.as<uint32_t>(), grid_, camera_, settings_,
                          out.image, out.transmittance, out.depth,
                          static_cast<uint32_t *>(done_.reserve(size_t(grid_.tiles()) * 4))};
    parallel(threads_, grid_.tiles(), [&](int64_t tile, int) { kernels<T>().composite(args, int32_t(tile)); });
}

template <class T>
void Frame<T>::backward(const Scene<T> &scene, const Outputs<T> &forward, const ImageGrads<T> &in, const SceneGrads<T> &out,
                        T *background) {
    Buffer slots, tile_background;
    CompositeBackwardArgs<T> args{
        {splats(), pairs_.as<Pair>(), tile_begin_.as<uint32_t>(), grid_, camera_, settings_, forward.image,
         forward.transmittance, forward.depth, done_.as<uint32_t>()},
        in.image, in.transmittance, in.depth,
        static_cast<T *>(slots.reserve((size_t(pairs_count_) + 1) * SLOT * sizeof(T))),
        static_cast<T *>(tile_background.reserve(size_t(grid_.tiles()) * 3 * sizeof(T)))};
    {
        Timer timer(seconds_[4]);
        parallel(threads_, grid_.tiles(), [&](int64_t tile, int) { kernels<T>().composite_backward(args, int32_t(tile)); });
    }
    Timer timer(seconds_[5]);
    background[0] = background[1] = background[2] = 0;
    for (int32_t tile = 0; tile < grid_.tiles(); ++tile)
        for (int k = 0; k < 3; ++k) background[k] += args.tile_background[3 * tile + k];
    ProjectBackwardArgs<T> last{scene, camera_, settings_, pairs_of_.as<uint32_t>(), slot_begin_.as<uint32_t>(), args.slots, out};
    parallel(threads_, blocks(), [&](int64_t block, int) { kernels<T>().project_backward(last, block); });
}

template <class T>
void loss(LossArgs<T> args, double *l1, double *ssim, int threads) {
    Buffer sums, scratch;
    const size_t size = size_t(args.H) * size_t(args.W) * 3;
    args.sums = static_cast<double *>(sums.reserve(size_t(args.bands() + 1) * 2 * sizeof(double)));
    auto *room = static_cast<T *>(scratch.reserve(size_t(threads * args.SCRATCH) * sizeof(T)));
    parallel(threads, args.bands(), [&](int64_t band, int w) { kernels<T>().loss(args, band, room + w * args.SCRATCH); });
    *l1 = *ssim = 0;
    for (int64_t band = 0; band < args.bands(); ++band) *l1 += args.sums[2 * band], *ssim += args.sums[2 * band + 1];
    *l1 /= double(size), *ssim /= double(size);
}

template void loss<float>(LossArgs<float>, double *, double *, int);
template void loss<double>(LossArgs<double>, double *, double *, int);
template class Frame<float>;
template class Frame<double>;

}  // namespace gsplat
