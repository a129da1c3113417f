#include "marching_cubes.h"

#include <bit>

#include "threads.h"

namespace gsplat {
namespace {

constexpr int AROUND = SIDE + 2;                       // voxels of a block with one more on each side
constexpr int BLOCK_EDGES = 3 * VOXELS, WORDS = BLOCK_EDGES / 64;

// The edges of a block that have a vertex: bit 3 voxel + axis stands for the edge from that voxel along that axis.
struct Used {
    std::array<uint64_t, WORDS> bits{};
    std::array<uint16_t, WORDS> before{};              // vertices on the edges of earlier words
    int64_t first_vertex = 0, first_face = 0;          // in the whole surface

    int64_t vertex(int edge) const {
        const uint64_t earlier = bits[size_t(edge / 64)] & ((uint64_t(1) << edge % 64) - 1);
        return first_vertex + before[size_t(edge / 64)] + std::popcount(earlier);
    }
    // Fills `before` and returns the number of vertices.
    int64_t count() {
        int sum = 0;
        for (size_t word = 0; word < WORDS; ++word) before[word] = uint16_t(sum), sum += std::popcount(bits[word]);
        return sum;
    }
};

// A block and the 26 around it. Voxels are named by their place relative to the block's first, -8 to 15.
class Neighbourhood {
  public:
    struct Place {
        int64_t block;                                 // -1 if it does not exist
        int voxel;
    };

    Neighbourhood(const Volume &volume, int64_t block) : volume_(volume) {
        const uint64_t key = volume.blocks()[size_t(block)].key;
        for (int k = 0; k < 3; ++k) origin_[k] = block_axis(key, k);
        for (int n = 0; n < 27; ++n)
            around_[n] = n == 13 ? block : volume.find(origin_[0] + n % 3 - 1, origin_[1] + n / 3 % 3 - 1, origin_[2] + n / 9 - 1);
    }

    Place at(int x, int y, int z) const {
        const int n = ((z + SIDE) / SIDE * 3 + (y + SIDE) / SIDE) * 3 + (x + SIDE) / SIDE;
        return {around_[n], ((z & 7) * SIDE + (y & 7)) * SIDE + (x & 7)};
    }
    const Block &block(const Place &place) const { return volume_.blocks()[size_t(place.block)]; }
    // The centre of the voxel at 0, 0, 0 along an axis, in voxels.
    double first_centre(int axis) const { return double(origin_[axis] * SIDE) + 0.5; }

  private:
    const Volume &volume_;
    int64_t origin_[3], around_[27];
};

// The distances of a block's cells, and of those before it along each axis. Cells are named by their first voxel, -1 to 7.
class Cells {
  public:
    Cells(const Neighbourhood &around, float min_weight) {
        for (int z = -1; z <= SIDE; ++z)
            for (int y = -1; y <= SIDE; ++y)
                for (int x = -1; x <= SIDE; ++x) {
                    const auto place = around.at(x, y, z);
                    const size_t i = index(x, y, z);
                    known_[i] = place.block >= 0 && around.block(place).weights()[place.voxel] > min_weight;
                    inside_[i] = known_[i] && around.block(place).distances()[place.voxel] < 0;
                    any_inside_ |= inside_[i], any_outside_ |= known_[i] && !inside_[i];
                }
    }

    bool has_surface() const { return any_inside_ && any_outside_; }

    bool complete(int x, int y, int z) const {
        bool all = true;
        for (int c = 0; c < CORNERS; ++c) all &= known_[index(x + (c & 1), y + (c >> 1 & 1), z + (c >> 2))];
        return all;
    }

    // The bits of the corners that are inside; 0 for a cell that is not complete.
    int mask(int x, int y, int z) const {
        int bits = 0;
        for (int c = 0; c < CORNERS; ++c) bits |= int(inside_[index(x + (c & 1), y + (c >> 1 & 1), z + (c >> 2))]) << c;
        return bits == 0 || bits == 255 || !complete(x, y, z) ? 0 : bits;
    }

    // Whether the edge from this voxel has a vertex: it crosses the surface, and one of the four cells around it is complete.
    bool has_vertex(const std::array<int, 3> &voxel, int axis) const {
        std::array<int, 3> end = voxel;
        ++end[size_t(axis)];
        const size_t a = index(voxel[0], voxel[1], voxel[2]), b = index(end[0], end[1], end[2]);
        if (!known_[a] || !known_[b] || inside_[a] == inside_[b]) return false;
        for (int n = 0; n < 4; ++n) {
            std::array<int, 3> cell = voxel;
            cell[size_t((axis + 1) % 3)] -= n & 1, cell[size_t((axis + 2) % 3)] -= n >> 1;
            if (complete(cell[0], cell[1], cell[2])) return true;
        }
        return false;
    }

