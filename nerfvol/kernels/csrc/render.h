// Forward rendering of packets: colour, transmittance, expected and median distance, normals.
#pragma once
#include "composite.h"
#include "pool.h"

namespace NERFVOL_ISA {

using nerfvol::kSquare;
using nerfvol::Rays;
using nerfvol::RenderOptions;
using nerfvol::RenderOutput;
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

// Hits that wait to be composited, front to back: extinction is expensive and worked out for sixteen at a time, while a leaf
// is met by three rays on average. A ray that ends leaves a few hits behind here, which are dropped.
struct Waiting {
    static constexpr int kCapacity = 2 * kTile;  // small, to stay in the core's nearest cache
    int first = 0, end = 0;
    int32_t lane[kCapacity];
    float raw[kCapacity + 16], length[kCapacity + 16];  // read sixteen at a time, a few beyond the end
    float middle[kCapacity], place[kCapacity][3];
    Cell cell[kCapacity];
    float slope[kCapacity][3];             // of the raw density, for normals

    int size() const { return end - first; }

    // Makes room for a strip's hits behind those that wait.
    void make_room(bool with_slopes) {
        if (end + kTile <= kCapacity) return;
        const auto forward = [&](auto* rows) { std::memmove(rows, rows + first, size_t(size()) * sizeof(*rows)); };
        forward(lane); forward(raw); forward(length); forward(middle); forward(place); forward(cell);
        if (with_slopes) forward(slope);
        end -= first;
        first = 0;
    }
};

// What a packet's rays gather besides colour.
template <int S> struct Extras {
    float depth[S * kTile] = {}, median[S * kTile] = {}, normal[S * kTile][3] = {};
};

// Segments too faint to be seen have the colour of the next one on their ray, which is as good as theirs and saves most of
// the work where rays cross haze: a weight below early_stop_eps / kFaint, and no more of it on a ray than early_stop_eps.
constexpr float kFaint = 4;
template <int S> struct Faint {
    float owed[S * kTile] = {};            // weight without a colour so far
    float spare[S * kTile];                // how much more may go that way

    explicit Faint(float early_stop_eps) { std::fill_n(spare, S * kTile, early_stop_eps); }
};

inline void add_normal(const float* slope, float w, float* normal) {
    const float norm = std::sqrt(dot3(slope, slope));
    if (norm > 1e-12f)
        for (int k = 0; k < 3; ++k) normal[k] -= w * slope[k] / norm;
}

// Distance at which the transmittance falls to 1/2 inside a segment that starts with more and ends with less.
inline float median_distance(float before, float raw, float length, float middle, float density_scale) {
    const float tau = length * density_scale * (raw < 1.0f ? std::exp(raw - 1.0f) : raw);
    const float f = tau > 0 ? std::log(2.0f * before) / tau : 0.0f;
    return middle + (f - 0.5f) * length;
}

// Composites the first `m` <= 64 of the hits that wait.
template <int B, int S>
void composite(const Tree& tree, Packet<S>& p, const RenderOptions& options, const RenderOutput& out, Waiting& waiting, int m,
               const Harmonics<B>* basis, PacketState<S>& state, Faint<S>& faint, Extras<S>& extras) {
    Extinction x;
    x.evaluate(waiting.raw + waiting.first, waiting.length + waiting.first, m, tree.density_scale, false);
    const bool with_depth = out.depth, with_median = out.median_depth, with_normal = out.normal;
    const float too_faint = options.early_stop_eps * (1 / kFaint);
    bool some_end = false;
    int lit[kTile + 1], n_lit = 0;
    float weight[kTile + 1];
    for (int i = 0, j = waiting.first; i < m; ++i, ++j) {
        const int l = waiting.lane[j];
        uint64_t& alive = p.strips[l / kTile].alive;
        if (!(alive >> l % kTile & 1)) continue;
        const float before = state.trans[l], after = before * x.through[i], w = before * x.alpha[i];
        state.trans[l] = after;
        const bool is_faint = (w < too_faint) & (w <= faint.spare[l]);
        lit[n_lit] = j;
        weight[n_lit] = w + faint.owed[l];
        n_lit += !is_faint;
        faint.owed[l] = is_faint ? faint.owed[l] + w : 0.0f;
        faint.spare[l] -= is_faint ? w : 0.0f;
        if (with_depth) extras.depth[l] += w * waiting.middle[j];
        if (with_median && before > 0.5f && after <= 0.5f)
            extras.median[l] = median_distance(before, waiting.raw[j], waiting.length[j], waiting.middle[j], tree.density_scale);
        if (with_normal) add_normal(waiting.slope[j], w, extras.normal[l]);
        if (after < options.early_stop_eps) {
            alive &= ~(1ull << l % kTile);
            some_end = true;
        }
    }
    if (out.rgb)
        for (int i = 0; i < n_lit; ++i) {
            const int j = lit[i], l = waiting.lane[j];
            const float* at = waiting.place[j];
            state.colour[l] += weight[i] * (colour_at<B>(waiting.cell[j], at[0], at[1], at[2], basis[l / kTile].row[l % kTile]) + 0.5f);
        }
    if (some_end) p.find_alive();
    waiting.first += m;
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
        if (out.depth) out.depth[i] = extras.depth[l];
        if (out.median_depth) out.median_depth[i] = extras.median[l];
        if (out.normal) std::memcpy(out.normal + 3 * i, extras.normal[l], sizeof(extras.normal[l]));
    }
}

