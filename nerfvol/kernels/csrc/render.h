// Forward rendering of packets: colour, transmittance, expected and median distance, normals.
#pragma once
#include "composite.h"
#include "pool.h"

namespace NERFVOL_ISA {

using nerfvol::Rays;
using nerfvol::RenderOptions;
using nerfvol::RenderOutput;

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

// d(raw)/d(x, y, z) inside a leaf, for normals.
inline void add_normal(const float* const* rows, float fx, float fy, float fz, float w, float* normal) {
    float v[8];
    for (int o = 0; o < 8; ++o) v[o] = rows[o][kDensitySlot];
    auto mix = [](float a, float b, float f) { return a + f * (b - a); };
    float g[3] = {mix(mix(v[4] - v[0], v[5] - v[1], fz), mix(v[6] - v[2], v[7] - v[3], fz), fy),
                  mix(mix(v[2] - v[0], v[3] - v[1], fz), mix(v[6] - v[4], v[7] - v[5], fz), fx),
                  mix(mix(v[1] - v[0], v[3] - v[2], fy), mix(v[5] - v[4], v[7] - v[6], fy), fx)};
    const float norm = std::sqrt(dot3(g, g));
    if (norm > 1e-12f)
        for (int k = 0; k < 3; ++k) normal[k] -= w * g[k] / norm;
}

template <int B>
void render_packet(const Tree& tree, Packet& p, const RenderOptions& options, const RenderOutput& out, int64_t first, int n) {
    BasisRows<B> basis;
    basis.fill(p, tree.sh_degree);
    PacketState state;
    start(state);
    Extinction x;
    float median[kTile], normal[kTile][3];
    std::memset(median, 0, sizeof(median));
    std::memset(normal, 0, sizeof(normal));
    const bool extras = out.median_depth || out.normal;
    march<B>(tree, p, basis, [&](const Leaf&, uint64_t hits, const Segments& s, const float* const* rows, const BasisRows<B>& b) {
        f4 value[kTile];
        int lanes[kTile], m = 0;
        for (uint64_t h = hits; h; h &= h - 1, ++m) {
            const int l = lanes[m] = __builtin_ctzll(h);
            value[m] = evaluate<B>(rows, trilinear(s.fx[l], s.fy[l], s.fz[l]), b.row[l]);
            x.raw[m] = value[m][3];
            x.length[m] = s.length[l] * tree.size;
        }
        x.evaluate(m, tree.density_scale, false);
        for (int i = 0; i < m; ++i) {
            const int l = lanes[i];
            const float before = state.trans[l], after = before * x.through[i], w = before * x.alpha[i];
            f4 c = value[i] + 0.5f;
            c[3] = s.middle[l] * tree.size;
            state.colour[l] += w * c;
            state.trans[l] = after;
            if (extras) {
                if (before > 0.5f && after <= 0.5f) {
                    const float raw = x.raw[i];
                    const float tau = x.length[i] * tree.density_scale * (raw < 1.0f ? std::exp(raw - 1.0f) : raw);
                    const float f = tau > 0 ? std::log(2.0f * before) / tau : 0.0f;
                    median[l] = (s.middle[l] + (f - 0.5f) * s.length[l]) * tree.size;
                }
                if (out.normal) add_normal(rows, s.fx[l], s.fy[l], s.fz[l], w, normal[l]);
            }
            if (after < options.early_stop_eps) p.alive &= ~(1ull << l);
        }
    });
    for (int l = 0; l < n; ++l) {
        const int64_t i = first + l;
        const float t = state.trans[l];
        if (out.rgb)
            for (int k = 0; k < 3; ++k) out.rgb[3 * i + k] = state.colour[l][k] + t * options.background[k];
        if (out.trans) out.trans[i] = t;
        if (out.depth) out.depth[i] = state.colour[l][3];
        if (out.median_depth) out.median_depth[i] = median[l];
        if (out.normal) std::memcpy(out.normal + 3 * i, normal[l], sizeof(normal[l]));
    }
}

template <int B> void render_rays(const Tree& tree, const Rays& rays, const RenderOptions& options, const RenderOutput& out) {
    const int tiles = int((rays.n + kTile - 1) / kTile);
    nerfvol::parallel_for((tiles + 15) / 16, [&](int chunk, int) {
        Packet p;
        for (int64_t t = int64_t(chunk) * 16; t < tiles && t < int64_t(chunk + 1) * 16; ++t) {
            const int64_t end = std::min<int64_t>((t + 1) * kTile, rays.n);
            for (int64_t first = t * kTile; first < end;) {
                const int n = load_packet(tree, rays, first, end, p);
                render_packet<B>(tree, p, options, out, first, n);
                first += n;
            }
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

}  // namespace NERFVOL_ISA
