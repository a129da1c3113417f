// The backward pass on tiles, near to far like the forward pass, twice: what differs is where a pair's sums go.
//
// With g = dL/dimage and R = g . image at the start, for each splat near to far:
//     cg = g . c;   w = T alpha;   R -= w cg;   dL/dalpha = T cg - R / (1 - alpha);   T -= w
//     h = alpha dL/dalpha, 0 where alpha was clamped
#include <atomic>
#include <thread>

#include "ellipse.h"
#include "tile.h"

struct Job {
    const float *image, *grad_image;  // (H, W, 3): what the forward pass drew on black, and dL/dimage
    const int32_t *order;             // the tiles as they are handed out
    int32_t threads;
};

struct Gradient {
    float *means2d, *conics, *colors, *opacities;
    int64_t pairs = 0;
};

// w g by colour, then the moments of h: 1, dx, dx², dy, dx dy, dy².
constexpr int SUMS = 9;

// One pair: its sums over the tile, whose red, green and blue hold g.
static void sums_of(const Splats &s, int64_t i, const Ellipse &e, Tile &tile, float (&rest)[TILE][TILE], float *sums) {
    const float *c = s.colors + 3 * i;
    const int y0 = std::max(e.first_row(), tile.y0), y1 = std::min(e.last_row(s.H), tile.y0 + TILE - 1);
    for (int k = 0; k < SUMS; ++k) sums[k] = 0;
    for (int y = y0; y <= y1; ++y) {
        int x0, x1;
        e.columns(y, s.W, x0, x1);
        x0 = std::max(x0, tile.x0), x1 = std::min(x1, tile.x0 + TILE - 1);
        for (int x = x0; x <= x1; ++x) {
            const float dx = x - e.u, dy = y - e.v;
            const float power = -0.5f * (e.A * dx * dx + e.C * dy * dy) - e.B * dx * dy;
            const float raw = s.opacities[i] * std::exp(power), alpha = std::fmin(CEILING, raw);
            if (alpha < FLOOR) continue;
            const int row = y - tile.y0, column = x - tile.x0;
            float &T = tile.T[row][column], &R = rest[row][column];
            const float g[3] = {tile.red[row][column], tile.green[row][column], tile.blue[row][column]};
            const float cg = c[0] * g[0] + c[1] * g[1] + c[2] * g[2], w = T * alpha;
            R -= w * cg;
            const float h = raw < CEILING ? alpha * (T * cg - R / (1 - alpha)) : 0;
            tile.live -= T >= DARK && T - w < DARK;
            T -= w;
            const float terms[SUMS] = {w * g[0], w * g[1], w * g[2], h, h * dx, h * dx * dx, h * dy, h * dx * dy, h * dy * dy};
            for (int k = 0; k < SUMS; ++k) sums[k] += terms[k];
        }
    }
}

// Walks one tile near to far; `put(k, sums)` is given the sums of its k-th pair.
template <class Put>
static void walk(const Splats &s, const Job &job, const std::vector<Ellipse> &ellipses, const Lists &lists, int index, Put put) {
    Tile tile(s, index % lists.across, index / lists.across);
    float rest[TILE][TILE] = {};
    for (int y = 0; y < tile.height; ++y)
        for (int x = 0; x < tile.width; ++x) {
            const int64_t pixel = int64_t(tile.y0 + y) * s.W + tile.x0 + x;
            const float *g = job.grad_image + 3 * pixel, *drawn = job.image + 3 * pixel;
            tile.red[y][x] = g[0], tile.green[y][x] = g[1], tile.blue[y][x] = g[2];
            rest[y][x] = g[0] * drawn[0] + g[1] * drawn[1] + g[2] * drawn[2];
        }
    for (int64_t k = lists.begin[index]; k < lists.begin[index + 1] && tile.live; ++k) {
        float sums[SUMS];
        sums_of(s, lists.splat[k], ellipses[lists.splat[k]], tile, rest, sums);
        put(k, sums);
    }
}

