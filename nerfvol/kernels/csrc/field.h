// Views of the arrays that Python owns for neural fields, and the parameters of their operators. Plain data, shared by all
// instruction sets. Equations: nerfvol/kernels/field_reference.py.
//
// Parameters are two arrays: the entries of the hash grid's levels, level after level, and the network's numbers, layer after
// layer: the weights (out, in), then the biases. A layer may see more than what the one before made: the encoded position
// again (skip), or the encoded direction (the first layer of a network for colours, which leaves out the raw density).
#pragma once
#include <cstdint>

namespace nerfvol {

constexpr int kFieldLanes = 16;      // samples in a packet
constexpr int kFieldBlock = 64;      // samples that go through the network together
constexpr int kFieldLevels = 16;
constexpr int kFieldLayers = 11;     // trunk of up to 8, head, two of colour
constexpr int kFieldGroups = 16;     // ranges of rays, each with a gradient of its own: sums have one order
constexpr int kFieldBrick = 16;      // entries of a brick of 2 x 2 x 4 vertices
constexpr int kFieldChunk = 128;     // rays that march together
constexpr int kFieldWave = 4;        // samples of a ray between two looks at its transmittance, ...
constexpr int kFieldFew = 128;       // ... so many of all rays together where that is more, but ...
constexpr int kFieldLongest = 16;    // ... not more than this of one

enum FieldExtra { kNothing = 0, kPosition = 1, kDirection = 2 };

struct FieldLayer {
    int in, out;                     // `in` counts the extra rows
    bool relu;
    int extra;                       // FieldExtra: what its input ends with
    int64_t weights, biases;         // where they begin in the network's array
    int kept() const;
};

struct FieldShape {
    bool hashed = true, sh_head = true, softplus = false;
    int levels = 0, features = 0, dense = 0;     // dense: levels that store every vertex
    int active = 0;                              // coarse levels in use: the others' features are zero, and nothing moves them
    int resolution[kFieldLevels];
    int64_t start[kFieldLevels + 1];             // first entry of each level
    uint32_t bricks = 0;                         // of a hashed level, a power of two
    int frequencies = 0, frequencies_dir = 0, sh_degree = 0;
    int encoded = 0, encoded_dir = 0;            // rows of the encodings
    int n_layers = 0, head = 0;                  // head: index of the layer whose first output is the raw density
    FieldLayer layers[kFieldLayers];
    int64_t n_network = 0;                       // numbers of the network
    float density_bias = 0, density_scale = 0;   // sigma = activation(raw + bias) * scale, 1 / scene unit
    float center[3], half = 1, outer = 1;        // the inner cube and the whole region, see nerfvol/field/domain.py
    int coefficients() const { return (sh_degree + 1) * (sh_degree + 1); }
};

struct FieldParameters { const float *table, *network; };

// Where rays look: edges of steps behind the ray's entry, and bits of occupied cells, cube after cube, each (r, r, r).
struct FieldMarch {
    const float* edges;                          // (n_steps + 1)
    int n_steps, group;                          // group: steps tested at once against the coarse cells; divides 16
    float step, near_plane;
    const uint64_t *occupied, *coarse;
    int resolution, cubes;
};

struct FieldRays {                               // directions unit, scene units; jitter in [0, 1), target null: only drawn
    const float *origins, *directions, *jitter, *target;
    int64_t n;
};

struct FieldLoss {
    float background[3] = {1, 1, 1};
    float colour = 0, distortion = 0, entropy = 0;
    float early_stop_eps = 1e-3f;
    float negligible = 0;                        // times the mean gradient of the samples of a chunk: below it a roulette decides
};

struct FieldRates {                              // Adam; decays are added to the gradient of what has one
    float rate = 0.01f, beta1 = 0.9f, beta2 = 0.99f, eps = 1e-15f;
    float table_decay = 0, network_decay = 0;
};

struct FieldMemory {                             // updated in place
    float *table, *table_first, *table_second, *table_gradient;
    float *network, *network_first, *network_second, *network_gradient;
    int64_t* updates;                            // (levels + 1) Adam's own count of each level and of the network
    const uint8_t* moves;                        // (levels) whether the level is updated in this step; null: gradients alone
};

struct FieldOutput { float *rgb, *opacity, *depth; };   // (n, 3), (n), (n); null = not wanted

struct FieldReport { double squared_error = 0, loss = 0; int64_t samples = 0, used = 0; };

struct FieldPoints {
    const float *positions, *directions;         // (n, 3) scene units; directions null but for a network of colours
    int64_t n;
    const FieldMarch* where;                     // null, or points outside occupied cells are empty
    float *sigma, *values;                       // (n), and (n, 3 K) coefficients or (n, 3) colours; null: not wanted
};

struct FieldKernels {
    FieldReport (*step)(const FieldShape&, const FieldRays&, const FieldMarch&, const FieldLoss&, const FieldRates&, const FieldMemory&);
    void (*render)(const FieldShape&, const FieldParameters&, const FieldRays&, const FieldMarch&, const FieldLoss&, const FieldOutput&);
    void (*evaluate)(const FieldShape&, const FieldParameters&, const FieldPoints&);
    void (*march)(const FieldShape&, const FieldRays&, const FieldMarch&, uint64_t* bits);
};

// Random pixels of pictures, and the rays through them (field_batch.cpp).
struct FieldPixels {
    const uint8_t* const* colours;               // (views) pictures (h, w, 3)
    const int64_t* starts;                       // (views + 1)
    const float *rotations, *origins;            // (views, 3, 3), (views, 3)
    const float* const* directions;              // (views) tables of the pixels' directions in camera axes
    int64_t views;
};
void draw_pixels(const FieldPixels& from, uint64_t key, int64_t n, float* origins, float* directions, float* target, float* jitter);
// Bits of cells whose optical thickness is above the threshold, and of coarse cells (4^3) that touch one.
void refresh_occupancy(const float* sigmas, int cubes, int resolution, const float* thresholds, uint64_t* occupied, uint64_t* coarse);

}  // namespace nerfvol
