#include "volume.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <limits>
#include <stdexcept>
#include <string>

#include "threads.h"

namespace gsplat {
namespace {

constexpr int TILE = 16;                               // pixels, along both axes
constexpr double BALL = 0.867;                         // radius of the ball around a cube of edge 1: sqrt(3) / 2, and a margin
constexpr int STRIP = 16;                              // rows of pixels per task
constexpr size_t COMPACT = size_t(1) << 18;            // keys that a task collects before it removes duplicates
constexpr float GUESS = 1.0f / 64;                     // weight of a depth beside a jump: it closes holes, and no other depth notices it
constexpr double PIECE = 4;                            // voxels; a longer piece of a ray touches more blocks than it crosses

void sort_unique(std::vector<uint64_t> &keys) {
    std::sort(keys.begin(), keys.end());
    keys.erase(std::unique(keys.begin(), keys.end()), keys.end());
}

// Inverse depths and weights with a border of pixels without surface: one before the first row and column, two after the last.
// The inverse depth of a plane is linear in the image, so that bilinear interpolation between pixels is exact on planes.
struct Planes {
    int64_t stride;
    std::vector<float> inverse, weights;

    explicit Planes(const DepthView &view)
        : stride(int64_t(view.W) + 3), inverse(size_t(stride) * (size_t(view.H) + 3)), weights(view.weights ? inverse.size() : 0) {}

    void fill_row(const DepthView &view, int64_t row) {
        for (int64_t column = 0; column < view.W; ++column) {
            const int64_t from = row * view.W + column, to = (row + 1) * stride + column + 1;
            const float depth = view.depth[from], weight = view.weights ? view.weights[from] : 1.0f;
            constexpr float MOST = std::numeric_limits<float>::max();
            const bool seen = depth > std::numeric_limits<float>::min() && depth <= MOST && weight > 0 && weight <= MOST;
            inverse[size_t(to)] = seen ? 1 / depth : 0.0f;
            if (view.weights) weights[size_t(to)] = seen ? weight : 0.0f;
        }
    }
};

// The blocks that the rays of a strip of pixels touch within the truncation of the surface.
class Touched {
  public:
    std::vector<uint64_t> keys;
    bool outside = false, full = false, no_memory = false;

    Touched() { recent_.fill(~uint64_t(0)); }

    // `limit` is the greatest number of blocks that the volume may have.
    void collect(const DepthView &view, const Planes &planes, double voxel, double truncation, int64_t first_row, int64_t limit) {
        const int64_t end = std::min<int64_t>(first_row + STRIP, view.H);
        for (int64_t row = first_row; row < end; ++row)
            for (int64_t column = 0; column < view.W; ++column)
                if (planes.inverse[size_t((row + 1) * planes.stride + column + 1)] > 0) {
                    ray(view, column, row, voxel, truncation, limit);
                    if (outside || full) return;
                }
        sort_unique(keys);
    }

  private:
    // The ray eye + t d, with t the depth, in pieces. Each counts with a margin around it: a voxel, so that the corners of
    // every cell that the surface crosses exist, and half a pixel, for the surface between the rays.
    void ray(const DepthView &view, int64_t column, int64_t row, double voxel, double truncation, int64_t limit) {
        const double depth = view.depth[row * view.W + column];
        const double x = (double(column) - view.cx) / view.fx, y = (double(row) - view.cy) / view.fy;
        const double near = std::max(depth - truncation, 0.0), far = depth + truncation, block = SIDE * voxel;
        const double margin = std::min(1.0, (voxel + 0.5 * far / std::min(view.fx, view.fy)) / block);
        double start[3], step[3], length = 0;
        for (int k = 0; k < 3; ++k) {
            const double d = (view.R[k] * x + view.R[3 + k] * y + view.R[6 + k]) / block;
            start[k] = view.eye[k] / block + near * d, step[k] = (far - near) * d, length += step[k] * step[k];
            if (!(std::max(std::abs(start[k]), std::abs(start[k] + step[k])) < double(LAST_BLOCK - 2))) outside = true;
        }
        if (outside) return;
        const int64_t pieces = 1 + int64_t(std::sqrt(length) * SIDE / PIECE);
        for (int k = 0; k < 3; ++k) step[k] /= double(pieces);
        for (int64_t piece = 0; piece < pieces && !full; ++piece) {
            int64_t low[3], high[3];
            for (int k = 0; k < 3; ++k) {
                const double a = start[k] + step[k] * double(piece), b = a + step[k];
                low[k] = floored(std::min(a, b) - margin), high[k] = floored(std::max(a, b) + margin);
            }
            box(low, high, limit);
        }
    }

