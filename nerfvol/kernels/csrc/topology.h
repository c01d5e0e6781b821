// Bookkeeping of the octree's vertices. n leaves in the octree's order; positions at the finest level.
#pragma once
#include <cstdint>

#include "row.h"

namespace nerfvol {

// Bits of v < 2^20 to every third place, and back.
inline uint64_t spread_bits(uint64_t v) {
    v = (v | v << 32) & 0x1F00000000FFFFull;
    v = (v | v << 16) & 0x1F0000FF0000FFull;
    v = (v | v << 8) & 0x100F00F00F00F00Full;
    v = (v | v << 4) & 0x10C30C30C30C30C3ull;
    return (v | v << 2) & 0x1249249249249249ull;
}
inline uint64_t gather_bits(uint64_t v) {
    v &= 0x1249249249249249ull;
    v = (v | v >> 2) & 0x10C30C30C30C30C3ull;
    v = (v | v >> 4) & 0x100F00F00F00F00Full;
    v = (v | v >> 8) & 0x1F0000FF0000FFull;
    v = (v | v >> 16) & 0x1F00000000FFFFull;
    return (v | v >> 32) & 0x1FFFFFull;
}

// Place of a corner of a new leaf in the 3x3x3 lattice of the old leaf; octant < 0: the leaf is the old one itself.
int lattice_place(int octant, int corner);

// Trilinear weights of the lattice's points at the leaf's corners.
void lattice_weights(float weights[27][8]);

// Numbers corners in the order in which leaves name them, so that neighbours in space are neighbours in memory.
// ids (n, 8); the result is the number of vertices.
int64_t number_corners(const int8_t* level, const int32_t* ijk, int64_t n, int max_level, int32_t* ids);

// The same for the leaves `kept` (n, rising) of an octree whose corners and vertices are numbered already.
int64_t renumber_corners(const int32_t* corners, const int32_t* kept, int64_t n, int64_t n_vertices, int32_t* ids);

// For each new vertex an old leaf (source) and its place in that leaf's 3x3x3 lattice; a corner of an old leaf beats a
// point inside one. octant: which child of `parent` a new leaf is, -1 for the old leaf itself.
void find_sources(const int32_t* corners, const int32_t* parent, const int8_t* octant, int64_t n, int64_t n_vertices,
                  int32_t* source, int8_t* place);

// Rows of the new vertices, trilinear between the old leaf's corners.
void interpolate(const float* rows, int64_t width, const int32_t* old_corners, const int32_t* source, const int8_t* place,
                 int64_t n_vertices, float* out);

// The transpose of interpolation, for prefiltered nodes: adds to sums (n, 8, width) the rows at the corners of those
// children of n nodes that `mask` names, weighted by `weight` (of each vertex) and the trilinear weight of the place in the
// node over 8. `first` (n): the number of each node's first such child, corners (children, 8). The slot `density` of a row
// counts as 1. Absent children add nothing.
template <class Number>  // float, RowNumber
void restrict_cells(const uint8_t* mask, const int32_t* first, int64_t n, const int32_t* corners, const Number* rows, int64_t width,
                    const float* weight, int64_t density, float* sums);

}  // namespace nerfvol
