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

struct KeptBlock { float weight[16], alpha[16]; };
struct KeptEntry { uint32_t rank, slot, blocks; float largest; };   // largest weight; negative: no line

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

// One Gaussian on the blocks of a tile; returns the largest weight, and takes the blocks that have ended from `alive`.
inline fwide forward_entry(const Footprint& foot, uint32_t blocks, float eps, TilePixels& p, KeptBlock* kept, uint32_t& alive) {
    fwide largest = splat<fwide>(0);
    for (; blocks; blocks &= blocks - 1, ++kept) {
        const int block = __builtin_ctz(blocks);
        const auto across = foot.across(foot.x(block));
        uint32_t open = 0;
        for (int part = 0; part < kParts; ++part) {
            const int at = kWide * part;
            const fwide trans = load<fwide>(p.trans[block] + at), alpha = foot.alpha(across, foot.y(block, part), trans, eps);
            fwide after;
            const fwide w = composite_alpha(p, block, part, alpha, trans, foot.g.colour, after);
            store(kept->weight + at, w);
            store(kept->alpha + at, alpha);
            largest = vmax(largest, w);
            open |= greater_bits(after, splat<fwide>(eps));
        }
        if (!open) alive &= ~(1u << block);
    }
    return largest;
}

inline void forward_tile(const Frame& f, int64_t tile, float left, float top, uint32_t alive, const SplatLoss& loss, TileWork& work) {
    work.n_blocks = work.n_entries = 0;
    walk_tile(f, tile, alive, [&](uint64_t e, const Record& g, uint32_t blocks) {
        KeptBlock* kept = work.blocks.need_keeping(work.n_blocks + 16, work.n_blocks) + work.n_blocks;
        const fwide w = forward_entry(Footprint(g, left, top), blocks, loss.early_stop_eps, work.pixels, kept, alive);
        work.n_blocks += size_t(__builtin_popcount(blocks));
        const TileEntry entry = f.entries[e];
        const bool line = greater_bits(w, splat<fwide>(loss.weight_threshold)) != 0;
        work.entries.need_keeping(work.n_entries + 1, work.n_entries)[work.n_entries] = {
            entry.rank(), g.first + entry.offset(), blocks, line ? largest_of(w) : -1};
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

// Steps over one Gaussian on a part of a block: S, alpha and d = q - S.
inline fwide step_behind(const Record& g, int block, int at, const fwide& alpha, TileWork& work) {
    const fwide q = load<fwide>(work.g[0][block] + at) * g.colour[0] + load<fwide>(work.g[1][block] + at) * g.colour[1]
                  + load<fwide>(work.g[2][block] + at) * g.colour[2];
    const fwide s = load<fwide>(work.behind[block] + at), d = q - s;
    store(work.behind[block] + at, s + alpha * d);
    return d;
}

inline void pass_behind(const Record& g, uint32_t blocks, const KeptBlock* kept, TileWork& work) {
    for (; blocks; blocks &= blocks - 1, ++kept)
        for (int at = 0; at < 16; at += kWide) step_behind(g, __builtin_ctz(blocks), at, load<fwide>(kept->alpha + at), work);
}

inline void leave_line(const Footprint& foot, uint32_t blocks, const KeptBlock* kept, TileWork& work, float* out) {
    fwide s[kSums];
    for (fwide& v : s) v = splat<fwide>(0);
    for (; blocks; blocks &= blocks - 1, ++kept) {
        const int block = __builtin_ctz(blocks);
        const fwide x = foot.x(block);
        fwide h = splat<fwide>(0), hy = splat<fwide>(0);     // of all parts: x is the same in them
        for (int part = 0; part < kParts; ++part) {
            const int at = kWide * part;
            const fwide alpha = load<fwide>(kept->alpha + at), w = load<fwide>(kept->weight + at), y = foot.y(block, part);
            const fwide d = step_behind(foot.g, block, at, alpha, work);
            const fwide own = select_less(alpha, kAlphaMax, w * d, splat<fwide>(0));  // a clamped alpha has no gradient
            const fwide own_y = own * y;
            h += own;
            hy += own_y;
            s[kHyy] += own_y * y;
            for (int c = 0; c < 3; ++c) s[kWg + c] += w * load<fwide>(work.g[c][block] + at);
            s[kWe] += w * load<fwide>(work.error[block] + at);
        }
        const fwide hx = h * x;
        s[kH] += h;
        s[kHx] += hx;
        s[kHy] += hy;
        s[kHxx] += hx * x;
        s[kHxy] += hy * x;
    }
    store(out, four_sums(s[0], s[1], s[2], s[3]));
    store(out + 4, four_sums(s[4], s[5], s[6], s[7]));
    store(out + 8, four_sums(s[8], s[9], s[9], s[9]));
}

inline void backward_tile(const Frame& f, StepLines& lines, float left, float top, TileWork& work) {
    constexpr size_t kAhead = 4;
    const KeptBlock* kept = work.blocks.data() + work.n_blocks;
    for (size_t i = work.n_entries; i-- > 0;) {
        const KeptEntry& e = work.entries[i];
        if (i >= kAhead) __builtin_prefetch(&lines.lines[work.entries[i - kAhead].slot], 1);
        const Record& g = f.sorted[e.rank];
        kept -= __builtin_popcount(e.blocks);
        if (e.largest < 0) { pass_behind(g, e.blocks, kept, work); continue; }
        float* line = lines.lines[e.slot].sums;
        leave_line(Footprint(g, left, top), e.blocks, kept, work, line);
        line[kMaxWeight] = e.largest;
        lines.left[e.slot] = 1;
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
