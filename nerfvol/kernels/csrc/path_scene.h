// Path tracing of one medium in a box (data_synth/path.py is the textbook version and says what is estimated, and why).
//
// A scene as plain numbers, those of data_synth.media.Medium, lights and path.Settings; the ground truth shares nothing with
// the operators that it judges but the threads and the vectors.
#pragma once
#include <cstdint>

namespace nerfvol {

enum { kHomogeneous, kGrid, kExponential };                   // PathMedium::kind
enum { kIsotropic, kRayleigh, kHenyeyGreenstein };            // PathMedium::phase
enum { kPointLight, kDirectionalLight, kSkyLight = 3 };       // first column of a light's row
constexpr int kLightColumns = 16;

struct PathTable { const double* rows; int n; };              // (n, 3) over the attribute in [0, 1], linear in between

struct PathMedium {
    int kind, phase;
    double lo[3], hi[3];                                      // u
    int64_t bricks[3];                                        // of a grid: 8^3 cells and their 9^3 samples each
    double brick_size[3];                                     // u
    const int64_t* offsets;                                   // (bricks) first sample, -1 = empty; grids alone
    const float *samples, *attributes;                        // attributes: null for none
    const double* brick_max;                                  // (bricks)
    double sigma_t[3];                                        // 1/u at density 1
    PathTable albedo, Le;
    double falloff;                                           // density exp(-falloff (z - lo)), 1/u
    double g1, g2, mix;
};

struct PathCamera { double c2w[12], fx, fy, cx, cy; };        // OpenGL axes; pixels
constexpr int64_t kBlock = 16;                                // paths whose sums are joined by a tree (data_synth/parts.py)
struct PathSettings {
    int64_t spp, max_depth;
    bool jitter, opaque_sky;
    uint64_t seed;
    int64_t first, last;                                      // blocks first..last - 1 of a pixel's paths
};

struct PathScene {
    PathMedium medium;
    const double* lights;                                     // (n_lights, kLightColumns)
    int n_lights;
    PathCamera camera;
    PathSettings settings;
};

struct PathKernels {
    // Rows first..last - 1 of a picture of this width into out (last - first, width, 8): sums over the blocks' paths of rgb,
    // alpha, distance and the squares of rgb. Every path has random numbers of its own, so that results do not depend on the number of threads.
    void (*trace)(const PathScene&, int width, int first, int last, double* out);
};
const PathKernels& path_kernels();               // the chosen instruction set

}  // namespace nerfvol
