// Forward and adjoint of one packet: its hits front to back, then their gradients back to front.
#pragma once
#include <algorithm>
#include <memory>
#include <new>
#include <utility>

#include "render.h"

namespace NERFVOL_ISA {

using nerfvol::Cotangents;
using nerfvol::Loss;
using nerfvol::StepReport;

// The packet in work: hits front to back and the leaves they lie in. Reused by a thread, so that it stays in its cache.
struct Workspace {
    std::unique_ptr<Hit[]> hits;
    std::vector<Visit> visits;
    std::vector<int32_t> first_hit;       // of each visit
    size_t size = 0, capacity = 0;
    int64_t tested = 0;                   // leaves, see march

    Hit* append(size_t n) {
        if (size + n > capacity) {
            capacity = std::max<size_t>(4096, 2 * (size + n));
            std::unique_ptr<Hit[]> larger(new Hit[capacity]);
            std::copy(hits.get(), hits.get() + size, larger.get());
            hits = std::move(larger);
        }
        size += n;
        return hits.get() + size - n;
    }
};

// Gradients of vertices: one row each, in the order of the first touch, each on cache lines of its own.
class VertexGradients {
public:
    // Forgets all and makes room for n vertices of row_floats each.
    void start(size_t n, size_t row_floats) {
        row_floats_ = row_floats;
        vertices.clear();
        vertices.reserve(n);
        if (n * row_floats > capacity_) {
            capacity_ = n * row_floats * 5 / 4;
            rows_.reset(new (std::align_val_t{64}) float[capacity_]);
        }
    }
    float* row(size_t i) { return rows_.get() + i * row_floats_; }
    const float* row(size_t i) const { return rows_.get() + i * row_floats_; }
    float* append(int32_t vertex) {  // the row is not set
        vertices.push_back(vertex);
        return row(vertices.size() - 1);
    }

