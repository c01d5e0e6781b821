// Forward rendering of packets: colour, transmittance, expected and median distance, normals.
#pragma once
#include "composite.h"
#include "pool.h"

namespace NERFVOL_ISA {

using nerfvol::Rays;
using nerfvol::RenderOptions;
using nerfvol::RenderOutput;
using nerfvol::View;

// Loads up to 64 rays from index `first` that share their origin; returns how many.
inline int load_packet(const Tree& tree, const Rays& rays, int64_t first, int64_t end, Packet& p) {
    const float* o = rays.origins + 3 * (rays.origin_per_tile ? first / kTile : first);
    int n = 0;
    for (int64_t i = first; i < end && n < kTile; ++i, ++n) {
        const float* oi = rays.origins + 3 * (rays.origin_per_tile ? first / kTile : i);
        if (oi[0] != o[0] || oi[1] != o[1] || oi[2] != o[2]) break;
        set_direction(p, n, rays.directions + 3 * i);
    }
    p.alive = n == kTile ? ~0ull : (1ull << n) - 1;
    for (int l = n; l < kTile; ++l) p.dx[l] = p.dy[l] = p.dz[l] = p.ix[l] = p.iy[l] = p.iz[l] = 1.0f;
    for (int k = 0; k < 3; ++k) p.o[k] = (o[k] - tree.origin[k]) / tree.size;
    bound_packet(p);
    return n;
}

// Loads one tile of a view.
inline void load_tile(const Tree& tree, const View& view, int64_t row, int64_t column, Packet& p) {
    const float* tile = view.directions + 3 * kTile * (row * view.tile_columns + column);
    float* const directions[3] = {p.dx, p.dy, p.dz};
    float* const reciprocals[3] = {p.ix, p.iy, p.iz};
    for (int l = 0; l < kTile; l += 16) {
        const f16 x = load<f16>(tile + l), y = load<f16>(tile + kTile + l), z = load<f16>(tile + 2 * kTile + l);
        for (int k = 0; k < 3; ++k) {
            const float* r = view.rotation + 3 * k;
            const f16 d = r[0] * x + r[1] * y + r[2] * z;
            store(directions[k] + l, d);
            store(reciprocals[k] + l, select_less(vmax(d, -d), 1e-20f, splat16(1e20f), 1.0f / d));
        }
    }
    p.alive = ~0ull;
    for (int k = 0; k < 3; ++k) p.o[k] = (view.origin[k] - tree.origin[k]) / tree.size;
    bound_packet(p);
}

// Hits that wait to be composited, front to back: extinction is dear and worked out for sixteen at a time, while a leaf
// is met by three rays on average. A ray that ends leaves a few hits behind here, which are dropped.
struct Waiting {
    static constexpr int kCapacity = kTile + 16;
    int n = 0;
    int32_t lane[kCapacity];
    f4 value[kCapacity];                   // r, g, b (without 1/2), raw density
    float length[kCapacity], middle[kCapacity];
    float slope[kCapacity][3];             // of the raw density, for normals
};

// What a packet's rays gather beside colour.
struct Extras {
    float median[kTile] = {}, normal[kTile][3] = {};
};

inline void add_normal(const float* slope, float w, float* normal) {
    const float norm = std::sqrt(dot3(slope, slope));
    if (norm > 1e-12f)
        for (int k = 0; k < 3; ++k) normal[k] -= w * slope[k] / norm;
}

// Distance at which the transmittance falls to 1/2 inside a segment that starts with more and ends with less.
inline float median_distance(float before, float raw, float length, float middle, const Tree& tree) {
    const float tau = length * tree.size * tree.density_scale * (raw < 1.0f ? std::exp(raw - 1.0f) : raw);
    const float f = tau > 0 ? std::log(2.0f * before) / tau : 0.0f;
    return (middle + (f - 0.5f) * length) * tree.size;
}

// Composites the first `m` <= 64 of the hits that wait.
inline void composite(const Tree& tree, Packet& p, const RenderOptions& options, const RenderOutput& out, Waiting& waiting, int m,
                      PacketState& state, Extras& extras) {
    Extinction x;
    for (int i = 0; i < m; ++i) {
        x.raw[i] = waiting.value[i][3];
        x.length[i] = waiting.length[i] * tree.size;
    }
    x.evaluate(m, tree.density_scale, false);
    for (int i = 0; i < m; ++i) {
        const int l = waiting.lane[i];
        if (!(p.alive >> l & 1)) continue;
        const float before = state.trans[l], after = before * x.through[i], w = before * x.alpha[i];
        f4 c = waiting.value[i] + 0.5f;
        c[3] = waiting.middle[i] * tree.size;
        state.colour[l] += w * c;
        state.trans[l] = after;
        if (out.median_depth && before > 0.5f && after <= 0.5f)
            extras.median[l] = median_distance(before, x.raw[i], waiting.length[i], waiting.middle[i], tree);
        if (out.normal) add_normal(waiting.slope[i], w, extras.normal[l]);
        if (after < options.early_stop_eps) p.alive &= ~(1ull << l);
    }
    const int left = waiting.n - m;
    std::memmove(waiting.lane, waiting.lane + m, left * sizeof(waiting.lane[0]));
    std::memmove(waiting.value, waiting.value + m, left * sizeof(waiting.value[0]));
    std::memmove(waiting.length, waiting.length + m, left * sizeof(waiting.length[0]));
    std::memmove(waiting.middle, waiting.middle + m, left * sizeof(waiting.middle[0]));
    if (out.normal) std::memmove(waiting.slope, waiting.slope + m, left * sizeof(waiting.slope[0]));
    waiting.n = left;
}

// Where the results of a packet go: lane l to row l / 8 and column l % 8 of a window into the outputs.
struct Window {
    int64_t first, stride;                 // index of lane 0, and from row to row
    int rows, columns;                     // lanes beyond are not written
    int lanes;                             // of those, lanes beyond this are not written
};

inline void write_window(const Window& to, const PacketState& state, const Extras& extras, const RenderOptions& options,
                         const RenderOutput& out) {
    for (int l = 0; l < to.lanes; ++l) {
        if (l / 8 >= to.rows || l % 8 >= to.columns) continue;
        const int64_t i = to.first + l / 8 * to.stride + l % 8;
        const float t = state.trans[l];
        if (out.rgb)
            for (int k = 0; k < 3; ++k) out.rgb[3 * i + k] = state.colour[l][k] + t * options.background[k];
        if (out.trans) out.trans[i] = t;
        if (out.depth) out.depth[i] = state.colour[l][3];
        if (out.median_depth) out.median_depth[i] = extras.median[l];
        if (out.normal) std::memcpy(out.normal + 3 * i, extras.normal[l], sizeof(extras.normal[l]));
    }
}

template <int B>
void render_packet(const Tree& tree, Packet& p, const RenderOptions& options, const RenderOutput& out, const Window& to) {
    BasisRows<B> basis;
    bool has_basis = false;                // most packets of a picture meet nothing
    PacketState state;
    start(state);
    Waiting waiting;
    Extras extras;
    march<B>(tree, p, [&](const Leaf&, uint64_t hits, const Segments& s, const LeafField<B>& field) {
        if (!has_basis) basis.fill(p, tree.sh_degree);
        has_basis = true;
        int i = waiting.n;
        for (uint64_t h = hits; h; h &= h - 1, ++i) {
            const int l = __builtin_ctzll(h);
            waiting.lane[i] = l;
            waiting.value[i] = field.at(s.fx[l], s.fy[l], s.fz[l], basis.row[l]);
            waiting.length[i] = s.length[l];
            waiting.middle[i] = s.middle[l];
            if (out.normal) field.density_slope(s.fx[l], s.fy[l], s.fz[l], waiting.slope[i]);
        }
        waiting.n = i;
        if (i >= 16) composite(tree, p, options, out, waiting, std::min(i & ~15, kTile), state, extras);
    });
    composite(tree, p, options, out, waiting, waiting.n, state, extras);
    write_window(to, state, extras, options, out);
}

template <int B> void render_rays(const Tree& tree, const Rays& rays, const RenderOptions& options, const RenderOutput& out) {
    const int tiles = int((rays.n + kTile - 1) / kTile);
    nerfvol::parallel_for((tiles + 15) / 16, [&](int chunk, int) {
        Packet p;
        for (int64_t t = int64_t(chunk) * 16; t < tiles && t < int64_t(chunk + 1) * 16; ++t) {
            const int64_t end = std::min<int64_t>((t + 1) * kTile, rays.n);
            for (int64_t first = t * kTile; first < end;) {
                const int n = load_packet(tree, rays, first, end, p);
                render_packet<B>(tree, p, options, out, {first, 8, 8, 8, n});
                first += n;
            }
        }
    });
}

// Blocks of 4x4 tiles are a thread's unit of work: neighbours see the same leaves.
template <int B> void render_tiles(const Tree& tree, const View& view, const RenderOptions& options, const RenderOutput& out) {
    const int64_t blocks_across = (view.tile_columns + 3) / 4, blocks_down = (view.tile_rows + 3) / 4;
    nerfvol::parallel_for(int(blocks_across * blocks_down), [&](int block, int) {
        Packet p;
        for (int t = 0; t < 16; ++t) {
            const int64_t row = block / blocks_across * 4 + t / 4, column = block % blocks_across * 4 + t % 4;
            if (row >= view.tile_rows || column >= view.tile_columns) continue;
            load_tile(tree, view, row, column, p);
            const Window to = {row * 8 * view.width + column * 8, view.width, int(std::min<int64_t>(8, view.height - row * 8)),
                               int(std::min<int64_t>(8, view.width - column * 8)), kTile};
            render_packet<B>(tree, p, options, out, to);
        }
    });
}

inline void render(const Tree& tree, const Rays& rays, const RenderOptions& options, const RenderOutput& out) {
    switch (tree.blocks) {
        case 1: return render_rays<1>(tree, rays, options, out);
        case 2: return render_rays<2>(tree, rays, options, out);
        default: return render_rays<4>(tree, rays, options, out);
    }
}

inline void render_view(const Tree& tree, const View& view, const RenderOptions& options, const RenderOutput& out) {
    switch (tree.blocks) {
        case 1: return render_tiles<1>(tree, view, options, out);
        case 2: return render_tiles<2>(tree, view, options, out);
        default: return render_tiles<4>(tree, view, options, out);
    }
}

}  // namespace NERFVOL_ISA
