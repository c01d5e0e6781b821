// What making an octree of a field or of splats does over and over (nerfvol/starts/cells.py, nerfvol/starts/leaves.py,
// nerfvol/octree/merge.py).
#pragma once
#include <cstdint>

namespace nerfvol {

// kept (n): 1 for each of n distinct cells (n, 3) of a grid that holds something or touches one of them that does, corners
// included. Positions lie in [0, 2**20).
void dilate_cells(const int32_t* cells, const uint8_t* holds, int64_t n, uint8_t* kept);

// Rows of values at vertices: density at slot `density`, `coefficients` colour coefficients at `slots`, which count `bounds`
// (the largest value of their basis functions).
struct VertexRows {
    const float* values;
    int64_t width;
    int density;
    const int32_t* slots;
    const float* bounds;
    int coefficients;
};

// error (m): largest change, over the 27 points of the lattice of eight sibling leaves, in the opacity of a sibling and in a
// colour times that opacity, were each family its parent. corners (n, 8); first (m): a family's leaves are first..first + 7 in
// octant order; scale (m): density scale times a sibling's side.
void merge_errors(const VertexRows& rows, const int32_t* corners, const int64_t* first, const float* scale, int64_t m,
                  float* error);

// Adds weight[i] times row from[i] of rows (any, width) to row to[i] of sums (n, width), for i = 0 .. m - 1 in this order; none
// where to[i] is negative.
void add_rows(const double* rows, int64_t width, const int64_t* from, const double* weight, const int64_t* to, int64_t m,
              double* sums, int64_t n);

// Adds weight[i] times row i of rows (m, width) to the rows of sums (n, width) that corners (m, 8) names, leaf by leaf.
void add_to_corners(const double* rows, int64_t width, const double* weight, const int32_t* corners, int64_t m, double* sums,
                    int64_t n);

}  // namespace nerfvol