    std::vector<int32_t> vertices;

private:
    struct Free {
        void operator()(float* p) const { ::operator delete[](p, std::align_val_t{64}); }
    };
    std::unique_ptr<float[], Free> rows_;
    size_t capacity_ = 0, row_floats_ = 0;
};

// Where each vertex is in VertexGradients: open addressing in a table that cannot fill up, as a rule a quarter full since
// leaves share corners.
class VertexTable {
public:
    void start(size_t n) {  // n: an upper bound of the vertices
        bits_ = 6;
        while ((size_t(1) << bits_) <= n) ++bits_;
        entries_.assign(size_t(1) << bits_, {-1, 0});
    }
    template <int B> void add(int32_t vertex, const float (&gradient)[16 * B], VertexGradients& gradients) {
        const size_t mask = entries_.size() - 1;
        for (size_t at = (uint32_t(vertex) * 2654435769u) >> (32 - bits_);; at = (at + 1) & mask) {
            Entry& e = entries_[at];
            if (e.vertex == vertex) {
                float* row = gradients.row(size_t(e.place));
                for (int k = 0; k < B; ++k) store(row + 16 * k, load<f16>(row + 16 * k) + load<f16>(gradient + 16 * k));
                return;
            }
            if (e.vertex >= 0) continue;
            e = {vertex, int32_t(gradients.vertices.size())};
            float* row = gradients.append(vertex);
            for (int k = 0; k < B; ++k) store(row + 16 * k, load<f16>(gradient + 16 * k));
            return;
        }
    }

private:
    struct Entry {
        int32_t vertex, place;
    };
    std::vector<Entry> entries_;
    int bits_ = 0;
};

template <int B>
void forward_packet(const Tree& tree, Packet<1>& p, const BasisRows<B>& basis, float eps, PacketState<1>& state, Workspace& work) {
    Extinction x;
    alignas(64) float raw[kTile], length[kTile];
    work.size = 0;
    work.visits.clear();
    work.first_hit.clear();
    work.tested = march<B>(tree, p, [&](const Leaf& leaf, const uint64_t* hits, const Segments* segments, const Cell& c) {
        const LeafField<B> field(c.values, c.corners);
        const Segments& s = segments[0];
        const int m = __builtin_popcountll(hits[0]);
        const size_t base = work.size;
        Hit* h = work.append(size_t(m));
        int i = 0;
        for (uint64_t rest = hits[0]; rest; rest &= rest - 1, ++i) {
            const int l = __builtin_ctzll(rest);
            h[i].lane = l;
            h[i].fx = s.fx[l]; h[i].fy = s.fy[l]; h[i].fz = s.fz[l];
            h[i].length = s.length[l] * tree.size;
            h[i].middle = s.middle[l];
            h[i].value = field.at(s.fx[l], s.fy[l], s.fz[l], basis.row[l]);
            raw[i] = h[i].value[3];
            length[i] = h[i].length;
        }
        x.evaluate(raw, length, m, tree.density_scale, true);
        Visit visit = {leaf.index, m, 0, 0, 1e30f, leaf.side};
        for (i = 0; i < m; ++i) {
            const int l = h[i].lane;
            const float before = state.trans[l], w = before * x.alpha[i];
            h[i].weight = w;
            h[i].trans_after = state.trans[l] = before * x.through[i];
            h[i].tau_slope = x.slope[i];
            f4 value = h[i].value + 0.5f;
            value[3] = h[i].middle;
            state.colour[l] += w * value;
            visit.max_weight = std::max(visit.max_weight, w);
            visit.near = std::min(visit.near, h[i].middle);
            if (h[i].trans_after < eps) p.strips[0].alive &= ~(1ull << l);
        }
        p.find_alive();
        work.visits.push_back(visit);
        work.first_hit.push_back(int32_t(base));
    });
}

// Per ray, what the adjoint needs besides the hits.
struct Adjoint {
    f4 colour[kTile];                      // dL/dC, and dL/d(expected distance in root cubes)
    float behind[kTile];                   // S: starts at T_N q_N
    float target[kTile][3], colour_weight[kTile], distortion_weight[kTile], error[kTile], ray_weight[kTile];
    float weight_sum[kTile], moment_sum[kTile];          // over all hits, for the distortion loss
    float weight_behind[kTile], moment_behind[kTile];
    float sparsity = 0, tv_density = 0, tv_sh = 0;
};

inline void adjoint_of_cotangents(const Tree& tree, const Cotangents& c, const RenderOptions& options, const PacketState<1>& s,
                                  int64_t first, int n, Adjoint& a) {
    for (int l = 0; l < n; ++l) {
        const int64_t i = first + l;
        float q = c.trans ? c.trans[i] : 0.0f;
        f4 g{};
        if (c.rgb)
            for (int k = 0; k < 3; ++k) { g[k] = c.rgb[3 * i + k]; q += g[k] * options.background[k]; }
        if (c.depth) g[3] = c.depth[i] * tree.size;
        a.colour[l] = g;
        a.behind[l] = s.trans[l] * q;
        a.colour_weight[l] = a.distortion_weight[l] = a.error[l] = a.ray_weight[l] = 0;
        a.weight_sum[l] = a.moment_sum[l] = 0;
    }
}

inline void adjoint_of_loss(const Loss& loss, const PacketState<1>& s, int64_t first, int n, Adjoint& a, StepReport& report) {
    const nerfvol::LossOptions& o = loss.options;
    a.sparsity = o.sparsity;
    a.tv_density = o.tv_density;
    a.tv_sh = o.tv_sh;
    for (int l = 0; l < n; ++l) {
        const float* target = loss.target + 3 * (first + l);
        const float weight = loss.weight[first + l];
        float q = 0, error = 0, miss = 0;
        f4 g{};
        for (int k = 0; k < 3; ++k) {
            const float residual = s.colour[l][k] + s.trans[l] * o.background[k] - target[k];
            const float d = o.background[k] - target[k];
            a.target[l][k] = target[k];
            error += residual * residual;
            miss += d * d;
            g[k] = 2 * weight * residual;
            q += g[k] * o.background[k];
        }
        a.colour[l] = g;
        a.behind[l] = s.trans[l] * (q + weight * o.colour * miss);
        a.colour_weight[l] = weight * o.colour;
        a.distortion_weight[l] = weight * o.distortion;
        a.error[l] = weight * error;
        a.ray_weight[l] = weight;
        a.weight_sum[l] = 1 - s.trans[l];
        a.moment_sum[l] = s.colour[l][3];
        report.squared_error += double(weight) * error;
        report.weight += weight;
    }
}

// Calls f(0), ..., f(7) with numbers known at once. GCC unrolls loops after it has decided which arrays become registers: one
// with an index that was a loop's stays in memory, and is cleared and copied there in pieces of 16 bytes.
template <class F, int... O> inline void each_of(std::integer_sequence<int, O...>, F&& f) { (f(std::integral_constant<int, O>{}), ...); }
template <class F> inline void each_corner(F&& f) { each_of(std::make_integer_sequence<int, 8>{}, f); }

// The gradient of a vertex row at each of a leaf's eight corners.
template <int B> struct CornerRows {
    alignas(64) float row[8][16 * B];
};

// Of the numbers of a row's first block and of a further one: what weighs their differences, and the knee e below which these
// count by their squares, larger ones as they are: an edge of the scene is no worse than a slope.
struct Variation {
    alignas(64) float of_sh[32], of_density[32], knee[32];

