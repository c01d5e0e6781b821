// Forward rendering of packets: colour, transmittance, expected and median distance, normals.
#pragma once
#include "collect.h"
#include "pool.h"

namespace NERFVOL_ISA {

using nerfvol::kSquare;
using nerfvol::Rays;
using nerfvol::View;

// Loads up to 64 rays from index `first` that share their origin; returns how many.
inline int load_packet(const Tree& tree, const Rays& rays, int64_t first, int64_t end, Packet<1>& p) {
    const float* o = rays.origins + 3 * (rays.origin_per_tile ? first / kTile : first);
    Lanes& to = p.strips[0];
    int n = 0;
    for (int64_t i = first; i < end && n < kTile; ++i, ++n) {
        const float* oi = rays.origins + 3 * (rays.origin_per_tile ? first / kTile : i);
        if (oi[0] != o[0] || oi[1] != o[1] || oi[2] != o[2]) break;
        set_direction(to, n, rays.directions + 3 * i);
    }
    to.alive = n == kTile ? ~0ull : (1ull << n) - 1;
    for (int l = n; l < kTile; ++l) to.dx[l] = to.dy[l] = to.dz[l] = to.ix[l] = to.iy[l] = to.iz[l] = 1.0f;
    for (int k = 0; k < 3; ++k) p.pyramid.o[k] = (o[k] - tree.origin[k]) / tree.size;
    bound_packet(p);
    return n;
}

// Loads one square of a view.
inline void load_square(const Tree& tree, const View& view, int64_t row, int64_t column, Packet<4>& p) {
    for (int s = 0; s < 4; ++s) {
        Lanes& to = p.strips[s];
        const float* strip = view.directions + 3 * kTile * (4 * (row * view.square_columns + column) + s);
        float* const directions[3] = {to.dx, to.dy, to.dz};
        float* const reciprocals[3] = {to.ix, to.iy, to.iz};
        for (int l = 0; l < kTile; l += 16) {
            const f16 x = load<f16>(strip + l), y = load<f16>(strip + kTile + l), z = load<f16>(strip + 2 * kTile + l);
            for (int k = 0; k < 3; ++k) {
                const float* r = view.rotation + 3 * k;
                const f16 d = r[0] * x + r[1] * y + r[2] * z;
                store(directions[k] + l, d);
                store(reciprocals[k] + l, select_less(vmax(d, -d), 1e-20f, splat16(1e20f), 1.0f / d));
            }
        }
        to.alive = ~0ull;
    }
    for (int k = 0; k < 3; ++k) p.pyramid.o[k] = (view.origin[k] - tree.origin[k]) / tree.size;
    bound_packet(p);
}

// Where lane `lane` of strip `strip` lies in its packet's 8x8 tile or 16x16 square.
template <int S> int row_of(int strip, int lane) { return S == 1 ? lane / 8 : 4 * strip + lane / 32 * 2 + lane / 2 % 2; }
template <int S> int column_of(int lane) { return S == 1 ? lane % 8 : lane / 4 % 8 * 2 + lane % 2; }

// Where the results of a packet go: the pixel in its first row and column to index `first` of the outputs.
struct Window {
    int64_t first, stride;                 // stride: from row to row
    int64_t rows, columns;                 // what lies beyond is not written
    int lanes = kTile;                     // of a strip; lanes beyond are not written
};

template <int S>
void write_window(const Window& to, const PacketState<S>& state, const Extras<S>& extras, const RenderOptions& options,
                  const RenderOutput& out) {
    for (int l = 0; l < S * kTile; ++l) {
        const int row = row_of<S>(l / kTile, l % kTile), column = column_of<S>(l % kTile);
        if (l % kTile >= to.lanes || row >= to.rows || column >= to.columns) continue;
        const int64_t i = to.first + row * to.stride + column;
        const float t = state.trans[l];
        if (out.rgb)
            for (int k = 0; k < 3; ++k) out.rgb[3 * i + k] = state.colour[l][k] + t * options.background[k];
        if (out.trans) out.trans[i] = t;
        if (out.depth) out.depth[i] = state.colour[l][3];
        if (out.median_depth) out.median_depth[i] = extras.median[l];
        if (out.normal) std::memcpy(out.normal + 3 * i, extras.normal[l], sizeof(extras.normal[l]));
    }
}

// small: cells whose side is below so many times their distance are shaded along the ray to their middle, from which the
// directions of all rays that meet them differ by sqrt(3)/2 of that at most.
template <int B, int S>
void render_packet(const Tree& tree, Packet<S>& p, const RenderOptions& options, const RenderOutput& out, const Window& to, float small) {
    BasisRows<B> basis[S];
    bool has_basis[S] = {};                // many strips of a picture meet nothing, or nothing near
    Collector<S> found{tree, p, options, out, {}, {}, {}};
    const float* o = p.pyramid.o;
    march<B>(tree, p, [&](const Leaf& leaf, const uint64_t* hits, const Segments* segments, const Cell& c) {
        const float h = 0.5f * leaf.side, towards[3] = {leaf.x + h - o[0], leaf.y + h - o[1], leaf.z + h - o[2]};
        const auto slope_of = [](const auto& field) {
            return [&field](float x, float y, float z, float* g) { field.density_slope(x, y, z, g); };
        };
        if (leaf.side * leaf.side < small * small * dot3(towards, towards)) {
            const SmallLeafField<B> field(c.values, c.corners, tree.sh_degree, towards);
            found.collect(hits, segments, [&](float x, float y, float z, int, int) { return field.at(x, y, z); }, slope_of(field));
            return;
        }
        for (int s = 0; s < S; ++s) {
            if (!hits[s] || has_basis[s]) continue;
            basis[s].fill(p.strips[s], tree.sh_degree);
            has_basis[s] = true;
        }
        const LeafField<B> field(c.values, c.corners);
        found.collect(hits, segments, [&](float x, float y, float z, int s, int l) { return field.at(x, y, z, basis[s].row[l]); },
                      slope_of(field));
    });
    found.composite_first(found.waiting.size());
    write_window(to, found.state, found.extras, options, out);
}

template <int B> void render_rays(const Tree& tree, const Rays& rays, const RenderOptions& options, const RenderOutput& out) {
    const int tiles = int((rays.n + kTile - 1) / kTile);
    nerfvol::parallel_for((tiles + 15) / 16, [&](int chunk, int) {
        Packet<1> p;
        for (int64_t t = int64_t(chunk) * 16; t < tiles && t < int64_t(chunk + 1) * 16; ++t) {
            const int64_t end = std::min<int64_t>((t + 1) * kTile, rays.n);
            for (int64_t first = t * kTile; first < end;) {
                const int n = load_packet(tree, rays, first, end, p);
                render_packet<B>(tree, p, options, out, {first, 8, 8, 8, n}, 0);
                first += n;
            }
        }
    });
}

// Four squares that touch are a thread's unit of work: neighbours see the same leaves.
template <int B> void render_squares(const Tree& tree, const View& view, const RenderOptions& options, const RenderOutput& out) {
    const int64_t across = (view.square_columns + 1) / 2, down = (view.square_rows + 1) / 2;
    nerfvol::parallel_for(int(across * down), [&](int unit, int) {
        Packet<4> p;
        for (int k = 0; k < 4; ++k) {
            const int64_t row = unit / across * 2 + k / 2, column = unit % across * 2 + k % 2;
            if (row >= view.square_rows || column >= view.square_columns) continue;
            load_square(tree, view, row, column, p);
            const int64_t first = row * kSquare * view.width + column * kSquare;
            render_packet<B>(tree, p, options, out, {first, view.width, view.height - row * kSquare, view.width - column * kSquare},
                             view.small);
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
        case 1: return render_squares<1>(tree, view, options, out);
        case 2: return render_squares<2>(tree, view, options, out);
        default: return render_squares<4>(tree, view, options, out);
    }
}

}  // namespace NERFVOL_ISA
