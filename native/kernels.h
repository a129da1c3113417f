// Inputs and outputs of the kernels: raw pointers and sizes, the same for every instruction set.
//
// A kernel processes a range of items and writes only their outputs, so any number of threads may run any ranges in any
// order and the result is the same to the bit.
#pragma once

#include <stdint.h>

#include "constants.h"

namespace gsplat {

// The projections, in the order of `PROJECTIONS` in src/gsplat_edu/scene/projection.py; a pinhole at rest has kernels of its own.
enum Lens : int32_t { PERSPECTIVE, FISHEYE, EQUIRECTANGULAR, ORTHOGRAPHIC, PINHOLE };

constexpr int COEFFICIENTS = 15;                       // of a distortion

// A camera in OpenCV axes: x_cam = R (x - eye); of a pinhole, u = fx x/z + cx. What follows H and W is of other cameras only.
struct Camera {
    double R[9];
    double eye[3];
    double fx, fy, cx, cy;
    double x_low, x_high, y_low, y_high;               // bounds of x/z and y/z inside the Jacobian; may be infinite
    int32_t H, W;
    Lens lens;
    bool bounded;                                      // whether a perspective lens or shutter has such bounds; see lens.h
    bool distorted, radial_first;                      // whether there are coefficients; see lens.h
    bool along_ray;                                    // whether depth is the distance, not z
    bool moving;                                       // whether there is a rolling shutter
    int32_t axis;                                      // 0 if columns are read in turn, 1 if rows are
    double coefficients[COEFFICIENTS];
    double widest;                                     // of a fisheye cos, of a perspective lens tan² of the widest angle
    double turn[3], shift[3], pace, middle;            // see sight.h; pace is 0 for a global shutter with motion blur
    double spread;                                     // exposure / sqrt(12); 0 for no motion blur
    bool wraps() const { return lens == EQUIRECTANGULAR; }
};

// Settings of one render.
struct Settings {
    double z_near;
    double background[3];
    int32_t sh_degree;
    int32_t antialiased;
    double dilation, dilation2;                        // px², added to the diagonal; its square
    double alpha_max, log2_alpha_max;                  // clamp of alpha, below 1
    bool pixel_stop;                                   // each pixel ends by itself, see tile.h
};

// The images of one render; the last three may be null. 1 to MOST_CHANNELS channels of features.
template <class T>
struct Images {
    T *image, *transmittance, *depth, *median, *features;  // H W 3, H W, H W, H W, H W channels
    int32_t channels;
};

// The loss's gradients of the images; all but the first may be null, which means zero.
template <class T>
struct ImageGrads {
    const T *image, *transmittance, *depth, *features;
};

constexpr int MOST_CHANNELS = 32;

// N Gaussians: raw parameters if quats is not null, otherwise covariances, colours and opacities.
template <class T>
struct Scene {
    int64_t n;
    const T *means;                                    // N 3
    const T *quats, *log_scales;                       // N 4, N 3
    const T *sh0, *sh_rest, *logit_opacities;          // N 3, N rest 3, N
    int32_t rest;                                      // coefficients per channel in sh_rest
    const double *cov3ds;                              // N 3 3; in float the determinants of thin ones would lose their digits
    const T *colors, *opacities;                       // N 3, N
    const T *order;                                    // N, not negative, what to sort by instead of the depth; or null
};

// Gradients of the scene; every entry of a range is written, including zeros.
template <class T>
struct SceneGrads {
    T *means, *quats, *log_scales, *sh0, *sh_rest, *logit_opacities;
    double *cov3ds;
    T *colors, *opacities;
    T *features;                                       // N channels; null if there are none
    T *means2d_norm;                                   // N, |(gu W/2, gv H/2)|
    int64_t first;                                     // Gaussian in the first row of the arrays except means2d_norm
};

// One visible Gaussian on the screen, in base 2: alpha = 2^(log2_o - s² - t²), s = s0 + sx dx + sy dy, t = t0 + ty dy.
//
// Two squares cannot cancel; the terms of a polynomial in dx and dy do if an ellipse is longer than it is wide.
// (dx, dy) is the pixel minus (x, y), the point of the image nearest to the mean, so a mean far outside costs no digits.
// No factor exceeds sqrt(log2(e) / 2 / d) per px with the dilation d, 1.55 for 0.3, nor 850 without one (THINNEST).
// In float a splat has 64 bytes: one cache line.
template <class T>
struct Splat {
    T u, v;                                            // mean, px
    T x, y;
    T sx, sy, ty;
    T s0, t0;
    T log2_o;
    T color[3];
    T depth;
    T extent[2];                                       // half width and height of alpha >= 1/255, px
};

// One Gaussian in one tile: its index, and the slot of its partial gradients.
struct Pair {
    uint32_t gaussian;
    uint32_t slot;
};

// Partial sums of one pair, in this order: w g by colour channel, the moments of h, and w times the depth's gradient.
enum Sum { RED, GREEN, BLUE, H, HX, HXX, HY, HXY, HYY, DEPTH, SLOT };

// Neighbouring tiles of one row.
struct TileRun {
    uint32_t first, count;
};

// The runs of tiles that one Gaussian meets, top to bottom, kept between counting and writing. Where there are more than KEPT,
// they are worked out again.
struct TileRuns {
    static constexpr uint32_t KEPT = 3;
    uint32_t rows;                                     // number of runs
    TileRun runs[KEPT];
};

struct Grid {
    int32_t tiles_x, tiles_y;
    int32_t tiles() const { return tiles_x * tiles_y; }
};

template <class T>
struct ProjectArgs {
    Scene<T> scene;
    Camera camera;
    Settings settings;
    Splat<T> *splats;                                  // N, filled where visible
    uint32_t *visible;                                 // ids, at the beginning of each block
    uint32_t *block_visible;                           // count per block of BLOCK Gaussians
};

template <class T>
struct IntersectArgs {
    const Splat<T> *splats;
    const uint32_t *sorted;                            // ids, near to far
    Grid grid;
    Camera camera;
    TileRuns *runs;                                    // of the sorted Gaussians
    uint32_t *pairs_of;                                // N, number of tiles that each Gaussian touches
    const uint32_t *slot_begin;                        // N, first slot of each Gaussian
    Pair *pairs;
    const uint32_t *drawn_before;                      // tiles + 1, how many of the tiles before each are drawn; null if all are
};

template <class T>
struct CompositeArgs {
    const Splat<T> *splats;
    const Pair *pairs;
    const uint32_t *tile_begin;                        // tiles + 1
    Grid grid;
    Camera camera;
    Settings settings;
    Images<T> out;
    const T *features;                                 // N channels; null if out.features is
    uint32_t *done;                                    // tiles, pairs composited before the tile ended
    uint8_t *rows;                                     // batches x Kernels::rows_bytes, for the backward pass
};

// Pairs of a tile that are taken together. The batches of a tile follow those of the tiles before, with at most one unused.
constexpr uint32_t BATCH = 16;
inline int64_t first_batch(const uint32_t *tile_begin, int64_t tile) { return tile_begin[tile] / BATCH + tile; }

// What one pair contributes besides gradients: sums over its pixels of |dL/du|, |dL/dv|, w, [w > 0] and w times the error of
// the pixel, and the largest w.
enum Statistic { ABS_U, ABS_V, WEIGHT, PIXELS, WEIGHTED_ERROR, WEIGHT_MAX, STATISTICS };

template <class T>
struct CompositeBackwardArgs {
    CompositeArgs<T> forward;
    ImageGrads<T> in;
    T *slots;                                          // pairs x SLOT
    T *tile_background;                                // tiles x 3, sum of g T_final
    T *feature_slots;                                  // pairs x channels, sums of w times in.features, which may be null with it
    T *statistic_slots;                                // pairs x STATISTICS; null if not wanted
    const T *errors;                                   // H W; null for zero
};

// Numbers of a pinhole's gradient: R row by row, the eye, fx, fy, cx, cy; of other cameras also the coefficients, turn and shift.
constexpr int CAMERA = 16;
constexpr int LENS_CAMERA = CAMERA + COEFFICIENTS + 6;
inline int camera_numbers(const Camera &camera) { return camera.lens == PINHOLE ? CAMERA : LENS_CAMERA; }

template <class T>
struct ProjectBackwardArgs {
    Scene<T> scene;
    Camera camera;
    Settings settings;
    const uint32_t *pairs_of, *slot_begin;
    const T *slots;
    SceneGrads<T> grads;
    double *camera_sums;                               // blocks x camera_numbers, gradients of the camera; null if not wanted
};

struct AdamNumbers {
    double rate, beta1, beta2, eps, correction1, correction2;
};

template <class T>
struct AdamArgs {
    T *parameter, *first, *second;
    const T *gradient, *extra;                         // the gradient is their sum; extra may be null
    AdamNumbers numbers;
};

// Adam's groups of a scene of raw parameters.
enum Group { MEANS, QUATS, LOG_SCALES, SH0, SH_REST, LOGIT_OPACITIES, GROUPS };

// A step of Adam in the backward pass: `backward` has no gradient arrays but means2d_norm, and `groups` no gradients.
template <class T>
struct AdamBackwardArgs {
    ProjectBackwardArgs<T> backward;
    AdamArgs<T> groups[GROUPS];
    int64_t widths[GROUPS];                            // numbers per Gaussian
};

template <class T>
struct NoiseArgs {
    T *means;                                          // N 3
    const T *quats, *log_scales, *logit_opacities;     // N 4, N 3, N
    uint64_t seed;
    double amount, sharpness, threshold;
};

constexpr int64_t RECOLOR_PIXELS = 4096;               // per task, so that the order of the sums depends on the image only
constexpr int RECOLOR_NUMBERS = 12;                    // of a matrix 3 x 4, row by row
constexpr int RECOLOR_SUMS = RECOLOR_NUMBERS + 3;      // and of the shift

template <class T>
struct RecolorArgs {
    const T *image;                                    // pixels x 3
    const uint8_t *photo;                              // pixels x 3, or null
    int64_t pixels;
    T matrix[RECOLOR_NUMBERS];
    const T *transmittance;                            // pixels, or null
    T shift[3];                                        // added to the corrected colour times the transmittance
    const T *falloff;                                  // pixels, or null
    T background[3];
    T *out;                                            // pixels x 3: the corrected image, or in the backward pass the image's gradient
    const T *grad;                                     // pixels x 3, only in the backward pass: the corrected image's gradient
    T *grad_transmittance;                             // pixels; null if transmittance is
    double *sums;                                      // tasks x 15: each task's part of the gradients of matrix and shift; or null