// Runs work(i) for i < count on threads that take the next one as they get free: which takes which is chance.
template <class Work>
static void in_parallel(int32_t threads, int64_t count, Work work) {
    std::atomic<int64_t> next{0};
    const auto run = [&] {
        for (int64_t i; (i = next++) < count;) work(i);
    };
    std::vector<std::thread> pool;
    for (int32_t t = 1; t < threads; ++t) pool.emplace_back(run);
    run();
    for (std::thread &thread : pool) thread.join();
}

// A splat's sums become its gradients, once per splat: alpha = o exp(-(A dx² + C dy²) / 2 - B dx dy), dx = x - u.
static void finish(const Splats &s, int64_t i, const float *m, Gradient *out) {
    const float A = s.conics[3 * i], B = s.conics[3 * i + 1], C = s.conics[3 * i + 2];
    for (int k = 0; k < 3; ++k) out->colors[3 * i + k] = m[k];
    out->means2d[2 * i] = A * m[4] + B * m[6], out->means2d[2 * i + 1] = B * m[4] + C * m[6];
    out->conics[3 * i] = -m[5] / 2, out->conics[3 * i + 1] = -m[7], out->conics[3 * i + 2] = -m[8] / 2;
    out->opacities[i] = m[3] / s.opacities[i];
}

// *sum += x, whoever else adds at the same time: try until nobody came between.
static void add(float *sum, float x) {
    float before, after;
    __atomic_load(sum, &before, __ATOMIC_RELAXED);
    do after = before + x;
    while (!__atomic_compare_exchange(sum, &before, &after, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED));
}

struct Prepared {
    std::vector<Ellipse> ellipses;
    Lists lists;

    explicit Prepared(const Splats &s) {
        ellipses.reserve(s.count);
        for (int64_t i = 0; i < s.count; ++i) ellipses.emplace_back(s, i);
        lists = tight_lists(s, ellipses);
    }
    int64_t tiles() const { return int64_t(lists.begin.size()) - 1; }
    int64_t pairs() const { return int64_t(lists.splat.size()); }
};

// Every pair adds to sums that all tiles of the splat share: the order of the additions is the order of arrival.
extern "C" void backward_atomics(const Splats *s, const Job *job, Gradient *out) {
    const Prepared p(*s);
    std::vector<float> shared(SUMS * s->count, 0.0f);
    in_parallel(job->threads, p.tiles(), [&](int64_t i) {
        walk(*s, *job, p.ellipses, p.lists, job->order[i], [&](int64_t k, const float *sums) {
            for (int j = 0; j < SUMS; ++j) add(&shared[SUMS * p.lists.splat[k] + j], sums[j]);
        });
    });
    for (int64_t i = 0; i < s->count; ++i) finish(*s, i, &shared[SUMS * i], out);
    out->pairs = p.pairs();
}

// Every pair has a slot of its own, those of a splat side by side in the order of its tiles; a second pass adds them up in
// that order.
extern "C" void backward_slots(const Splats *s, const Job *job, Gradient *out) {
    const Prepared p(*s);
    std::vector<int64_t> begin(s->count + 1, 0), slot(p.pairs());
    for (const int32_t splat : p.lists.splat) ++begin[splat + 1];
    for (int64_t i = 0; i < s->count; ++i) begin[i + 1] += begin[i];
    std::vector<int64_t> next(begin.begin(), begin.end() - 1);
    for (int64_t k = 0; k < p.pairs(); ++k) slot[k] = next[p.lists.splat[k]]++;

    std::vector<float> slots(SUMS * p.pairs(), 0.0f);
    in_parallel(job->threads, p.tiles(), [&](int64_t i) {
        walk(*s, *job, p.ellipses, p.lists, job->order[i],
             [&](int64_t k, const float *sums) { std::copy(sums, sums + SUMS, &slots[SUMS * slot[k]]); });
    });
    constexpr int64_t BLOCK = 256;  // splats a thread takes at a time
    in_parallel(job->threads, (s->count + BLOCK - 1) / BLOCK, [&](int64_t block) {
        for (int64_t i = block * BLOCK; i < std::min((block + 1) * BLOCK, s->count); ++i) {
            float m[SUMS] = {};
            for (int64_t k = begin[i]; k < begin[i + 1]; ++k)
                for (int j = 0; j < SUMS; ++j) m[j] += slots[SUMS * k + j];
            finish(*s, i, m, out);
        }
    });
    out->pairs = p.pairs();
}
