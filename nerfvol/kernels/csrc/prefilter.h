// Prefiltered values of an octree's interior nodes: what nerfvol/octree/lod.py says, in one pass and with little memory.
#pragma once
#include <cstdint>
#include <vector>

#include "tree.h"

namespace nerfvol {

struct Prefiltered {
    std::vector<int32_t> corners;          // (n_nodes, 8) rows of values
    std::vector<RowNumber> values;         // (rows, 16 * blocks)
};

// Of an octree whose masks, first children, corners and values are there.
Prefiltered prefilter(const Tree& tree);

}  // namespace nerfvol