    int64_t tasks() const { return (pixels + RECOLOR_PIXELS - 1) / RECOLOR_PIXELS; }
};

constexpr int SSIM_HALF = 5;                           // taps on each side of the central one
constexpr int SSIM_BLOCK = 16;                         // rows that are processed together, a multiple of every vector width
constexpr int64_t SSIM_ROWS = 150;                     // image rows per task, at most; with half a window on each side, whole blocks
constexpr int64_t SSIM_STRIP = 784;                    // and numbers of each row; a multiple of every vector width,
constexpr int64_t SSIM_EDGE = 16;                      // like this, which is at least half a window

template <class T>
struct LossArgs {
    const T *image, *target;                           // H W 3
    const uint8_t *target_bytes;                       // H W 3, used instead of target if not null
    int32_t H, W;
    double ssim_weight;
    T *grad;                                           // H W 3
    double *sums;                                      // tasks x 2: sums of |x - y| and of SSIM

    // Tasks depend on the size of the image only, so that the order of the sums does.
    int64_t strips() const { return (3 * int64_t(W) + SSIM_STRIP - 1) / SSIM_STRIP; }
    int64_t bands() const { return (H + SSIM_ROWS - 1) / SSIM_ROWS; }
    int64_t rows() const {
        constexpr int64_t AROUND = 2 * SSIM_HALF;
        return H ? ((H + bands() - 1) / bands() + AROUND + SSIM_BLOCK - 1) / SSIM_BLOCK * SSIM_BLOCK - AROUND : 0;
    }
    int64_t tasks() const { return strips() * bands(); }
    // Number of scratch values that a thread needs.
    static constexpr int64_t SCRATCH = 2 * 3 * SSIM_BLOCK * (SSIM_STRIP + 2 * SSIM_EDGE);
};

// The normals of Gaussians, and the gradient of the quaternions for theirs.
template <class T>
struct NormalArgs {
    const T *means, *quats, *log_scales;               // n 3, n 4, n 3
    int64_t n;
    double eye[3];
    T *out;                                            // n 3
    const T *grad;                                     // n 3, only in the backward pass
    T *grad_quats;                                     // n 4, only in the backward pass
};

// The rays of a camera's pixels. A frame is the camera when a pixel is read: 9 numbers from its axes to the world's, row by row,
// and the centre less that at half time.
template <class T>
struct RayImage {
    const T *rays;  // H W 3, of depth 1, in the frame's axes; 0 where there is none; null for a pinhole
    const double *frames;  // 12 numbers each
    int32_t by_row, by_column;  // 1 if rows, or columns, have a frame each; one frame otherwise
    int32_t wraps;  // 1 if the first and the last column are neighbours, as in a panorama

