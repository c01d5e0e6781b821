// Views of the arrays that Python owns, and the parameters of each operator. Plain data, shared by all instruction sets.
#pragma once
#include <cstdint>

#include "field.h"
#include "row.h"
#include "splats.h"

namespace nerfvol {

constexpr int kTile = 64;         // rays in a packet: an 8x8 tile of one image
constexpr int kSquare = 16;       // pixels along a square of a view
constexpr int kMaxLevel = 16;
constexpr int kBuckets = 128;     // ranges of vertices; each is updated by one thread in a fixed order

// The octree in the unit cube: see nerfvol/octree/tree.py for the meaning of each array.
struct Tree {
    const uint8_t *node_mask, *leaf_mask;        // (n_nodes)
    const int32_t *first_node, *first_leaf;      // (n_nodes) exclusive prefix sums of the masks' population counts
    const int32_t* corners;                      // (n_leaves, 8) vertex of each corner
    const RowNumber* values;                     // (n_vertices, 16 * blocks) packed SH and raw density
    int64_t n_nodes, n_leaves, n_vertices;
    int blocks;                                  // 16-float blocks in a vertex row: 1 (degree 0-1), 2 (degree 2), 4 (degree 3)
    int sh_degree;
    float origin[3], size;                       // root cube, scene units
    float density_scale;                         // 1 / scene unit
    const int32_t* node_corners;                 // (n_nodes, 8) rows of node_values; null where no node is prefiltered
    const RowNumber* node_values;                // prefiltered values of everything below a node (nerfvol/octree/lod.py)
    float coarse;                                // a node does where its side is below this many times its distance; 0: none
};

struct Rays {
    const float *origins, *directions;           // (n, 3) scene units; unit length
    int64_t n;
    bool origin_per_tile;                        // origins has one row per 64 rays
};

// A camera's rays: directions in camera axes, by squares of 16x16 pixels, rows of squares from the top; squares may reach
// beyond the edges. packet.h says how a square's pixels are stored in its four strips.
struct View {
    const float* directions;                     // (square rows, square columns, 4, 3, 64) unit length
    int64_t square_rows, square_columns, height, width;
    float rotation[9], origin[3];                // camera to world, row by row; scene units
    float small = 0;                             // a cell is shaded along one ray where its side is below this many times its distance
};

struct RenderOptions {
    float background[3] = {};
    float early_stop_eps = 0;                    // a ray ends when its transmittance falls below; 0 = exact
};

// Outputs, each (n) or (n, 3), or (height, width[, 3]) for a view; null = not wanted.
struct RenderOutput {
    float *rgb, *trans, *depth, *median_depth, *normal;
};

// What the adjoint starts from: cotangents of the outputs, or a loss on target colours.
struct Cotangents {
    const float *rgb, *trans, *depth;            // (n,3), (n), (n)
};

// The loss's terms, field by field those of nerfvol.kernels.state.LossOptions; reference.loss has the formula.
struct LossOptions : RenderOptions {
    float colour = 0;                            // weight of sum_i w_i |c_i - target|^2 + T |background - target|^2
    float distortion = 0;                        // weight of the distortion loss of Mip-NeRF 360 (distances in root cubes)
    float sparsity = 0;                          // weight of sum_i log(1 + w_i / e): few segments, each with much of the light
    float tv_density = 0, tv_sh = 0;             // weights of differences between the corners of leaves (see add_variation)
};
struct Loss {
    const float* target;                         // (n, 3)
    const float* weight;                         // (n) weight of each ray; 0 = padding
    LossOptions options;
};

// RMSprop, applied only to vertices that this batch touched; field by field nerfvol.kernels.state.Rates.
struct Rates {
    float density = 0, dc = 0, sh = 0;
    float beta = 0, eps = 0;
};
struct Optimizer {
    float* values;                               // (n_vertices, 16 * blocks)
    float* moments;                              // second moments, same shape; 0 = never touched
    Rates rates;
};

struct LeafStatistics {                          // (n_leaves), updated in place; null = not wanted
    float *max_weight, *error, *footprint;
    float pixel_angle;                           // between neighbouring rays, radians: the unit of footprint
};

struct StepReport {
    double squared_error, weight, samples;       // summed over rays: weighted squared error, weights, hits
    double tested;                               // leaves, summed over packets, whose boxes were tested against the rays
};

struct GradientSink {
    float* gradient;                             // (n_vertices, 16 * blocks): dense sum, or null when the optimiser runs
    const Optimizer* optimizer;
    int32_t* slots;                              // (n_vertices) scratch, all -1 between calls
};

struct Kernels {
    void (*render)(const Tree&, const Rays&, const RenderOptions&, const RenderOutput&);
    void (*render_view)(const Tree&, const View&, const RenderOptions&, const RenderOutput&);
    void (*backward)(const Tree&, const Rays&, const RenderOptions&, const Cotangents&, const GradientSink&);
    StepReport (*train_step)(const Tree&, const Rays&, const Loss&, const GradientSink&, const LeafStatistics&);
    StepReport (*leaf_statistics)(const Tree&, const Rays&, const Loss&, const LeafStatistics&);  // a step that moves nothing
};

const Kernels& kernels();                        // the chosen instruction set
const SplatKernels& splat_kernels();
const FieldKernels& field_kernels();
const char* isa_name();
double clock_ghz();
bool set_isa(const char* name);                  // "auto" or a name from available_isas(); false if this CPU lacks it
int available_isas(const char** names);          // fills up to 3 names, best first

}  // namespace nerfvol
