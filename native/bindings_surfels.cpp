// The calls of the native module that 2D Gaussians need; like all calls, they check every array before a kernel gets its address.
#include "bindings_surfels.h"

#include "arguments.h"
#include "buffers.h"
#include "dispatch.h"
#include "structures.h"
#include "threads.h"

namespace gsplat {

namespace {

// What both passes take. Lists are checked here, because a kernel would read outside its arrays.
template <class T>
struct SurfelCall {
    SurfelArgs<T> args{};
    int64_t tiles = 0, pairs = 0, surfels = 0;
    int threads = 0;

    SurfelCall(Arguments &a, bool backward) {
        const Array records = a.array("records", {KIND<T>}, {ANY, SURFEL});
        surfels = records.shape[0];
        const Array channels = a.array("channels", {KIND<T>}, {surfels, ANY});
        const Array begin = a.array("tile_begin", {Kind::I64}, {ANY}), rows = a.array("rows", {Kind::I64}, {ANY});
        const Array image = a.array("image", {KIND<T>}, {ANY, ANY, ANY, channels.shape[1]}, !backward);
        const Shape plane = {image.shape[0], image.shape[1], image.shape[2]};
        args.records = records.as<T>(), args.channels = channels.as<T>(), args.count = channels.shape[1];
        args.tile_begin = begin.as<int64_t>(), args.rows = rows.as<int64_t>(), args.image = image.as<T>();
        args.transmittance = a.array("transmittance", {KIND<T>}, plane, !backward).template as<T>();
        args.distortion = a.array("distortion", {KIND<T>}, plane, !backward).template as<T>();
        args.median = a.array("median", {KIND<T>}, plane, !backward).template as<T>();
        args.median_places = a.array("median_places", {Kind::I64}, plane, !backward).template as<int64_t>();
        args.depth = a.whole("depth", 0, args.count - 1);
        args.H = plane[1], args.W = plane[2], args.edge = a.whole("edge", 1, MOST);
        args.tiles_x = a.whole("tiles_x", 1, 1 << 24), args.tiles_y = a.whole("tiles_y", 1, 1 << 24);
        tiles = plane[0] * args.tiles_x * args.tiles_y, pairs = rows.shape[0];
        args.done = a.array("done", {Kind::I64}, {tiles}, !backward).template as<int64_t>();
        threads = int(a.whole("threads", 1, MOST_THREADS));
        if (begin.shape[0] != tiles + 1 || args.tile_begin[0] != 0 || args.tile_begin[tiles] != pairs ||
            !std::is_sorted(args.tile_begin, args.tile_begin + tiles + 1))
            a.fail("tile_begin", "has to grow from 0 to the number of rows, with an entry for each tile and one more");
        if (!std::all_of(args.rows, args.rows + pairs, [&](int64_t row) { return row >= 0 && row < surfels; }))
            a.fail("rows", "has to hold rows of the records");
    }

    // Runs a kernel on every tile.
    template <class Kernel>
    void run(Kernel kernel) const {
        Buffer scratch;
        const int64_t each = args.scratch();
        T *const numbers = static_cast<T *>(scratch.reserve(size_t(threads * each) * sizeof(T)));
        parallel(threads, tiles, [&](int64_t tile, int worker) { kernel(args, tile, numbers + worker * each); });
    }
};

template <class T>
void surfels(nb::args positional, nb::kwargs given) {
    Arguments a("surfels", positional, given);
    const SurfelCall<T> call(a, false);
    a.finish();
    nb::gil_scoped_release release;
    call.run(kernels<T>().surfels);
}

// Writes the gradients of records and channels, side by side: the sums of each splat's slots, in the order of the tiles.
template <class T>
void surfels_backward(nb::args positional, nb::kwargs given) {
    Arguments a("surfels_backward", positional, given);
    SurfelCall<T> call(a, true);
    SurfelArgs<T> &args = call.args;
    const int64_t images = call.tiles / (args.tiles_x * args.tiles_y), numbers = SURFEL + args.count;
    const Shape plane = {images, args.H, args.W};
    args.grad_image = a.array("grad_image", {KIND<T>}, {images, args.H, args.W, args.count}).template as<T>();
    args.grad_transmittance = a.array("grad_transmittance", {KIND<T>}, plane).template as<T>();
    args.grad_distortion = a.array("grad_distortion", {KIND<T>}, plane).template as<T>();
    args.grad_median = a.array("grad_median", {KIND<T>}, plane).template as<T>();
    T *const out = a.array("out", {KIND<T>}, {call.surfels, numbers}, true).template as<T>();
    a.finish();
    for (int64_t tile = 0; tile < call.tiles; ++tile)
        if (args.done[tile] < 0 || args.done[tile] > args.tile_begin[tile + 1] - args.tile_begin[tile]) a.fail("done", "is out of range");
    nb::gil_scoped_release release;
    Buffer slots, places, begins;
    args.slots = static_cast<T *>(slots.reserve(size_t(call.pairs * numbers + 1) * sizeof(T)));
    auto *const slot_of = static_cast<int64_t *>(places.reserve(size_t(call.pairs + 1) * sizeof(int64_t)));
    auto *const begin = static_cast<int64_t *>(begins.reserve(size_t(call.surfels + 2) * sizeof(int64_t)));
    // The slots of a splat are neighbours: its first is counted here, and moves to its end while the pairs take theirs.
    std::fill_n(begin, call.surfels + 2, 0);
    for (int64_t pair = 0; pair < call.pairs; ++pair) ++begin[args.rows[pair] + 2];
    for (int64_t row = 0; row < call.surfels; ++row) begin[row + 2] += begin[row + 1];
    for (int64_t pair = 0; pair < call.pairs; ++pair) slot_of[pair] = begin[args.rows[pair] + 1]++;
    args.slot_of = slot_of;
    call.run(kernels<T>().surfels_backward);
    parallel(call.threads, (call.surfels + BLOCK - 1) / BLOCK, [&](int64_t block, int) {
        for (int64_t row = block * BLOCK; row < std::min(call.surfels, (block + 1) * BLOCK); ++row) {
            T *const sums = out + numbers * row;
            std::fill_n(sums, numbers, T(0));
            for (int64_t slot = begin[row]; slot < begin[row + 1]; ++slot)
                for (int64_t k = 0; k < numbers; ++k) sums[k] += args.slots[numbers * slot + k];
        }
    });
}

}  // namespace

void bind_surfels(nb::module_ &m) {
    m.def("surfels_f32", &surfels<float>);
    m.def("surfels_f64", &surfels<double>);
    m.def("surfels_backward_f32", &surfels_backward<float>);
    m.def("surfels_backward_f64", &surfels_backward<double>);
}

}  // namespace gsplat