    constexpr Variation() : of_sh(), of_density(), knee() {
        for (int i = 0; i < 32; ++i) {
            const bool is_sh = i < kDensitySlot || i >= 16;
            of_sh[i] = is_sh ? 1.0f : 0.0f;
            of_density[i] = i == kDensitySlot ? 1.0f : 0.0f;
            knee[i] = is_sh ? 0.1f : 1.0f;
        }
    }
};
constexpr Variation kVariation;

// One axis's share of add_variation: the four edges along it.
template <int Axis> void differences_along(const fwide (&value)[8], fwide weight, fwide knee, fwide (&sum)[8]) {
    each_corner([&](auto o) {
        if constexpr ((o & Axis) != 0) {
            const fwide d = value[o] - value[o ^ Axis], slope = weight * d / (knee + vmax(d, -d));
            sum[o] += slope;
            sum[o ^ Axis] -= slope;
        }
    });
}

// Adds to the gradients of a leaf's corners that of their differences d along its edges, the sum of weight * (|d| - e log(1 +
// |d| / e)) over edges and numbers of a vertex row: a total variation [Plenoxels] that is smooth at zero.
template <int B> void add_variation(const Tree& tree, const int32_t* corners, float density, float sh, CornerRows<B>& gradient) {
    for (int at = 0; at < 16 * B; at += kWide) {
        const int k = at < 16 ? at : 16 + at % 16;
        const fwide w = sh * load<fwide>(kVariation.of_sh + k) + density * load<fwide>(kVariation.of_density + k);
        const fwide e = load<fwide>(kVariation.knee + k);
        fwide value[8], sum[8];
        each_corner([&](auto o) {
            value[o] = load<fwide>(tree.values + 16 * B * int64_t(corners[o]) + at);
            sum[o] = load<fwide>(gradient.row[o] + at);
        });
        differences_along<1>(value, w, e, sum);
        differences_along<2>(value, w, e, sum);
        differences_along<4>(value, w, e, sum);
        each_corner([&](auto o) { store(gradient.row[o] + at, sum[o]); });
    }
}

// dL/d(r, g, b, raw density) of one hit over the numbers of a vertex row, and its shares of the leaf's corners.
template <int B> struct Pull {
    static constexpr int kRow = B == 2 ? 32 : 16;  // degree 2's second block is not spread like the first
    alignas(64) float gradient[kRow];
    alignas(32) float share[8];
    const float* basis;
};

// Sums over a leaf's hits for its corners, one register of the row at a time: the eight sums stay in registers.
template <int B> void sum_pulls(const Pull<B>* pulls, int n, CornerRows<B>& to) {
    for (int at = 0; at < 16 * B; at += kWide) {
        fwide sum[8];
        each_corner([&](auto o) { sum[o] = splat<fwide>(0.0f); });
        for (int i = 0; i < n; ++i) {
            const Pull<B>& p = pulls[i];
            const fwide g = load<fwide>(p.gradient + at % Pull<B>::kRow) * load<fwide>(p.basis + at);
            each_corner([&](auto o) { sum[o] += p.share[o] * g; });
        }
        each_corner([&](auto o) { store(to.row[o] + at, sum[o]); });
    }
}

constexpr float kSparseKnee = 0.02f;     // e of the sparsity: a weight well above costs little more for growing

// dL/d(r, g, b, raw density) of one hit; all hits of its ray behind it come first.
inline f4 gradient_of_hit(const Hit& h, Adjoint& a, float per_length) {
    const int l = h.lane;
    const float w = h.weight;
    f4 c = h.value + 0.5f;
    c[3] = h.middle;
    const f4 product = a.colour[l] * c;
    float q = product[0] + product[1] + product[2] + product[3];
    f4 gradient = w * a.colour[l];
    if (a.colour_weight[l] > 0) {
        f4 away = {c[0] - a.target[l][0], c[1] - a.target[l][1], c[2] - a.target[l][2], 0};
        const f4 square = away * away;
        q += a.colour_weight[l] * (square[0] + square[1] + square[2]);
        gradient += 2 * a.colour_weight[l] * w * away;
    }
    if (a.distortion_weight[l] > 0) {
        const float m = h.middle;
        const float w_behind = a.weight_behind[l], m_behind = a.moment_behind[l];
        const float w_front = a.weight_sum[l] - w_behind - w, m_front = a.moment_sum[l] - m_behind - w * m;
        q += a.distortion_weight[l] * (2 * (m * (w_front - w_behind) - (m_front - m_behind)) +
                                       (2.0f / 3.0f) * w * h.length * per_length);
        a.weight_behind[l] = w_behind + w;
        a.moment_behind[l] = m_behind + w * m;
    }
    q += a.sparsity * a.ray_weight[l] / (kSparseKnee + w);
    gradient[3] = (h.trans_after * q - a.behind[l]) * h.tau_slope;
    a.behind[l] += w * q;
    return gradient;
}

// Back to front: the hits' gradients, added to the rows of their leaf's corners.
template <int B>
void backward_packet(const Tree& tree, const BasisRows<B>& basis, Workspace& work, Adjoint& a, VertexTable& table,
                     VertexGradients& gradients) {
    const float per_length = 1.0f / tree.size;
    const bool with_variation = a.tv_density > 0 || a.tv_sh > 0;
    for (int l = 0; l < kTile; ++l) a.weight_behind[l] = a.moment_behind[l] = 0;
    gradients.start(8 * work.visits.size(), 16 * B);
    table.start(8 * work.visits.size());
    Pull<B> pulls[kTile];
    CornerRows<B> rows;
    for (size_t v = work.visits.size(); v-- > 0;) {
        Visit& visit = work.visits[v];
        const Hit* hits = work.hits.get() + work.first_hit[v];
        float crossed = 0;                   // ways of the rays through the leaf, by their weights
        for (int i = 0; i < visit.n_hits; ++i) {
            const Hit& h = hits[i];
            const f4 gradient = gradient_of_hit(h, a, per_length);
            visit.error += h.weight * a.error[h.lane];
            crossed += a.ray_weight[h.lane] * h.length;
            Pull<B>& p = pulls[i];
            store(p.share, trilinear(h.fx, h.fy, h.fz));
            store(p.gradient, spread(gradient));
            if (B == 2) store(p.gradient + Pull<B>::kRow - 16, spread_three(gradient));
            p.basis = basis.row[h.lane];
        }
        sum_pulls<B>(pulls, visit.n_hits, rows);
        const int32_t* corners = tree.corners + 8 * int64_t(visit.leaf);
        if (with_variation) {
            const float sides = crossed * per_length / visit.side;
            add_variation<B>(tree, corners, a.tv_density * sides, a.tv_sh * sides, rows);
        }
        for (int o = 0; o < 8; ++o) table.add<B>(corners[o], rows.row[o], gradients);
    }
}

}  // namespace NERFVOL_ISA
