// SIMD: a row of sixteen pixels at once, in vector extensions, and 2^p as a polynomial.
#include "ellipse.h"
#include "tile.h"

typedef float V __attribute__((vector_size(4 * TILE)));
typedef int32_t M __attribute__((vector_size(4 * TILE)));

static V all(float x) { return x - V{}; }

// 2^p = 2^n 2^f with n the nearest integer: adding 1.5 * 2^23 leaves no bits for the fraction. 2^f, |f| <= 1/2, is a
// polynomial good to 2.4e-7, and 2^n is added to the exponent's bits. 0 where p is below the floor.
static V exp2_above_floor(V p) {
    const V magic = all(12582912.0f), least = all(gsplat::LOG2_ALPHA_MIN), most = all(gsplat::LOG2_ALPHA_MAX);
    const M keep = p >= least;
    p = p < most ? p : most;
    p = p > least ? p : least;  // a smaller one would run out of exponent
    const V n = (p + magic) - magic, f = p - n;
    V y = all(1.33952915e-3f);
    y = y * f + all(9.67037690e-3f);
    y = y * f + all(5.55033013e-2f);
    y = y * f + all(2.40222633e-1f);
    y = y * f + all(6.93147182e-1f);
    y = y * f + all(1.0f);
    return (V)(keep & ((M)y + (__builtin_convertvector(n, M) << 23)));
}

// A splat in base 2, in one place: log2(alpha) = log2(o) + a dx² + b dx dy + c dy².
struct Record {
    float u, v, a, b, c, log2_o, color[3];
};

// Draws one splat into the rows y0 to y1 of a tile; says whether one of these rows still lets light through.
static bool draw(Tile &tile, const Record &r, int y0, int y1, M &mattered) {
    V lane;
    for (int x = 0; x < TILE; ++x) lane[x] = float(x);
    const V dx = lane + all(tile.x0 - r.u);
    const V along = all(r.log2_o) + all(r.a) * dx * dx, cross = all(r.b) * dx;  // what does not depend on the row
    V brightest{};
    for (int y = y0; y <= y1; ++y) {
        const V dy = all(tile.y0 + y - r.v);
        const V alpha = exp2_above_floor(along + dy * (cross + all(r.c) * dy));
        V &T = *(V *)tile.T[y];
        const V w = T * alpha;
        *(V *)tile.red[y] += w * all(r.color[0]);
        *(V *)tile.green[y] += w * all(r.color[1]);
        *(V *)tile.blue[y] += w * all(r.color[2]);
        T -= w;
        brightest = brightest > T ? brightest : T;
        mattered -= w > V{};
    }
    const M light = brightest >= all(DARK);
    int any = 0;
    for (int x = 0; x < TILE; ++x) any |= light[x];
    return any != 0;
}

static bool dark(const Tile &tile) {
    float brightest = 0;
    for (const auto &row : tile.T)
        for (const float T : row) brightest = std::max(brightest, T);
    return brightest < DARK;
}

extern "C" void simd(const Splats *s, Drawn *out) {
    constexpr float LOG2_E = 1.44269504f;
    std::vector<Ellipse> ellipses;
    std::vector<Record> records;
    ellipses.reserve(s->count), records.reserve(s->count);
    for (int64_t i = 0; i < s->count; ++i) {
        const Ellipse &e = ellipses.emplace_back(*s, i);
        const float *c = s->colors + 3 * i, log2_o = std::log2(s->opacities[i]);
        records.push_back({e.u, e.v, -0.5f * LOG2_E * e.A, -LOG2_E * e.B, -0.5f * LOG2_E * e.C, log2_o, {c[0], c[1], c[2]}});
    }
    const Lists lists = tight_lists(*s, ellipses);
    out->pairs = int64_t(lists.splat.size());
    M mattered{};
    for (int64_t index = 0; index < int64_t(lists.begin.size()) - 1; ++index) {
        Tile tile(*s, index % lists.across, index / lists.across);
        for (int64_t k = lists.begin[index]; k < lists.begin[index + 1]; ++k) {
            const int32_t i = lists.splat[k];
            const int y0 = std::max(ellipses[i].first_row() - tile.y0, 0);
            const int y1 = std::min(ellipses[i].last_row(s->H) - tile.y0, TILE - 1);
            out->evaluated += TILE * (y1 - y0 + 1);
            if (!draw(tile, records[i], y0, y1, mattered) && dark(tile)) break;
        }
        tile.write(*s, out);
        for (int x = 0; x < TILE; ++x) out->mattered += mattered[x];
        mattered = M{};
    }
}
