#pragma once
#include <cstdint>
#include <vector>

#include "tree.h"

namespace nerfvol {

// The tiles of each training picture.
struct TileSources {
    std::vector<const float*> directions;  // of each picture: (tiles, 64, 3) in camera axes
    std::vector<const uint8_t*> pixels;    // of each picture: (rows, 64, 3)
    const float* rotations;                // (pictures, 3, 3) camera to world
};

// Directions (n, 64, 3) in world axes and colours (n, 64, 3) in [0, 1] of tile[i] of picture image[i], whose colours are
// row[i] of the picture's pixels.
void gather_tiles(const TileSources& from, const int64_t* image, const int64_t* tile, const int64_t* row, int64_t n,
                  float* directions, float* target);

}  // namespace nerfvol
