// What a page asks of the kernels: a model, a view, rows of pixels. One instance of the module draws one model (web.cpp).
#pragma once
#include <cstdint>
#include <vector>

#include "tree.h"

namespace nerfvol {

// How a view reaches the module: numbers in this order. Camera to world in OpenGL axes; scene units; pixels.
struct WebView {
    double rotation[9], position[3], fx, fy, cx, cy, width, height;
    double background[3], early_stop_eps, coarse;
    double wanted;                         // a sum of Wanted
};
enum Wanted { kWantDepth = 1, kWantMedian = 2, kWantNormal = 4 };

// Float pictures of the view, (height, width[, 3]); those not wanted are empty.
struct WebPicture {
    std::vector<float> rgb, trans, depth, median, normal;
};

// The zlib stream `from` as exactly n bytes; false where it is damaged or holds more or fewer.
bool inflate(const uint8_t* from, int64_t n_from, uint8_t* to, int64_t n);

// Numbers that a channel's two byte planes hold (nerfvol/octree/codec.py).
void unpack_codes(const uint8_t* low, const uint8_t* high, int64_t n, bool differences, int32_t* codes);

// Red, green, blue of the decorrelated channel `axis` (the codec's rotation).
extern const float kFromGrey[3][3];

}  // namespace nerfvol
