// Making an octree around Gaussian splats (nerfvol/starts/leaves.py, nerfvol/starts/surfaces.py): the cells that Gaussians fill,
// what they weigh there, and what pictures of them say of the octree's vertices.
#pragma once
#include <cstdint>
#include <vector>

namespace nerfvol {

// n Gaussians in scene units: means, axes (n, 3, 3) in columns, and for each the side of its cells.
struct GaussianAxes {
    const double *means, *axes, *side;
    int64_t n;
};

// Pairs of a Gaussian and a cell of its level that holds a sample of its ellipsoid, by Gaussian and by Morton code: samples
// lie 1 / steps (n, 3) of the half axes `half` (n, 3) apart. The cells' grid begins at `origin`; cells beyond its
// 2^level (n) cells are left out.
void fill_cells(const GaussianAxes& gaussians, const double* half, const int64_t* steps, const int64_t* level, const double* origin,
                std::vector<int64_t>& gaussian, std::vector<int64_t>& code);

// The different ones of n codes, rising.
std::vector<int64_t> distinct_codes(const int64_t* codes, int64_t n);

// Child masks of an octree and where the children of each node begin.
struct Masks {
    const uint8_t *node, *leaf;
    const int32_t *first_node, *first_leaf;
    int64_t n_nodes;
};

// leaf (m): the leaf at the middle of each of m cells (level and Morton code), -1: none; weight (m): thickness (n) of the
// Gaussian numbered `gaussian` (m) as a density there, its squared scales (n, 3) widened by `blur` sides of the cell.
void weigh_cells(const Masks& octree, const GaussianAxes& gaussians, const double* squares, const double* thickness, double blur,
                 const double* origin, double size, const int64_t* gaussian, const int64_t* level, const int64_t* code, int64_t m,
                 int64_t* leaf, double* weight);

// A picture of a model through a pinhole: world to camera axes row by row (x right, y down, z forward), rgb (height, width, 3)
// without any background, and median distance (height, width): 0 where there is none, infinite where there is nothing.
struct Look {
    const float *rgb, *distance;
    int64_t height, width;
    double rotation[9], position[3], fx, fy, cx, cy;
};

// When a vertex lies on a surface, in the free or neither; see nerfvol/starts/surfaces.py.
struct Verdict {
    double reach, before, keep;
};

// For each of n vertices, positions (n, 3) and sides (n): free and on (n), how many looks say so; sh (n, 3, coefficients), 1 or 4
// of them: corrected by least squares to what the looks that see it on a surface show, the higher ones held back by `keep`.
void look_at_vertices(const std::vector<Look>& looks, const Verdict& verdict, const double* positions, const double* side, int64_t n,
                      int coefficients, int16_t* free, int16_t* on, float* sh);

}  // namespace nerfvol
