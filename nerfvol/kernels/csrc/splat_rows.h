// Moving Gaussians about: parameters in blocks of 16 gathered by index. The same for all instruction sets.
#pragma once
#include <cstdint>

namespace nerfvol {

// out (ceil(n / 16), rows, 16) gets, in lane j % 16 of block j / 16, the numbers of Gaussian index[j] of `in`; lanes beyond n, and
// those whose index is negative, get `padding` (rows).
void gather_splats(const float* in, int64_t rows, const int64_t* index, int64_t n, const float* padding, float* out);

// 63-bit Morton codes of means (n_blocks, rows, 16) of Gaussians 0..n-1: a box around most of them at an even scale, what lies
// outside contracted towards infinity. middle (3), size: the box's centre and half side, in the means' unit.
void morton_splats(const float* params, int64_t rows, int64_t n, const float* middle, float size, uint64_t* codes);

}  // namespace nerfvol