template <int B, int S>
void render_packet(const Tree& tree, Packet<S>& p, const RenderOptions& options, const RenderOutput& out, const Window& to) {
    Harmonics<B> basis[S];
    bool has_basis[S] = {};                // many strips of a picture meet nothing
    PacketState<S> state;
    Waiting waiting;
    Faint<S> faint(options.early_stop_eps);
    Extras<S> extras;
    march<B>(tree, p, [&](const Leaf&, const uint64_t* hits, const Segments* segments, const Cell& cell) {
        const DensityField density(cell.values, cell.corners, 16 * B);
        for (int s = 0; s < S; ++s) {
            if (!hits[s]) continue;
            const Segments& at = segments[s];
            if (!has_basis[s]) basis[s].fill(p.strips[s], tree.sh_degree);
            has_basis[s] = true;
            waiting.make_room(out.normal);
            alignas(64) float raw[kTile];
            for (int base = 0; base < kTile; base += 16)
                if (hits[s] >> base & 0xffff)
                    store(raw + base, density.at(load<f16>(at.fx + base), load<f16>(at.fy + base), load<f16>(at.fz + base)));
            int i = waiting.end;
            for (uint64_t h = hits[s]; h; h &= h - 1, ++i) {
                const int l = __builtin_ctzll(h);
                waiting.lane[i] = s * kTile + l;
                waiting.raw[i] = raw[l];
                waiting.length[i] = at.length[l] * tree.size;
                waiting.middle[i] = at.middle[l] * tree.size;
                waiting.place[i][0] = at.fx[l]; waiting.place[i][1] = at.fy[l]; waiting.place[i][2] = at.fz[l];
                waiting.cell[i] = cell;
                if (out.normal) density.slope(at.fx[l], at.fy[l], at.fz[l], waiting.slope[i]);
            }
            waiting.end = i;
            if (waiting.size() >= 16)
                composite(tree, p, options, out, waiting, std::min(waiting.size() & ~15, kTile), basis, state, faint, extras);
        }
    });
    composite(tree, p, options, out, waiting, waiting.size(), basis, state, faint, extras);
    write_window(to, state, extras, options, out);
}

template <int B> void render_rays(const Tree& tree, const Rays& rays, const RenderOptions& options, const RenderOutput& out) {
    const int tiles = int((rays.n + kTile - 1) / kTile);
    nerfvol::parallel_for((tiles + 15) / 16, [&](int chunk, int) {
        Packet<1> p;
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
            render_packet<B>(tree, p, options, out, {first, view.width, view.height - row * kSquare, view.width - column * kSquare});
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