    const double *frame(int64_t row, int64_t column) const { return frames + 12 * (row * by_row + column * by_column); }
};

// How far composited normals are from those of the depth; surface.cpp has the formulas.
template <class T>
struct SurfaceArgs {
    const T *normals, *depth, *alpha;  // H W 3 in world axes; H W: sum w z; H W
    int32_t H, W;
    RayImage<T> lens;  // of another camera than a pinhole
    double R[9], fx, fy, cx, cy;  // world to camera, row by row; of a pinhole
    double scale, jump;  // factor of the loss, largest jump of the depth
    T *depths, *tangents;  // scratch: H W, H W 6
    T *grad_normals, *grad_depth, *grad_alpha;  // as their primals
    double *sums;  // H: the loss of each row
};

// Gaussians on the screen of a pinhole, as screen.cpp projects them; all but the scene is double.
constexpr int SCREEN_CAMERA = 16;                      // the matrix row by row, fx, fy, cx, cy

template <class T>
struct ScreenArgs {
    int64_t n;
    const T *means, *quats, *scales;                   // n 3, n 4, n 3
    const T *covars;                                   // n 6, upper triangles, instead of quats and scales
    double viewmat[12], K[4], size[2];                 // world to camera, 3 x 4; fx, fy, cx, cy; width and height
    double margin, z_near, z_far, eps2d;
    double *centres, *depths, *conics, *compensations, *spreads;  // n 2, n, n 3, n, n 3
    uint8_t *drawable;                                 // n, between near and far, and not too thin
    const double *grad_centres, *grad_depths, *grad_conics, *grad_compensations, *grad_spreads;  // backward only; null for 0
    T *grad_means, *grad_quats, *grad_scales, *grad_covars;  // to which the gradients are added
    double *camera_sums;                               // blocks x SCREEN_CAMERA
};

// Half sizes of the boxes around what is on the screen, px, rounded up; 0 for what is not drawn.
template <class T>
struct RadiusArgs {
    int64_t n;
    const double *centres, *spreads;                   // n 2, n 3
    const uint8_t *drawable;                           // n
    const T *opacities;                                // n; null for radii that suit every opacity
    const double *compensations;                       // n, factors of the opacities; null for 1
    double size[2], eps2d, extent, radius_clip;        // extent: the largest half size, standard deviations
    int32_t *radii;                                    // n 2
};

// Colours of harmonics without offset and floor, in directions of any length.
template <class T>
struct HarmonicArgs {
    int64_t n, rows, stored;                           // directions; rows of coefficients, and how many each has
    int32_t degree;
    const T *directions, *coefficients;                // n 3, rows stored 3
    const int64_t *row_of, *index_of;                  // n, no row twice; rows, the direction of each, or -1
    T *colors;                                         // n 3
    const T *grad_colors;                              // n 3, only in the backward pass
    T *grad_directions, *grad_coefficients;            // as their primals
    bool overwrites;                                   // whether the coefficients' gradients replace what was there
    int used() const { return (degree + 1) * (degree + 1); }
};

// Numbers of a surfel's record: the lines A, B and C, the centre less the reference point, the opacity, the reference point. In a
// slot of gradients, the last two are sums of the absolute values of the centre's gradient.
enum Surfel { LINES, CENTRE = 9, OPACITY = 11, REFERENCE = 12, SURFEL = 14 };

// 2D Gaussians of several images and their lists of tiles, image after image and row by row; surfels.cpp has the formulas.
template <class T>
struct SurfelArgs {
    const T *records, *channels;                       // M SURFEL, M count
    int64_t count, depth;                              // number of channels; which one distortion and median are of
    const int64_t *tile_begin, *rows;                  // tiles + 1; rows of the records, each tile's near to far
    int64_t H, W, edge, tiles_x, tiles_y;              // of one image, px and tiles
    T *image, *transmittance, *distortion, *median;    // images H W count, and images H W
    int64_t *median_places, *done;                     // images H W: place in the tile's list, -1 for none; tiles: pairs composited
    const T *grad_image, *grad_transmittance, *grad_distortion, *grad_median;  // the rest is for the backward pass only
    const int64_t *slot_of;                            // pairs
    T *slots;                                          // pairs (SURFEL + count)

