// What a page asks of the kernels: a model, a view, rows of pixels. One instance of the module draws one model: an octree
// (web_octree.cpp) or splats (web_splats.cpp), to the pictures of web.cpp.
#pragma once
#include <algorithm>
#include <cstdint>
#include <new>
#include <vector>

#include "tree.h"

// Only functions marked so leave the module.
#define NERFVOL_WEB(name) extern "C" __attribute__((export_name(#name)))

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

extern WebView view;
extern WebPicture picture;

// The numbers of a picture, null where it is not wanted.
inline float* data(std::vector<float>& v) { return v.empty() ? nullptr : v.data(); }

// n numbers, the first of them at the beginning of a cache line.
template <class T> T* lines(int64_t n) { return static_cast<T*>(::operator new[](size_t(n) * sizeof(T) + 64, std::align_val_t{64})); }

// Draws one row of 16 pixels' height of the model that was opened. Splats: `prepare_splats` has seen to its rows before.
void draw_octree(int row);
void draw_splats(int row);
void prepare_splats(int first, int last);
bool splats_are_open();

// The zlib stream `from` as exactly n bytes; false where it is damaged or holds more or fewer.
bool inflate(const uint8_t* from, int64_t n_from, uint8_t* to, int64_t n);

// Calls use(i, code) with the n numbers that a channel's two byte planes hold (nerfvol/octree/codec.py).
template <class Use> inline void unpack_codes(const uint8_t* low, const uint8_t* high, int64_t n, bool differences, const Use& use) {
    uint32_t sum = 0;
    for (int64_t i = 0; i < n; ++i) {
        const uint32_t zigzag = low[i] | uint32_t(high[i]) << 8, code = (zigzag >> 1) ^ (0u - (zigzag & 1));
        sum = differences ? sum + code : code;
        use(i, int32_t(sum));
    }
}

// Red, green, blue of the decorrelated channel `axis` (the codec's rotation).
constexpr float kFromGrey[3][3] = {{0.57735027f, 0.57735027f, 0.57735027f},
                                   {0.70710678f, 0.0f, -0.70710678f},
                                   {0.40824829f, -0.81649658f, 0.40824829f}};

}  // namespace nerfvol