  private:
    static size_t index(int x, int y, int z) { return size_t(((z + 1) * AROUND + y + 1) * AROUND + x + 1); }

    std::array<bool, AROUND * AROUND * AROUND> known_, inside_;
    bool any_inside_ = false, any_outside_ = false;
};

template <class Visit>
void for_each_voxel(const Visit &visit) {
    for (int voxel = 0; voxel < VOXELS; ++voxel) visit(voxel, std::array<int, 3>{voxel % SIDE, voxel / SIDE % SIDE, voxel / (SIDE * SIDE)});
}

// Marks the edges of a block that have a vertex, and counts its faces into first_face.
void mark(const Volume &volume, int64_t block, float min_weight, Used &used) {
    const Cells cells(Neighbourhood(volume, block), min_weight);
    if (!cells.has_surface()) return;
    for_each_voxel([&](int voxel, const std::array<int, 3> &at) {
        for (int axis = 0; axis < 3; ++axis)
            if (cells.has_vertex(at, axis)) used.bits[size_t(3 * voxel + axis) / 64] |= uint64_t(1) << (3 * voxel + axis) % 64;
        used.first_face += cell_cases()[size_t(cells.mask(at[0], at[1], at[2]))].count;
    });
}

void write_vertex(const Neighbourhood &around, double voxel_size, const std::array<int, 3> &at, int axis, double *position, float *color) {
    std::array<int, 3> other = at;
    ++other[size_t(axis)];
    const auto a = around.at(at[0], at[1], at[2]), b = around.at(other[0], other[1], other[2]);
    const double from = around.block(a).distances()[a.voxel], to = around.block(b).distances()[b.voxel];
    const double along = from / (from - to);
    for (int k = 0; k < 3; ++k) position[k] = (around.first_centre(k) + at[size_t(k)] + (k == axis ? along : 0.0)) * voxel_size;
    if (!color) return;
    const float *first = around.block(a).color.get() + a.voxel, *second = around.block(b).color.get() + b.voxel;
    // The end in front of the surface may have no colour; the one behind it always has, because some view saw it near the surface.
    const double share = !(first[3 * VOXELS] > 0) ? 1.0 : !(second[3 * VOXELS] > 0) ? 0.0 : along;
    for (int c = 0; c < 3; ++c) color[c] = float((1 - share) * double(first[c * VOXELS]) + share * double(second[c * VOXELS]));
}

// Writes the vertices and the faces of one block.
void write(const Volume &volume, int64_t block, float min_weight, const std::vector<Used> &used, Surface &out) {
    const Used &mine = used[size_t(block)];
    const Neighbourhood around(volume, block);
    const Cells cells(around, min_weight);
    if (!cells.has_surface()) return;
    int64_t vertex = mine.first_vertex;
    int64_t *face = out.faces.data() + 3 * mine.first_face;
    for_each_voxel([&](int voxel, const std::array<int, 3> &at) {
        for (int axis = 0; axis < 3; ++axis) {
            const int edge = 3 * voxel + axis;
            if (!(mine.bits[size_t(edge / 64)] >> edge % 64 & 1)) continue;
            float *color = volume.colored() ? out.colors.data() + 3 * vertex : nullptr;
            write_vertex(around, volume.voxel(), at, axis, out.vertices.data() + 3 * vertex, color);
            ++vertex;
        }
        const CellCase &found = cell_cases()[size_t(cells.mask(at[0], at[1], at[2]))];
        for (int k = 0; k < 3 * found.count; ++k) {
            const int edge = found.edges[size_t(k)], corner = edge_corner(edge);
            const auto place = around.at(at[0] + (corner & 1), at[1] + (corner >> 1 & 1), at[2] + (corner >> 2));
            *face++ = used[size_t(place.block)].vertex(3 * place.voxel + edge_axis(edge));
        }
    });
}

}  // namespace

Surface extract(const Volume &volume, double min_weight, int threads) {
    const int64_t blocks = int64_t(volume.blocks().size());
    const float bound = float(min_weight);
    cell_cases();  // made here, because a task must not wait for another one that makes them
    std::vector<Used> used(static_cast<size_t>(blocks));
    parallel(threads, blocks, [&](int64_t block, int) { mark(volume, block, bound, used[size_t(block)]); });
    int64_t vertices = 0, faces = 0;
    for (Used &each : used) {
        const int64_t its_faces = each.first_face;
        each.first_face = faces, faces += its_faces;
        each.first_vertex = vertices, vertices += each.count();
    }
    Surface out;
    out.vertices.resize(size_t(3 * vertices)), out.faces.resize(size_t(3 * faces));
    if (volume.colored()) out.colors.resize(size_t(3 * vertices));
    parallel(threads, blocks, [&](int64_t block, int) { write(volume, block, bound, used, out); });
    return out;
}

}  // namespace gsplat
