// The triangles of the 256 cases of a cell, derived from its faces.
//
// On a face, the corners that are inside form one or two runs around its border. Each run is cut off by a segment between
// the edge where the run begins and the edge where it ends. The segments depend on the four signs of the face only, so that
// the two cells at a face draw the same ones, in opposite directions: the surface has no cracks, also where two opposite
// corners are inside and two segments could be drawn in another way. Each crossed edge has two faces in a cell. A run begins
// there on the one and ends on the other, so that the segments form closed loops. A loop becomes triangles whose further sides
// run through the inside of the cell, and never along a face, where those of the next cell could coincide with them.

#include <array>
#include <cstdlib>
#include <vector>

#include "marching_cubes.h"

namespace gsplat {
namespace {

using Ring = std::array<int, 4>;
constexpr int NONE = -1;

// The corners around a face, counterclockwise as seen from outside the cell; face 2 a + s lies at side s of axis a.
Ring ring_of(int face) {
    const int axis = face / 2, side = face % 2, b = 1 << (axis + 1) % 3, c = 1 << (axis + 2) % 3, base = side << axis;
    return side ? Ring{base, base | b, base | b | c, base | c} : Ring{base, base | c, base | b | c, base | b};
}

int edge_between(int a, int b) {
    for (int edge = 0; edge < EDGES; ++edge) {
        const int from = edge_corner(edge), to = from | 1 << edge_axis(edge);
        if ((a == from && b == to) || (a == to && b == from)) return edge;
    }
    return NONE;
}

bool on_face(int edge, int face) {
    const int axis = face / 2, side = face % 2;
    return edge_axis(edge) != axis && (edge_corner(edge) >> axis & 1) == side;
}

bool on_one_face(int a, int b) {
    for (int face = 0; face < 6; ++face)
        if (on_face(a, face) && on_face(b, face)) return true;
    return false;
}

// For each crossed edge the next one of its loop.
std::array<int, EDGES> segments(int inside) {
    std::array<int, EDGES> next;
    next.fill(NONE);
    for (int face = 0; face < 6; ++face) {
        const Ring ring = ring_of(face);
        const auto is_inside = [&](int k) { return (inside >> ring[size_t(k % 4)] & 1) != 0; };
        const auto edge_after = [&](int k) { return edge_between(ring[size_t(k % 4)], ring[size_t((k + 1) % 4)]); };
        for (int k = 0; k < 4; ++k) {
            if (is_inside(k) || !is_inside(k + 1)) continue;
            int last = k + 1;
            while (is_inside(last + 1)) ++last;
            next[size_t(edge_after(k))] = edge_after(last);
        }
    }
    return next;
}

// Triangulates the part of a loop from `first` to `last`, whose closing side exists already. False if some side would lie on a face.
bool triangulate(const std::vector<int> &loop, size_t first, size_t last, CellCase &out) {
    if (last - first < 2) return true;
    for (size_t middle = first + 1; middle < last; ++middle) {
        if (middle > first + 1 && on_one_face(loop[first], loop[middle])) continue;
        if (middle + 1 < last && on_one_face(loop[middle], loop[last])) continue;
        const CellCase before = out;
        for (const size_t corner : {first, middle, last}) {
            if (out.count == MOST_TRIANGLES) std::abort();
            out.edges[size_t(3 * out.count) + (corner == first ? 0 : corner == middle ? 1 : 2)] = uint8_t(loop[corner]);
        }
        ++out.count;
        if (triangulate(loop, first, middle, out) && triangulate(loop, middle, last, out)) return true;
        out = before;
    }
    return false;
}

CellCase make_case(int inside) {
    CellCase made;
    std::array<int, EDGES> next = segments(inside);
    for (int edge = 0; edge < EDGES; ++edge) {
        std::vector<int> loop;
        for (int at = edge; next[size_t(at)] != NONE;) {
            loop.push_back(at);
            const int after = next[size_t(at)];
            next[size_t(at)] = NONE;
            at = after;
        }
        if (!loop.empty() && !triangulate(loop, 0, loop.size() - 1, made))
            std::abort();  // every case has a triangulation: the tests try all
    }
    return made;
}

}  // namespace

const std::array<CellCase, 256> &cell_cases() {
    static const std::array<CellCase, 256> cases = [] {
        std::array<CellCase, 256> made;
        for (int inside = 0; inside < 256; ++inside) made[size_t(inside)] = make_case(inside);
        return made;
    }();
    return cases;
}

}  // namespace gsplat
