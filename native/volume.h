// A sparse volume of truncated signed distances: blocks of 8 x 8 x 8 voxels around the surfaces that the views saw.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <new>
#include <vector>

namespace gsplat {

constexpr int SIDE = 8, VOXELS = SIDE * SIDE * SIDE;

// One view of the surfaces. Every plane is H x W; a weight or a depth that is not positive and finite marks a pixel without surface.
struct DepthView {
    const float *depth;                                // along the camera's z, world units
    const float *weights;                              // null: 1 everywhere
    const uint8_t *bytes;                              // H x W x 3, sRGB; null if the image has floats or there is none
    const float *image;                                // H x W x 3, 0 to 1; null likewise
    int32_t H, W;
    double R[9], eye[3];
    double fx, fy, cx, cy;
};

// The voxel (i, j, k) of block (x, y, z) has its centre at voxel * (8 (x, y, z) + (i, j, k) + 1/2); i changes fastest.
struct Block {
    uint64_t key;                                      // orders blocks by z, then y, then x
    std::unique_ptr<float[]> field;                    // distances, then weights
    std::unique_ptr<float[]> color;                    // red, green, blue, then their weights; null in a volume without colours

    const float *distances() const { return field.get(); }
    const float *weights() const { return field.get() + VOXELS; }
};

// Blocks are numbered from -LAST_BLOCK to LAST_BLOCK along each axis.
constexpr int64_t LAST_BLOCK = (int64_t(1) << 20) - 1;

inline uint64_t block_key(int64_t x, int64_t y, int64_t z) {
    return uint64_t(z + LAST_BLOCK) << 42 | uint64_t(y + LAST_BLOCK) << 21 | uint64_t(x + LAST_BLOCK);
}

inline int64_t block_axis(uint64_t key, int axis) { return int64_t(key >> (21 * axis) & ((1 << 21) - 1)) - LAST_BLOCK; }

// The blocks that a view needs would exceed the volume's limit.
class VolumeFull : public std::bad_alloc {
  public:
    VolumeFull(double needed, double limit, double voxel);
    const char *what() const noexcept override { return text_; }

  private:
    char text_[200];
};

class Volume {
  public:
    Volume(double voxel, double truncation, int64_t max_bytes) : voxel_(voxel), truncation_(truncation), max_bytes_(max_bytes) {}

    // Adds one view: every voxel that it sees in front of the surface, or less than the truncation behind it, takes the
    // distance into its weighted mean. The bits depend on the order of the views, not on the threads.
    // If it throws, the volume is unchanged: VolumeFull; std::bad_alloc; std::invalid_argument if the depth reaches beyond the
    // last block, or if an image is given to a volume without colours or missing for one that has them.
    void integrate(const DepthView &view, int threads);

    // Fills an empty volume with blocks, named by x, y and z and sorted by z, then y, then x; it gets no colours. Throws as integrate does.
    void load(int64_t count, const int64_t *places, const float *distances, const float *weights);

    double voxel() const { return voxel_; }
    const std::vector<Block> &blocks() const { return blocks_; }
    bool colored() const { return coloring_ == Coloring::YES; }
    int64_t bytes() const { return int64_t(blocks_.size()) * block_bytes(colored()); }
    // The index of the block, -1 if there is none.
    int64_t find(int64_t x, int64_t y, int64_t z) const;

  private:
    enum class Coloring { UNKNOWN, NO, YES };          // the first view decides
    static int64_t block_bytes(bool colored) { return int64_t(sizeof(Block) + (colored ? 6 : 2) * VOXELS * sizeof(float)); }
    void allocate(const std::vector<uint64_t> &touched, bool colored);

    double voxel_, truncation_;
    int64_t max_bytes_;
    std::vector<Block> blocks_;                        // sorted by key
    Coloring coloring_ = Coloring::UNKNOWN;
};

}  // namespace gsplat