    // The same as std::floor for coordinates of blocks, without a call.
    static int64_t floored(double x) { return int64_t(x + double(LAST_BLOCK + 1)) - (LAST_BLOCK + 1); }

    void box(const int64_t *low, const int64_t *high, int64_t limit) {
        for (int64_t z = low[2]; z <= high[2]; ++z)
            for (int64_t y = low[1]; y <= high[1]; ++y)
                for (int64_t x = low[0]; x <= high[0]; ++x) {
                    const uint64_t key = block_key(x, y, z);
                    uint64_t &last = recent_[key * 0x9E3779B97F4A7C15u >> 54];
                    if (last == key) continue;
                    last = key;
                    keys.push_back(key);
                }
        if (keys.size() < compact_at_) return;
        sort_unique(keys);
        compact_at_ = std::max(COMPACT, 2 * keys.size());
        full = int64_t(keys.size()) > limit;
    }

    std::array<uint64_t, 1024> recent_;                // most keys come again within a few rays
    size_t compact_at_ = COMPACT;
};

// Takes one view into one block at a time.
class Integrator {
  public:
    Integrator(const DepthView &view, const Planes &planes, double voxel, double truncation)
        : view_(view),
          planes_(planes),
          voxel_(voxel),
          truncation_(float(truncation)),
          slope_(float(2 / truncation)),
          tiles_across_((int64_t(view.W) + TILE - 1) / TILE) {
        const double K[9] = {view.fx, 0, view.cx, 0, view.fy, view.cy, 0, 0, 1};
        for (int row = 0; row < 3; ++row)
            for (int k = 0; k < 3; ++k) {
                double sum = 0;
                for (int m = 0; m < 3; ++m) sum += K[3 * row + m] * view.R[3 * m + k];
                KR_[row][k] = sum, step_[row][k] = float(sum * voxel);
            }
        for (int axis = 0; axis < 2; ++axis) {
            const double focal = axis ? view.fy : view.fx, middle = axis ? view.cy : view.cx, size = axis ? view.H : view.W;
            reach_[axis][0] = std::hypot(focal, middle + 0.5), reach_[axis][1] = std::hypot(focal, size - 0.5 - middle);
        }
        least_.resize(size_t(tiles_across_ * ((int64_t(view.H) + TILE - 1) / TILE)));
        for (int64_t row = 0; row < view.H; ++row)
            for (int64_t column = 0; column < view.W; ++column) {
                const float inverse = planes.inverse[size_t((row + 1) * planes.stride + column + 1)];
                float &least = least_[size_t(row / TILE * tiles_across_ + column / TILE)];
                if (inverse > 0 && !(least > 0 && least < inverse)) least = inverse;
            }
    }

    void integrate(Block &block) const {
        double corner[3], middle[3];
        for (int k = 0; k < 3; ++k) {
            const double first = double(block_axis(block.key, k)) * SIDE;
            corner[k] = (first + 0.5) * voxel_ - view_.eye[k], middle[k] = (first + 0.5 * SIDE) * voxel_ - view_.eye[k];
        }
        if (!may_see(middle)) return;
        float origin[3];
        for (int row = 0; row < 3; ++row) origin[row] = float(KR_[row][0] * corner[0] + KR_[row][1] * corner[1] + KR_[row][2] * corner[2]);
        for (int k = 0; k < SIDE; ++k)
            for (int j = 0; j < SIDE; ++j) {
                float start[3];
                for (int row = 0; row < 3; ++row) start[row] = origin[row] + float(j) * step_[row][1] + float(k) * step_[row][2];
                integrate_row(block, (k * SIDE + j) * SIDE, start);
            }
    }

