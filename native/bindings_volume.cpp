#include "bindings_volume.h"

#include <memory>
#include <mutex>
#include <utility>
#include <vector>

#include "marching_cubes.h"
#include "structures.h"
#include "volume.h"

namespace gsplat {
namespace {

constexpr double MOST_VOXELS_OF_TRUNCATION = 64;
constexpr int64_t MOST_PIXELS = 1 << 16;               // along an axis; a float tells places between them apart

// Calls release Python's lock; two threads may hold the same volume.
struct BoundVolume {
    Volume volume;
    mutable std::mutex lock;

    BoundVolume(double voxel, double truncation, int64_t max_bytes) : volume(voxel, truncation, max_bytes) {}
};

void make_volume(BoundVolume *self, nb::args positional, nb::kwargs given) {
    Arguments a("Volume", positional, given);
    const double voxel = a.number("voxel"), truncation = a.number("truncation");
    if (!(voxel >= 1e-30 && voxel <= 1e30)) a.fail("voxel", "has to be 1e-30 to 1e30");
    if (!(truncation >= voxel && truncation <= MOST_VOXELS_OF_TRUNCATION * voxel)) a.fail("truncation", "has to be 1 to 64 voxels");
    const int64_t max_bytes = a.whole("max_bytes", 0, INT64_MAX);
    a.finish();
    new (self) BoundVolume(voxel, truncation, max_bytes);
}

void integrate(BoundVolume &self, nb::args positional, nb::kwargs given) {
    Arguments a("Volume.integrate", positional, given);
    const Array depth = a.array("depth", {Kind::F32}, {ANY, ANY});
    const int64_t H = depth.shape[0], W = depth.shape[1];
    if (H < 1 || W < 1 || H > MOST_PIXELS || W > MOST_PIXELS) a.fail("depth", "has to have 1 to 65536 rows and columns");
    const Array weights = a.array_or_none("weights", Kind::F32, {H, W});
    const bool plain = a.is_none("image");
    const Array image = plain ? Array{} : a.array("image", {Kind::U8, Kind::F32}, {H, W, 3});
    const Array R = a.array("R", {Kind::F64}, {3, 3}), eye = a.array("eye", {Kind::F64}, {3});
    DepthView view{};
    view.depth = depth.as<float>(), view.weights = weights.as<float>(), view.H = int32_t(H), view.W = int32_t(W);
    view.bytes = image && image.is(Kind::U8) ? image.as<uint8_t>() : nullptr,
    view.image = image && !view.bytes ? image.as<float>() : nullptr;
    std::copy_n(R.as<double>(), 9, view.R), std::copy_n(eye.as<double>(), 3, view.eye);
    view.fx = a.number("fx"), view.fy = a.number("fy"), view.cx = a.number("cx"), view.cy = a.number("cy");
    if (!(view.fx > 0)) a.fail("fx", "has to be positive");
    if (!(view.fy > 0)) a.fail("fy", "has to be positive");
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    nb::gil_scoped_release release;
    const std::lock_guard<std::mutex> hold(self.lock);
    self.volume.integrate(view, threads);
}

// Hands a vector's memory to NumPy.
template <class T>
nb::ndarray<nb::numpy, T, nb::ndim<2>> as_rows(std::vector<T> &&values) {
    auto *kept = new std::vector<T>(std::move(values));
    const nb::capsule owner(kept, [](void *memory) noexcept { delete static_cast<std::vector<T> *>(memory); });
    const size_t shape[2] = {kept->size() / 3, 3};
    return nb::ndarray<nb::numpy, T, nb::ndim<2>>(kept->data(), 2, shape, owner);
}

nb::tuple extract_surface(const BoundVolume &self, nb::args positional, nb::kwargs given) {
    Arguments a("Volume.extract", positional, given);
    const double min_weight = a.number("min_weight");
    if (!(min_weight >= 0)) a.fail("min_weight", "has to be at least 0");
    const int threads = int(a.whole("threads", 1, MOST_THREADS));
    a.finish();
    Surface found;
    bool colored;
    {
        nb::gil_scoped_release release;
        const std::lock_guard<std::mutex> hold(self.lock);
        found = extract(self.volume, min_weight, threads);
        colored = self.volume.colored();
    }
    const nb::object colors = colored ? nb::cast(as_rows(std::move(found.colors))) : nb::object(nb::none());
    // NumPy takes the indices for its type longlong, which on Linux is another one than int64.
    const nb::object faces = nb::cast(as_rows(std::move(found.faces))).attr("view")("int64");
    return nb::make_tuple(as_rows(std::move(found.vertices)), faces, colors);
}

void load(BoundVolume &self, nb::args positional, nb::kwargs given) {
    Arguments a("Volume.load", positional, given);
    const Array places = a.array("places", {Kind::I64}, {ANY, 3});
    const Shape shape{places.shape[0], SIDE, SIDE, SIDE};
    const Array distances = a.array("distances", {Kind::F32}, shape), weights = a.array("weights", {Kind::F32}, shape);
    a.finish();
    nb::gil_scoped_release release;
    const std::lock_guard<std::mutex> hold(self.lock);
    self.volume.load(shape[0], places.as<int64_t>(), distances.as<float>(), weights.as<float>());
}

// Writes the place of every block, and its distances and weights, which load takes.
void read(const BoundVolume &self, nb::args positional, nb::kwargs given) {
    Arguments a("Volume.read", positional, given);
    const std::lock_guard<std::mutex> hold(self.lock);
    const std::vector<Block> &blocks = self.volume.blocks();
    const Shape shape{int64_t(blocks.size()), SIDE, SIDE, SIDE};
    int64_t *places = a.array("places", {Kind::I64}, {shape[0], 3}, true).as<int64_t>();
    float *distances = a.array("distances", {Kind::F32}, shape, true).as<float>();
    float *weights = a.array("weights", {Kind::F32}, shape, true).as<float>();
    a.finish();
    for (const Block &block : blocks) {
        for (int axis = 0; axis < 3; ++axis) *places++ = block_axis(block.key, axis);
        distances = std::copy_n(block.distances(), VOXELS, distances), weights = std::copy_n(block.weights(), VOXELS, weights);
    }
}

}  // namespace

void bind_volume(nb::module_ &m) {
    nb::class_<BoundVolume>(m, "Volume")
        .def("__init__", &make_volume)
        .def("integrate", &integrate)
        .def("extract", &extract_surface)
        .def("load", &load)
        .def("read", &read)
        .def_prop_ro("blocks",
                     [](const BoundVolume &self) {
                         const std::lock_guard<std::mutex> hold(self.lock);
                         return int64_t(self.volume.blocks().size());
                     })
        .def_prop_ro("bytes", [](const BoundVolume &self) {
            const std::lock_guard<std::mutex> hold(self.lock);
            return self.volume.bytes();
        });
}

}  // namespace gsplat
