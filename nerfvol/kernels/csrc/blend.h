// One tile of 16x16 pixels, front to back: alpha of each Gaussian in blocks of 4x4 pixels, one vector each, then compositing.
//
// w = T alpha, C += w c, T -= w; a pixel ends with the Gaussian at which T falls below early_stop_eps.
#pragma once
#include <cmath>

#include "splat_order.h"

namespace NERFVOL_ISA {

alignas(64) inline constexpr float kLaneX[16] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
alignas(64) inline constexpr float kLaneY[16] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

// The state of a tile's pixels, by blocks.
struct TilePixels {
    alignas(64) float trans[16][16], colour[3][16][16];
    void start(int block, const f16& t) {
        store(trans[block], t);
        for (auto& c : colour) store(c[block], splat16(0));
    }
    f16 channel(int block, int c, const float* background) const {
        return load<f16>(colour[c][block]) + load<f16>(trans[block]) * background[c];
    }
};

// A Gaussian as a tile sees it: distances of the first block's pixels from its mean.
struct Footprint {
    f16 dx, dy;
    const Record& g;
    Footprint(const Record& record, float left, float top)
        : dx(load<f16>(kLaneX) + (left + 0.5f - record.x)), dy(load<f16>(kLaneY) + (top + 0.5f - record.y)), g(record) {}

    f16 x(int block) const { return dx + 4.0f * float(block & 3); }
    f16 y(int block) const { return dy + 4.0f * float(block >> 2); }
    // 0 below 1/255 and where the pixel has ended.
    f16 alpha(int block, const f16& trans, float eps) const {
        const f16 px = x(block), py = y(block);
        const f16 near = px * g.a + py * g.b;
        const f16 power = (g.log2_opacity - px * near) - py * (py * g.c);
        const f16 alpha = vmin(vexp2(power), splat16(kAlphaMax)), zero = splat16(0);
        return select_less(trans, eps, zero, select_less(alpha, kAlphaMin, zero, alpha));
    }
};

// Composites one Gaussian on one block; returns the weights, leaves what passes.
inline f16 composite_alpha(TilePixels& p, int block, const f16& alpha, const f16& trans, const float* colour, f16& after) {
    const f16 w = trans * alpha;
    after = trans - w;
    store(p.trans[block], after);
    for (int c = 0; c < 3; ++c) store(p.colour[c][block], load<f16>(p.colour[c][block]) + w * colour[c]);
    return w;
}

// Walks a tile's list: visit(entry number, record, blocks of the Gaussian that are still alive).
template <class Visit> void walk_tile(const Frame& f, int64_t tile, const uint32_t& alive, Visit&& visit) {
    constexpr uint64_t kAhead = 4;
    const uint64_t last = f.first_entry[size_t(tile) + 1];
    for (uint64_t e = f.first_entry[size_t(tile)]; e < last && alive; ++e) {
        const TileEntry entry = f.entries[e];
        if (e + kAhead < last) __builtin_prefetch(&f.sorted[f.entries[e + kAhead].rank()]);
        if (const uint32_t blocks = entry.mask() & alive) visit(e, f.sorted[entry.rank()], blocks);
    }
}

}  // namespace NERFVOL_ISA
