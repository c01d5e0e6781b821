// Structural similarity of two pictures (nerfvol/measure/metrics.py says which and why).
#pragma once
#include <cstdint>

namespace nerfvol {

// out (height - taps + 1, width - taps + 1, channels): the similarity at every place of the window inside a and b (height,
// width, channels), all interleaved. weights (taps): the window along one axis, which sums to 1. c1, c2: the constants.
void similarity(const float* a, const float* b, int64_t height, int64_t width, int64_t channels, const float* weights, int taps,
                float c1, float c2, float* out);

}  // namespace nerfvol
