// Forward and adjoint of one packet: its hits front to back, then their gradients back to front.
#pragma once
#include <algorithm>
#include <memory>
#include <new>

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

// Where each vertex stands in VertexGradients: open addressing in a table that cannot fill up, as a rule a quarter full since
// leaves share corners.
class VertexTable {
public:
    void start(size_t n) {  // n: an upper bound of the vertices
        bits_ = 6;
        while ((size_t(1) << bits_) <= n) ++bits_;
        entries_.assign(size_t(1) << bits_, {-1, 0});
    }
    template <int B> void add(int32_t vertex, const f16 (&gradient)[B], VertexGradients& gradients) {
        const size_t mask = entries_.size() - 1;
        for (size_t at = (uint32_t(vertex) * 2654435769u) >> (32 - bits_);; at = (at + 1) & mask) {
            Entry& e = entries_[at];
            if (e.vertex == vertex) {
                float* row = gradients.row(size_t(e.place));
                for (int k = 0; k < B; ++k) store(row + 16 * k, load<f16>(row + 16 * k) + gradient[k]);
                return;
            }
            if (e.vertex >= 0) continue;
            e = {vertex, int32_t(gradients.vertices.size())};
            float* row = gradients.append(vertex);
            for (int k = 0; k < B; ++k) store(row + 16 * k, gradient[k]);
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
    march<B>(tree, p, [&](const Leaf& leaf, const uint64_t* hits, const Segments* segments, const LeafField<B>& field) {
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
            f4 c = h[i].value + 0.5f;
            c[3] = h[i].middle;
            state.colour[l] += w * c;
            visit.max_weight = std::max(visit.max_weight, w);
            visit.near = std::min(visit.near, h[i].middle);
            if (h[i].trans_after < eps) p.strips[0].alive &= ~(1ull << l);
        }
        p.find_alive();
        work.visits.push_back(visit);
        work.first_hit.push_back(int32_t(base));
    });
}

// Per ray, what the adjoint needs beside the hits.
struct Adjoint {
    f4 colour[kTile];                      // dL/dC, and dL/d(expected distance in root cubes)
    float behind[kTile];                   // S: starts at T_N q_N
    float target[kTile][3], colour_weight[kTile], distortion_weight[kTile], error[kTile], ray_weight[kTile];
    float weight_sum[kTile], moment_sum[kTile];          // over all hits, for the distortion loss
    float weight_behind[kTile], moment_behind[kTile];
    float tv_density = 0, tv_sh = 0;
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

// Differences below these count by their squares, larger ones as they are: an edge of the scene is no worse than a slope.
constexpr float kKneeDensity = 1.0f, kKneeSh = 0.1f;

// Adds to the gradients of a leaf's corners that of their differences d along its edges, the sum of weight * (|d| - e log(1 +
// |d| / e)) over edges and numbers of a vertex row: a total variation [Plenoxels] that is smooth at zero.
template <int B> void add_variation(const Tree& tree, const int32_t* corners, float density, float colour, f16 (&gradient)[8][B]) {
    const f4 rgb = {colour, colour, colour, colour}, knee = {kKneeSh, kKneeSh, kKneeSh, kKneeSh};
    const f4 raw = {kKneeDensity, kKneeDensity, kKneeDensity, kKneeDensity};
    for (int k = 0; k < B; ++k) {
        const f16 weight = k == 0 ? join(rgb, rgb, rgb, f4{density, 0, 0, 0}) : splat16(colour);
        const f16 e = k == 0 ? join(knee, knee, knee, raw) : splat16(kKneeSh);
        f16 value[8];
        for (int o = 0; o < 8; ++o) value[o] = load<f16>(tree.values + 16 * (B * int64_t(corners[o]) + k));
        for (int axis = 1; axis < 8; axis *= 2)
            for (int o = 0; o < 8; ++o)
                if (o & axis) {
                    const f16 d = value[o] - value[o ^ axis], slope = weight * d / (e + vmax(d, -d));
                    gradient[o][k] += slope;
                    gradient[o ^ axis][k] -= slope;
                }
    }
}

// Back to front: dL/d(r, g, b, raw density) of each hit, added to the rows of its leaf's corners.
template <int B>
void backward_packet(const Tree& tree, const BasisRows<B>& basis, Workspace& work, Adjoint& a, VertexTable& table,
                     VertexGradients& gradients) {
    const float per_length = 1.0f / tree.size;
    const bool with_variation = a.tv_density > 0 || a.tv_sh > 0;
    for (int l = 0; l < kTile; ++l) a.weight_behind[l] = a.moment_behind[l] = 0;
    gradients.start(8 * work.visits.size(), 16 * B);
    table.start(8 * work.visits.size());
    for (size_t v = work.visits.size(); v-- > 0;) {
        Visit& visit = work.visits[v];
        const Hit* h = work.hits.get() + work.first_hit[v];
        f16 corner[8][B] = {};
        float crossed = 0;                   // ways of the rays through the leaf, by their weights
        for (int i = 0; i < visit.n_hits; ++i) {
            const int l = h[i].lane;
            const float w = h[i].weight;
            f4 c = h[i].value + 0.5f;
            c[3] = h[i].middle;
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
                const float m = h[i].middle;
                const float w_behind = a.weight_behind[l], m_behind = a.moment_behind[l];
                const float w_front = a.weight_sum[l] - w_behind - w, m_front = a.moment_sum[l] - m_behind - w * m;
                q += a.distortion_weight[l] * (2 * (m * (w_front - w_behind) - (m_front - m_behind)) +
                                               (2.0f / 3.0f) * w * h[i].length * per_length);
                a.weight_behind[l] = w_behind + w;
                a.moment_behind[l] = m_behind + w * m;
            }
            gradient[3] = (h[i].trans_after * q - a.behind[l]) * h[i].tau_slope;
            a.behind[l] += w * q;
            visit.error += w * a.error[l];
            crossed += a.ray_weight[l] * h[i].length;

            alignas(32) float share[8];
            store(share, trilinear(h[i].fx, h[i].fy, h[i].fz));
            keep_in_memory(share);
            const f16 g = spread(gradient);
            for (int k = 0; k < B; ++k) {
                const f16 gk = (B == 2 && k == 1 ? spread_three(gradient) : g) * load<f16>(basis.row[l] + 16 * k);
                for (int o = 0; o < 8; ++o) corner[o][k] += share[o] * gk;
            }
        }
        const int32_t* corners = tree.corners + 8 * int64_t(visit.leaf);
        if (with_variation) {
            const float sides = crossed * per_length / visit.side;
            add_variation<B>(tree, corners, a.tv_density * sides, a.tv_sh * sides, corner);
        }
        for (int o = 0; o < 8; ++o) table.add(corners[o], corner[o], gradients);
    }
}

}  // namespace NERFVOL_ISA