    int64_t stride() const { return ((edge < W ? edge : W) + 15) / 16 * 16; }  // a multiple of every vector width
    int64_t plane() const { return stride() * (edge < H ? edge : H); }         // numbers of a tile's plane
    int64_t scratch() const { return (count + 12) * plane(); }                 // numbers that a thread needs
};

constexpr int64_t BLOCK = 256;  // Gaussians per task

// The kernels of one instruction set and scalar type.
template <class T>
struct Kernels {
    void (*project)(const ProjectArgs<T> &, int64_t block);
    void (*count)(const IntersectArgs<T> &, int64_t begin, int64_t end, uint32_t *per_tile);
    void (*scatter)(const IntersectArgs<T> &, int64_t begin, int64_t end, uint32_t *next);
    void (*composite)(const CompositeArgs<T> &, int32_t tile);
    void (*composite_backward)(const CompositeBackwardArgs<T> &, int32_t tile);
    void (*project_backward)(const ProjectBackwardArgs<T> &, int64_t block);
    void (*adam)(const AdamArgs<T> &, int64_t begin, int64_t end);
    void (*adam_backward)(const AdamBackwardArgs<T> &, int64_t block, T *scratch);
    void (*loss)(const LossArgs<T> &, int64_t task, T *scratch);
    void (*noise)(const NoiseArgs<T> &, int64_t begin, int64_t end);
    void (*recolor)(const RecolorArgs<T> &, int64_t task);
    void (*recolor_backward)(const RecolorArgs<T> &, int64_t task);
    void (*surface_depths)(const SurfaceArgs<T> &, int64_t row);
    void (*surface_tangents)(const SurfaceArgs<T> &, int64_t row);
    void (*surface_gradient)(const SurfaceArgs<T> &, int64_t row);
    void (*normals)(const NormalArgs<T> &, int64_t block);
    void (*normals_backward)(const NormalArgs<T> &, int64_t block);
    void (*screen)(const ScreenArgs<T> &, int64_t block);
    void (*screen_backward)(const ScreenArgs<T> &, int64_t block);
    void (*radii)(const RadiusArgs<T> &, int64_t begin, int64_t end);
    void (*harmonic_colors)(const HarmonicArgs<T> &, int64_t block);
    void (*harmonic_colors_backward)(const HarmonicArgs<T> &, int64_t block);
    void (*surfels)(const SurfelArgs<T> &, int64_t tile, T *scratch);
    void (*surfels_backward)(const SurfelArgs<T> &, int64_t tile, T *scratch);
    int64_t rows_bytes;  // of a batch, in CompositeArgs::rows; 0 if none are kept
};

struct Isa {
    const char *name;
    Kernels<float> f32;
    Kernels<double> f64;
    int (*fma_benchmark)(int64_t rounds, float *sink);  // independent vector FMAs, returns FMAs per round
};

}  // namespace gsplat
