// Pictures of Gaussians: colour and opacity, and depth, median depth and normals where they are wanted.
#pragma once
#include "blend.h"

namespace NERFVOL_ISA {

using nerfvol::SplatOutput;
using nerfvol::SplatRenderOptions;

// What a tile gathers beside the colour: sums of w z and of w n, and z where T falls to 1/2.
struct TileExtras {
    alignas(64) float depth[16][16] = {}, median[16][16] = {}, normal[3][16][16] = {};

    void add(int block, int part, const fwide& w, const fwide& before, const fwide& after, float z, const float* n) {
        const int at = kWide * part;
        store(depth[block] + at, load<fwide>(depth[block] + at) + w * z);
        const fwide half = splat<fwide>(0.5f), old = load<fwide>(median[block] + at), now = splat<fwide>(z);
        // before > 1/2 >= after; T falls only once, so what is set stays.
        store(median[block] + at, select_less(half, before, select_less(half, after, old, now), old));
        for (int c = 0; c < 3; ++c) store(normal[c][block] + at, load<fwide>(normal[c][block] + at) + w * n[c]);
    }
};

// Copies a tile's values to the picture, whose pixels have `stride` numbers.
inline void copy_tile(const float (&tile)[16][16], float* out, int stride, const SplatView& v, int64_t left, int64_t top) {
    const int64_t columns = std::min<int64_t>(16, v.width - left), rows = std::min<int64_t>(16, v.height - top);
    for (int64_t y = 0; y < rows; ++y) {
        float* row = out + ((top + y) * v.width + left) * stride;
        for (int64_t x = 0; x < columns; ++x) row[x * stride] = tile[4 * (y / 4) + x / 4][4 * (y % 4) + x % 4];
    }
}

// Depths along the axis become distances along the pixels' rays.
inline void along_rays(float (&tile)[16][16], const SplatView& v, float left, float top) {
    for (int block = 0; block < 16; ++block) {
        const f16 x = (load<f16>(kLaneX) + (left + kBlockX[block] + 0.5f - v.cx)) * (1 / v.fx);
        const f16 y = (load<f16>(kLaneY) + (top + kBlockY[block] + 0.5f - v.cy)) * (1 / v.fy);
        store(tile[block], load<f16>(tile[block]) * vsqrt(x * x + y * y + 1.0f));
    }
}

template <bool Extras>
void render_tile(Frame& f, const SplatView& v, int64_t tile, const SplatRenderOptions& options, const SplatOutput& out) {
    const TileGrid grid(v);
    const int64_t left = 16 * (tile % grid.columns), top = 16 * (tile / grid.columns);
    TilePixels p;
    for (int block = 0; block < 16; ++block) p.start(block, splat16(1));
    TileExtras extras;
    uint32_t alive = 0xffff;
    const float eps = options.early_stop_eps;
    walk_tile(f, tile, alive, [&](uint64_t, const Record& g, uint32_t blocks) {
        const Footprint foot(g, float(left), float(top));
        for (; blocks; blocks &= blocks - 1) {
            const int block = __builtin_ctz(blocks);
            const auto across = foot.across(foot.x(block));
            uint32_t open = 0;
            for (int part = 0; part < kParts; ++part) {
                const fwide trans = load<fwide>(p.trans[block] + kWide * part);
                const fwide alpha = foot.alpha(across, foot.y(block, part), trans, eps);
                fwide after;
                const fwide w = composite_alpha(p, block, part, alpha, trans, g.colour, after);
                if (Extras) extras.add(block, part, w, trans, after, g.z, f.normals.data() + 4 * size_t(g.id));
                open |= greater_bits(after, splat<fwide>(eps));
            }
            if (!open) alive &= ~(1u << block);
        }
    });
    for (int block = 0; block < 16; ++block) {
        for (int c = 0; c < 3; ++c) store(p.colour[c][block], p.channel(block, c, options.background));
        store(p.trans[block], 1.0f - load<f16>(p.trans[block]));
    }
    for (int c = 0; c < 3; ++c) {
        if (out.rgb) copy_tile(p.colour[c], out.rgb + c, 3, v, left, top);
        if (Extras && out.normal) copy_tile(extras.normal[c], out.normal + c, 3, v, left, top);
    }
    if (out.opacity) copy_tile(p.trans, out.opacity, 1, v, left, top);
    if (!Extras) return;
    along_rays(extras.depth, v, float(left), float(top));
    along_rays(extras.median, v, float(left), float(top));
    if (out.depth) copy_tile(extras.depth, out.depth, 1, v, left, top);
    if (out.median_depth) copy_tile(extras.median, out.median_depth, 1, v, left, top);
}

template <int K>
void render_basis(const Splats& splats, const SplatView& view, const SplatRenderOptions& options, const SplatOutput& out) {
    Frame& frame = shared_frame();
    const bool extras = out.depth || out.median_depth || out.normal;
    prepare_frame<K>(splats, view, frame, extras);
    splat_for(TileGrid(view).size(), [&](int tile, int) {
        if (extras) render_tile<true>(frame, view, tile, options, out);
        else render_tile<false>(frame, view, tile, options, out);
    });
}

inline void render_splats(const Splats& splats, const SplatView& view, const SplatRenderOptions& options, const SplatOutput& out) {
    const std::lock_guard<nerfvol::Mutex> lock(one_splat_call());
    switch (splats.basis) {
        case 1: return render_basis<1>(splats, view, options, out);
        case 4: return render_basis<4>(splats, view, options, out);
        case 9: return render_basis<9>(splats, view, options, out);
        default: return render_basis<16>(splats, view, options, out);
    }
}

}  // namespace NERFVOL_ISA
