// One tile of a training step: forward, loss and adjoint while it is in the core's own cache.
//
// The adjoint goes back to front over the kept weights and alphas: with S the colour behind, per unit of what reaches it, times
// g = dL/dC, and q = c . g:  d alpha = T (q - S), h = alpha d alpha = w (q - S), S += alpha (q - S). No transmittance is divided by.
// Ten sums of each Gaussian, from which the chain rule follows once per Gaussian, become one cache line per tile.
#pragma once
#include "blend.h"
#include "splat_loss.h"

namespace NERFVOL_ISA {

// Sums over a tile's pixels, d from the mean to the pixel: h, h dx, h dy, h dx^2, h dx dy, h dy^2, w g (3), w error; largest w.
enum LineSum { kH, kHx, kHy, kHxx, kHxy, kHyy, kWg, kWe = 9, kSums, kMaxWeight = 12 };
struct alignas(64) Line { float sums[16]; };

struct KeptBlock { f16 weight, alpha; };
struct KeptEntry { uint64_t entry; uint32_t blocks; bool line; };

// A thread's memory for one tile.
struct TileWork {
    TilePixels pixels;
    alignas(64) float g[3][16][16], behind[16][16], error[16][16];
    Buffer<KeptBlock> blocks;
    Buffer<KeptEntry> entries;
    size_t n_blocks, n_entries;
    LossSums sums;
};

struct StepLines {
    Buffer<Line> lines;                      // by slot; only where `left` says so
    Buffer<uint8_t> left;
};

inline void forward_tile(const Frame& f, int64_t tile, float left, float top, uint32_t alive, const SplatLoss& loss, TileWork& work) {
    work.n_blocks = work.n_entries = 0;
    TilePixels& p = work.pixels;
    const float eps = loss.early_stop_eps;
    walk_tile(f, tile, alive, [&](uint64_t e, const Record& g, uint32_t blocks) {
        const Footprint foot(g, left, top);
        f16 largest = splat16(0);
        KeptBlock* kept = work.blocks.need_keeping(work.n_blocks + 16, work.n_blocks) + work.n_blocks;
        for (uint32_t todo = blocks; todo; todo &= todo - 1, ++kept) {
            const int block = __builtin_ctz(todo);
            const f16 trans = load<f16>(p.trans[block]), alpha = foot.alpha(block, trans, eps);
            f16 after;
            const f16 w = composite_alpha(p, block, alpha, trans, g.colour, after);
            store(&kept->weight, w);
            store(&kept->alpha, alpha);
            largest = vmax(largest, w);
            if (!greater_bits(after, splat16(eps))) alive &= ~(1u << block);
        }
        work.n_blocks += size_t(__builtin_popcount(blocks));
        const bool line = greater_bits(largest, splat16(loss.weight_threshold)) != 0;
        work.entries.need_keeping(work.n_entries + 1, work.n_entries)[work.n_entries] = {e, blocks, line};
        ++work.n_entries;
    });
}

// Loss and what the adjoint starts from, of the blocks that have a pixel with weight.
inline void loss_of_tile(const SplatImage& image, int64_t left, int64_t top, uint32_t valid, const SplatLoss& loss, TileWork& work) {
    for (; valid; valid &= valid - 1) {
        const int block = __builtin_ctz(valid);
        const Target target(image, left + 4 * (block & 3), top + 4 * (block >> 2));
        f16 colour[3], g[3], error;
        for (int c = 0; c < 3; ++c) colour[c] = work.pixels.channel(block, c, loss.background);
        block_loss(loss, target, colour, work.sums, g, error);
        for (int c = 0; c < 3; ++c) store(work.g[c][block], g[c]);
        store(work.error[block], error);
        store(work.behind[block], g[0] * loss.background[0] + g[1] * loss.background[1] + g[2] * loss.background[2]);
    }
}

inline f16 cotangent(const TileWork& work, int block, const Record& g) {
    return load<f16>(work.g[0][block]) * g.colour[0] + load<f16>(work.g[1][block]) * g.colour[1] + load<f16>(work.g[2][block]) * g.colour[2];
}

inline void pass_behind(const Record& g, uint32_t blocks, const KeptBlock* kept, TileWork& work) {
    for (; blocks; blocks &= blocks - 1, ++kept) {
        const int block = __builtin_ctz(blocks);
        const f16 s = load<f16>(work.behind[block]);
        store(work.behind[block], s + load<f16>(&kept->alpha) * (cotangent(work, block, g) - s));
    }
}

inline void leave_line(const Record& g, uint32_t blocks, const KeptBlock* kept, float left, float top, TileWork& work, Line& out) {
    const Footprint foot(g, left, top);
    f16 s[kSums];
    for (f16& v : s) v = splat16(0);
    f16 largest = splat16(0);
    for (; blocks; blocks &= blocks - 1, ++kept) {
        const int block = __builtin_ctz(blocks);
        const f16 behind = load<f16>(work.behind[block]), alpha = load<f16>(&kept->alpha), w = load<f16>(&kept->weight);
        const f16 d = cotangent(work, block, g) - behind;
        store(work.behind[block], behind + alpha * d);
        const f16 h = select_less(alpha, kAlphaMax, w * d, splat16(0));  // a clamped alpha has no gradient
        const f16 x = foot.x(block), y = foot.y(block), hx = h * x, hy = h * y;
        s[kH] += h;
        s[kHx] += hx;
        s[kHy] += hy;
        s[kHxx] += hx * x;
        s[kHxy] += hx * y;
        s[kHyy] += hy * y;
        for (int c = 0; c < 3; ++c) s[kWg + c] += w * load<f16>(work.g[c][block]);
        s[kWe] += w * load<f16>(work.error[block]);
        largest = vmax(largest, w);
    }
    store(out.sums, four_sums(s[0], s[1], s[2], s[3]));
    store(out.sums + 4, four_sums(s[4], s[5], s[6], s[7]));
    store(out.sums + 8, four_sums(s[8], s[9], s[9], s[9]));
    out.sums[kMaxWeight] = -least(-largest);
}

inline void backward_tile(const Frame& f, StepLines& lines, float left, float top, TileWork& work) {
    const KeptBlock* kept = work.blocks.data() + work.n_blocks;
    for (size_t i = work.n_entries; i-- > 0;) {
        const KeptEntry& e = work.entries[i];
        const TileEntry entry = f.entries[e.entry];
        const Record& g = f.sorted[entry.rank()];
        kept -= __builtin_popcount(e.blocks);
        if (!e.line) { pass_behind(g, e.blocks, kept, work); continue; }
        const size_t slot = size_t(g.first) + entry.offset();
        leave_line(g, e.blocks, kept, left, top, work, lines.lines[slot]);
        lines.left[slot] = 1;
    }
}

// Forward, loss and adjoint; `lines` gets the gradients of what the tile shows.
inline void train_tile(const Frame& f, const SplatView& v, int64_t tile, const SplatImage& image, const SplatLoss& loss,
                       StepLines& lines, TileWork& work) {
    const TileGrid grid(v);
    const int64_t left = 16 * (tile % grid.columns), top = 16 * (tile / grid.columns);
    work.sums = {};
    uint32_t valid = 0;
    const f16 zero = splat16(0);
    for (int block = 0; block < 16; ++block) {
        const Target target(image, left + 4 * (block & 3), top + 4 * (block >> 2));
        work.pixels.start(block, select_less(zero, target.weight, splat16(1), zero));  // masked pixels end at once
        if (greater_bits(target.weight, zero)) valid |= 1u << block;
    }
    if (!valid) return;
    forward_tile(f, tile, float(left), float(top), valid, loss, work);
    loss_of_tile(image, left, top, valid, loss, work);
    backward_tile(f, lines, float(left), float(top), work);
}

}  // namespace NERFVOL_ISA
