#include "splat_rows.h"

#include <algorithm>
#include <cmath>

#include "pool.h"

namespace nerfvol {
namespace {

constexpr int kLanes = 16, kBlocks = 64;     // blocks that one task fills

// Every third bit from the 21 bits of x.
uint64_t spread_bits(uint64_t x) {
    x = (x | x << 32) & 0x1f00000000ffffull;
    x = (x | x << 16) & 0x1f0000ff0000ffull;
    x = (x | x << 8) & 0x100f00f00f00f00full;
    x = (x | x << 4) & 0x10c30c30c30c30c3ull;
    return (x | x << 2) & 0x1249249249249249ull;
}

// (-inf, inf) to [0, 2^21): even inside [-1, 1], 1/x outside.
uint64_t contracted(float x) {
    const float size = std::abs(x);
    const float y = size <= 1 ? x : std::copysign(2 - 1 / size, x);
    const float scaled = (y + 2) * 0.25f * 2097152.0f;
    return scaled > 0 ? std::min(uint64_t(scaled), uint64_t(2097151)) : 0;
}

}  // namespace

void gather_splats(const float* in, int64_t rows, const int64_t* index, int64_t n, const float* padding, float* out) {
    const int64_t blocks = (n + kLanes - 1) / kLanes;
    parallel_for(int((blocks + kBlocks - 1) / kBlocks), [&](int task, int) {
        for (int64_t b = int64_t(task) * kBlocks; b < std::min<int64_t>((int64_t(task) + 1) * kBlocks, blocks); ++b) {
            const float* from[kLanes];
            int64_t stride[kLanes];
            for (int64_t lane = 0; lane < kLanes; ++lane) {
                const int64_t j = b * kLanes + lane, i = j < n ? index[j] : -1;
                from[lane] = i < 0 ? padding : in + i / kLanes * rows * kLanes + i % kLanes;
                stride[lane] = i < 0 ? 1 : kLanes;
            }
            float* to = out + b * rows * kLanes;
            for (int64_t row = 0; row < rows; ++row)
                for (int64_t lane = 0; lane < kLanes; ++lane) to[row * kLanes + lane] = from[lane][row * stride[lane]];
        }
    });
}

void morton_splats(const float* params, int64_t rows, int64_t n, const float* middle, float size, uint64_t* codes) {
    const int64_t blocks = (n + kLanes - 1) / kLanes;
    parallel_for(int((blocks + kBlocks - 1) / kBlocks), [&](int task, int) {
        const int64_t first = int64_t(task) * kBlocks * kLanes, last = std::min<int64_t>(first + kBlocks * kLanes, n);
        for (int64_t i = first; i < last; ++i) {
            const float* mean = params + i / kLanes * rows * kLanes + i % kLanes;
            uint64_t code = 0;
            for (int k = 0; k < 3; ++k) code |= spread_bits(contracted((mean[k * kLanes] - middle[k]) / size)) << k;
            codes[i] = code;
        }
    });
}

}  // namespace nerfvol
