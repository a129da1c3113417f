#include "frame.h"

#include <algorithm>
#include <chrono>
#include <cstring>
#include <stdexcept>
#include <utility>

#include "dispatch.h"
#include "sort.h"
#include "threads.h"

namespace gsplat {
namespace {

// Adds its lifetime to a total.
class Timer {
  public:
    explicit Timer(double &seconds) : seconds_(seconds) {}
    ~Timer() { seconds_ += std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count(); }

  private:
    double &seconds_;
    std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

}  // namespace

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
    ProjectArgs<T> args{scene,
                        camera_,
                        settings_,
                        static_cast<Splat<T> *>(splats_.reserve(n * sizeof(Splat<T>))),
                        static_cast<uint32_t *>(visible_.reserve(n * 4)),
                        static_cast<uint32_t *>(block_visible.reserve(size_t(blocks() + 1) * 4))};
    parallel(threads_, blocks(), [&](int64_t block, int) { kernels<T>().project(args, block); });
    for (int64_t block = 0; block < blocks(); ++block) {
        std::memmove(args.visible + visible_count_, args.visible + block * BLOCK, args.block_visible[block] * 4);
        visible_count_ += args.block_visible[block];
    }
}

template <class T>
void Frame<T>::sort() {
    Timer timer(seconds_[1]);
    auto *sorted = static_cast<uint32_t *>(sorted_.reserve((size_t(visible_count_) + 1) * 4));
    sort_by_depth(splats(), visible(), visible_count_, sorted);
}

// Counts pairs per chunk and tile, lays out the lists, and writes them. Every list is in depth order and is the same for any
// number of chunks.
template <class T>
void Frame<T>::intersect() {
    Timer timer(seconds_[2]);
    const int64_t tiles = grid_.tiles();
    const int64_t chunks =
        std::clamp<int64_t>(visible_count_ / 512, 1, std::min<int64_t>(16 * int64_t(threads_), 1 + 8 * visible_count_ / tiles));
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
    CompositeArgs<T> args{splats(),
                          pairs_.as<Pair>(),
                          tile_begin_.as<uint32_t>(),
                          grid_,
                          camera_,
                          settings_,
                          out.image,
                          out.transmittance,
                          out.depth,
                          static_cast<uint32_t *>(done_.reserve(size_t(grid_.tiles()) * 4))};
    parallel(threads_, grid_.tiles(), [&](int64_t tile, int) { kernels<T>().composite(args, int32_t(tile)); });
}

template <class T>
void Frame<T>::backward(const Scene<T> &scene, const Outputs<T> &forward, const ImageGrads<T> &in, const SceneGrads<T> &out,
                        T *background) {
    Buffer slots, tile_background;
    CompositeBackwardArgs<T> args{{splats(), pairs_.as<Pair>(), tile_begin_.as<uint32_t>(), grid_, camera_, settings_, forward.image,
                                   forward.transmittance, forward.depth, done_.as<uint32_t>()},
                                  in.image,
                                  in.transmittance,
                                  in.depth,
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

template class Frame<float>;
template class Frame<double>;

}  // namespace gsplat
