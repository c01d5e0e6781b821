// The kernels in a page: pictures of a view, row by row, behind C functions for WebAssembly. Made by tools/web_kernels.py; memory is
// what the page asks of `reserve`.
#include "web.h"

#include <cmath>

using namespace nerfvol;

WebView nerfvol::view;
WebPicture nerfvol::picture;

namespace {
std::vector<uint8_t> pixels;
}

NERFVOL_WEB(reserve) void* web_reserve(uint32_t bytes) { return ::operator new[](bytes, std::align_val_t{64}); }
NERFVOL_WEB(release) void web_release(void* p) { ::operator delete[](p, std::align_val_t{64}); }

NERFVOL_WEB(inflate) int web_inflate(const uint8_t* from, int32_t n_from, uint8_t* to, int32_t n) { return nerfvol::inflate(from, n_from, to, n); }

NERFVOL_WEB(view) WebView* web_view() { return &view; }

// Begins the view that was written to `view`.
NERFVOL_WEB(begin) void web_begin() {
    const size_t n = size_t(view.width) * size_t(view.height);
    const int wanted = int(view.wanted);
    picture.rgb.resize(3 * n);
    picture.trans.resize(n);
    picture.depth.resize(wanted & kWantDepth ? n : 0);
    picture.median.resize(wanted & kWantMedian ? n : 0);
    picture.normal.resize(wanted & kWantNormal ? 3 * n : 0);
    pixels.resize(4 * n);
}

// Rows [first, last) of 16 pixels will be drawn.
NERFVOL_WEB(prepare) void web_prepare(int first, int last) {
    if (splats_are_open()) prepare_splats(first, last);
}

NERFVOL_WEB(draw) void web_draw(int row) {
    if (splats_are_open()) draw_splats(row);
    else draw_octree(row);
}

// The float picture of one output: 0 colour, 1 transmittance, 2 depth, 3 median depth, 4 normal.
NERFVOL_WEB(floats) float* web_floats(int output) {
    std::vector<float>* const all[5] = {&picture.rgb, &picture.trans, &picture.depth, &picture.median, &picture.normal};
    return all[output]->data();
}

// RGBA bytes of the whole picture, of which `count` pixels from `first` on are made; output: 0 colour, 1 opacity, 2 depth as light
// between near and far (files/pictures.py, depth_to_grey), 3 normals.
NERFVOL_WEB(shade) uint8_t* web_shade(int output, int first, int count, float near, float far) {
    const auto byte = [](float x) { return uint8_t(std::clamp(x, 0.0f, 1.0f) * 255 + 0.5f); };
    const float span = std::max(far - near, 1e-12f);
    for (int i = first; i < first + count; ++i) {
        const float opacity = 1 - picture.trans[size_t(i)];
        const bool hit = opacity >= 0.5f;
        float c[3] = {opacity, opacity, opacity};
        if (output == 0) {
            std::copy_n(picture.rgb.data() + 3 * i, 3, c);
        } else if (output == 2) {
            const float depth = picture.depth[size_t(i)] / std::max(opacity, 1e-3f);
            c[0] = c[1] = c[2] = hit ? 1 - 0.9f * std::clamp((depth - near) / span, 0.0f, 1.0f) : 0.0f;
        } else if (output == 3) {
            const float* n = picture.normal.data() + 3 * i;
            const float length = std::max(std::hypot(n[0], n[1], n[2]), 1e-6f);
            for (int k = 0; k < 3; ++k) c[k] = hit ? 0.5f * n[k] / length + 0.5f : 0.5f;
        }
        uint8_t* to = pixels.data() + 4 * i;
        for (int k = 0; k < 3; ++k) to[k] = byte(c[k]);
        to[3] = 255;
    }
    return pixels.data();
}