  private:
    // Whether the view may have something to say about a block, of which `middle` is the middle relative to the eye: whether the
    // ball around the block touches the frustum, and is not entirely behind the deepest surface of the pixels that it covers.
    bool may_see(const double *middle) const {
        const double radius = BALL * SIDE * voxel_;
        double p[3];
        for (int row = 0; row < 3; ++row) p[row] = KR_[row][0] * middle[0] + KR_[row][1] * middle[1] + KR_[row][2] * middle[2];
        const double z = p[2];
        if (z < -radius) return false;
        int64_t low[2], high[2];
        for (int axis = 0; axis < 2; ++axis) {
            const double focal = axis ? view_.fy : view_.fx, center = axis ? view_.cy : view_.cx, size = axis ? view_.H : view_.W;
            // The planes at half a pixel beyond the outer pixels; a normal's length says how far a step of one world unit gets.
            if (p[axis] + 0.5 * z < -radius * reach_[axis][0] || (size - 0.5) * z - p[axis] < -radius * reach_[axis][1]) return false;
            // The pixels that the ball covers, with the neighbours that interpolation takes.
            const double near = std::max(z - radius, 1e-3 * radius), far = z + radius, offset = p[axis] - center * z,
                         spread = focal * radius;
            const double first = center + (offset - spread) / (offset < spread ? near : far) - 1;
            const double last = center + (offset + spread) / (offset < -spread ? far : near) + 1;
            low[axis] = int64_t(std::clamp(first, 0.0, size - 1)) / TILE, high[axis] = int64_t(std::clamp(last, 0.0, size - 1)) / TILE;
        }
        if (z < 2 * radius) return true;               // the ball is around the eye or nearly so
        float least = 0;
        for (int64_t line = low[1]; line <= high[1]; ++line)
            for (int64_t column = low[0]; column <= high[0]; ++column) {
                const float here = least_[size_t(line * tiles_across_ + column)];
                if (here > 0 && !(least > 0 && least < here)) least = here;
            }
        return least > 0 && z - radius <= (1 / double(least) + double(truncation_)) * (1 + 1e-5);
    }

    // What a row of voxels finds in the depth map.
    struct Row {
        float z[SIDE], u[SIDE], v[SIDE];               // depth; column and row in the planes with their border
        float inverse[SIDE], weight[SIDE];             // zero where the view has nothing to say
    };

    void integrate_row(Block &block, int first, const float *start) const {
        Row row;
        const float last_u = float(view_.W + 1), last_v = float(view_.H + 1);
        for (int i = 0; i < SIDE; ++i) {
            const float z = start[2] + float(i) * step_[2][0];
            const float x = start[0] + float(i) * step_[0][0], y = start[1] + float(i) * step_[1][0];
            const bool ahead = z > std::numeric_limits<float>::min();
            const float scale = 1 / (ahead ? z : 1.0f);
            const float u = ahead ? x * scale + 1 : 0.0f, v = ahead ? y * scale + 1 : 0.0f;
            const float low_u = u > 0 ? u : 0.0f, low_v = v > 0 ? v : 0.0f;
            row.z[i] = z, row.u[i] = low_u < last_u ? low_u : last_u, row.v[i] = low_v < last_v ? low_v : last_v;
        }
        bool any = false;
        for (int i = 0; i < SIDE; ++i) {
            row.inverse[i] = look_up(row.u[i], row.v[i], row.weight[i]);
            any |= row.inverse[i] > 0;
        }
        if (!any) return;
        if (block.color) mix_colors(block, first, row);
        float *distance = block.field.get() + first, *weight = distance + VOXELS;
        const float truncation = truncation_, slope = slope_;
        float distances[SIDE], weights[SIDE];          // so that the compiler need not expect the block to overlap other memory
        for (int i = 0; i < SIDE; ++i) {
            const bool known = row.inverse[i] > 0;
            const float behind = 1 / (known ? row.inverse[i] : 1.0f) - row.z[i];
            // Halfway to the truncation behind the surface the weight begins to fall, so that what lies behind an edge or a thin
            // wall is no match for the views that see it.
            const float ramp = 2 + behind * slope, full = ramp < 1 ? ramp : 1.0f, share = ramp > 0 ? full : 0.0f;
            const float added = known ? row.weight[i] * share : 0.0f, total = weight[i] + added;
            const float clamped = behind < truncation ? behind : truncation;
            distances[i] = distance[i] + (clamped - distance[i]) * (added / (total > 0 ? total : 1.0f)), weights[i] = total;
        }
        std::copy_n(distances, SIDE, distance), std::copy_n(weights, SIDE, weight);
    }

