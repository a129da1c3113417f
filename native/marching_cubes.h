// The surface at distance zero in a volume, as triangles.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "volume.h"

namespace gsplat {

struct Surface {
    std::vector<double> vertices;                      // x, y, z of each
    std::vector<float> colors;                         // red, green, blue of each vertex; empty in a volume without colours
    std::vector<int64_t> faces;                        // three vertices each, counterclockwise as seen from free space
};

// Corner c of a cell is its first voxel plus the bits of c along x, y and z. Edge 4 a + n runs along axis a from the nth
// of the corners whose bit a is zero.
constexpr int CORNERS = 8, EDGES = 12, MOST_TRIANGLES = 5;

constexpr int edge_axis(int edge) { return edge / 4; }

constexpr int edge_corner(int edge) {
    const int below = (1 << edge_axis(edge)) - 1, n = edge % 4;
    return (n & ~below) << 1 | (n & below);
}

// The triangles of a cell, for one choice of the corners that are inside, that is, behind the surface.
struct CellCase {
    int count = 0;
    std::array<uint8_t, 3 * MOST_TRIANGLES> edges{};   // of the three vertices of each triangle
};

// The cases by the bits of the corners that are inside.
const std::array<CellCase, 256> &cell_cases();

// Triangles in every cell whose eight voxels have a weight above `min_weight`; other cells leave a hole. A vertex lies on an edge between
// voxels and is shared by all cells around it. Vertices are ordered by block, voxel and axis, faces by block and cell, on any number of
// threads.
Surface extract(const Volume &volume, double min_weight, int threads);

}  // namespace gsplat
