// One tile of 16x16 pixels, front to back: alpha of each Gaussian in blocks of 4x4 pixels, one vector each, then compositing.
//
// w = T alpha, C += w c, T -= w; a pixel ends with the Gaussian at which T falls below early_stop_eps.
#pragma once
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

// A block's pixels come in parts of one register each, some rows of four pixels: what a block's rows share is worked out once,
// and nothing waits in memory for lack of registers.
constexpr int kParts = 16 / kWide, kPartRows = kWide / 4;

// A Gaussian as a tile sees it: distances of the first block's pixels from its mean.
struct Footprint {
    fwide dx, dy[kParts];
    const Record& g;
    Footprint(const Record& record, float left, float top) : dx(load<fwide>(kLaneX) + (left + 0.5f - record.x)), g(record) {
        const fwide rows = load<fwide>(kLaneY) + (top + 0.5f - record.y);
        for (int part = 0; part < kParts; ++part) dy[part] = rows + float(kPartRows * part);
    }

    fwide x(int block) const { return dx + kBlockX[block]; }
    fwide y(int block, int part) const { return dy[part] + kBlockY[block]; }

    // The power of two is level - y (c y + slope).
    struct Across { fwide level, slope; };
    Across across(const fwide& x) const { return {g.log2_opacity - x * (x * g.a), x * g.b}; }
    // 0 below 1/255, where the pixel has ended, and where distances are too large for numbers.
    fwide alpha(const Across& at, const fwide& y, const fwide& trans, float eps) const {
        const fwide power = at.level - y * (y * g.c + at.slope), zero = splat<fwide>(0);
        const fwide alpha = vmin(vexp2_normal(power), splat<fwide>(kAlphaMax));
        return select_less(trans, eps, zero, select_less(splat<fwide>(-kLog2Of255), power, alpha, zero));
    }
};

// Composites one Gaussian on a part of a block; returns the weights, leaves what passes.
inline fwide composite_alpha(TilePixels& p, int block, int part, const fwide& alpha, const fwide& trans, const float* colour, fwide& after) {
    const int at = kWide * part;
    const fwide w = trans * alpha;
    after = trans - w;
    store(p.trans[block] + at, after);
    for (int c = 0; c < 3; ++c) store(p.colour[c][block] + at, load<fwide>(p.colour[c][block] + at) + w * colour[c]);
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
