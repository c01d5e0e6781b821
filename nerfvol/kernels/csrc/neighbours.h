// The nearest of many points, exactly, by a k-d tree.
#pragma once
#include <cstdint>

namespace nerfvol {

// squared (m, k), index (m, k): the k nearest of points (n, 3) to queries (m, 3), nearest first, equal distances by index.
// Without queries the points themselves are asked and leave themselves out. What is not there is infinity and -1.
void nearest(const double* points, int64_t n, const double* queries, int64_t m, int k, double* squared, int32_t* index);

}  // namespace nerfvol