    // The inverse depth at a place of the image, zero where there is no surface: bilinear between four pixels whose depths differ
    // by less than the truncation, else that of the nearest pixel, which counts little. The weight is the nearest pixel's.
    float look_up(float u, float v, float &weight) const {
        const int64_t column = int64_t(int32_t(u)), line = int64_t(int32_t(v)), stride = planes_.stride;
        const float right = u - float(column), down = v - float(line);
        const float *at = planes_.inverse.data() + line * stride + column;
        const float a = at[0], b = at[1], c = at[stride], d = at[stride + 1];
        const int64_t nearest = (down >= 0.5f ? stride : 0) + (right >= 0.5f ? 1 : 0);
        weight = planes_.weights.empty() ? 1.0f : planes_.weights[size_t(line * stride + column + nearest)];
        const float low = std::min(std::min(a, b), std::min(c, d)), high = std::max(std::max(a, b), std::max(c, d));
        // 1 / low - 1 / high < truncation
        if (!(low > 0 && high - low < truncation_ * low * high)) {
            weight *= GUESS;
            return at[nearest];
        }
        const float upper = a + right * (b - a), lower = c + right * (d - c);
        return upper + down * (lower - upper);
    }

    // Only voxels within the truncation take a colour: beyond it, a pixel shows another surface.
    void mix_colors(Block &block, int first, const Row &row) const {
        for (int i = 0; i < SIDE; ++i) {
            if (!(row.inverse[i] > 0 && row.weight[i] > 0)) continue;
            const float behind = 1 / row.inverse[i] - row.z[i];
            if (!(std::abs(behind) <= truncation_)) continue;
            const int64_t column = std::clamp<int64_t>(int64_t(row.u[i] - 0.5f), 0, view_.W - 1);
            const int64_t line = std::clamp<int64_t>(int64_t(row.v[i] - 0.5f), 0, view_.H - 1);
            float *color = block.color.get() + first + i, &weight = color[3 * VOXELS];
            weight += row.weight[i];
            const float share = row.weight[i] / weight;
            for (int c = 0; c < 3; ++c) {
                const int64_t at = 3 * (line * view_.W + column) + c;
                const float value = view_.bytes ? float(view_.bytes[at]) / 255.0f : view_.image[at];
                color[c * VOXELS] += (value - color[c * VOXELS]) * share;
            }
        }
    }

    const DepthView &view_;
    const Planes &planes_;
    double voxel_;
    float truncation_, slope_;                         // slope_: 2 / truncation
    int64_t tiles_across_;
    std::vector<float> least_;                         // the least inverse depth in each tile of pixels; 0 without surface
    double reach_[2][2];
    double KR_[3][3];                                  // intrinsics times rotation: to (u z, v z, z)
    float step_[3][3];                                 // the same for one voxel
};

}  // namespace

VolumeFull::VolumeFull(double needed, double limit, double voxel) {
    const double mib = 1.0 / double(1 << 20);
    std::snprintf(text_, sizeof text_, "volume: needs at least %.1f MiB with this view, but may take %.1f MiB; take a voxel larger than %g",
                  needed * mib, limit * mib, voxel);
}

int64_t Volume::find(int64_t x, int64_t y, int64_t z) const {
    const uint64_t key = block_key(x, y, z);
    const auto at =
        std::lower_bound(blocks_.begin(), blocks_.end(), key, [](const Block &block, uint64_t wanted) { return block.key < wanted; });
    return at != blocks_.end() && at->key == key ? at - blocks_.begin() : -1;
}

void Volume::allocate(const std::vector<uint64_t> &touched, bool colored) {
    std::vector<uint64_t> missing;
    auto at = blocks_.begin();
    for (const uint64_t key : touched) {
        while (at != blocks_.end() && at->key < key) ++at;
        if (at == blocks_.end() || at->key != key) missing.push_back(key);
    }
    const double needed = double(blocks_.size() + missing.size()) * double(block_bytes(colored));
    if (needed > double(max_bytes_)) throw VolumeFull(needed, double(max_bytes_), voxel_);
    if (missing.empty()) return;
    std::vector<Block> added, merged;
    added.reserve(missing.size()), merged.reserve(blocks_.size() + missing.size());
    for (const uint64_t key : missing)
        added.push_back({key, std::make_unique<float[]>(2 * VOXELS), colored ? std::make_unique<float[]>(4 * VOXELS) : nullptr});
    std::merge(std::make_move_iterator(blocks_.begin()), std::make_move_iterator(blocks_.end()), std::make_move_iterator(added.begin()),
               std::make_move_iterator(added.end()), std::back_inserter(merged),
               [](const Block &a, const Block &b) { return a.key < b.key; });
    blocks_ = std::move(merged);
}

void Volume::load(int64_t count, const int64_t *places, const float *distances, const float *weights) {
    if (coloring_ != Coloring::UNKNOWN) throw std::invalid_argument("the volume is not empty");
    std::vector<uint64_t> keys(static_cast<size_t>(count));
    for (int64_t i = 0; i < count; ++i) {
        const int64_t *at = places + 3 * i;
        for (int k = 0; k < 3; ++k)
            if (at[k] <= -LAST_BLOCK || at[k] >= LAST_BLOCK) throw std::invalid_argument("places: name a block beyond the last one");
        keys[size_t(i)] = block_key(at[0], at[1], at[2]);
        if (i && keys[size_t(i)] <= keys[size_t(i) - 1]) throw std::invalid_argument("places: are not sorted by z, then y, then x");
    }
    allocate(keys, false);
    coloring_ = Coloring::NO;
    for (int64_t i = 0; i < count; ++i) {
        float *field = blocks_[size_t(i)].field.get();
        std::copy_n(distances + i * VOXELS, VOXELS, field), std::copy_n(weights + i * VOXELS, VOXELS, field + VOXELS);
    }
}

void Volume::integrate(const DepthView &view, int threads) {
    const bool colored = view.bytes || view.image;
    if (coloring_ != Coloring::UNKNOWN && colored != (coloring_ == Coloring::YES))
        throw std::invalid_argument(colored ? "image: is given, but earlier views had none; give one with every view or with none"
                                            : "image: is missing, but earlier views had one; give one with every view or with none");
    Planes planes(view);
    parallel(threads, view.H, [&](int64_t row, int) { planes.fill_row(view, row); });
    const int64_t strips = (view.H + STRIP - 1) / STRIP, limit = max_bytes_ / block_bytes(colored);
    std::vector<Touched> touched(static_cast<size_t>(strips));
    parallel(threads, strips, [&](int64_t strip, int) {
        Touched &mine = touched[size_t(strip)];
        try {
            mine.collect(view, planes, voxel_, truncation_, strip * STRIP, limit);
        } catch (const std::bad_alloc &) {
            mine.no_memory = true;
        }
    });
    std::vector<uint64_t> keys;
    for (Touched &strip : touched) {
        if (strip.no_memory) throw std::bad_alloc();
        if (strip.outside)
            throw std::invalid_argument("depth: reaches beyond " + std::to_string(LAST_BLOCK * SIDE) +
                                        " voxels from the origin; take a larger voxel");
        if (strip.full) throw VolumeFull(double(strip.keys.size()) * double(block_bytes(colored)), double(max_bytes_), voxel_);
        keys.insert(keys.end(), strip.keys.begin(), strip.keys.end());
        strip.keys = {};
    }
    sort_unique(keys);
    allocate(keys, colored);
    coloring_ = colored ? Coloring::YES : Coloring::NO;
    if (keys.empty()) return;
    const Integrator integrator(view, planes, voxel_, truncation_);
    parallel(threads, int64_t(blocks_.size()), [&](int64_t block, int) { integrator.integrate(blocks_[size_t(block)]); });
}

}  // namespace gsplat
