// Forward and adjoint over a batch of tiles, then the gradient's sum per vertex and the optimiser.
//
// Two phases, both parallel, neither with atomics. Phase 1 works tile by tile and leaves, for each hit, four numbers: the
// gradient of the field at that point. Phase 2 works range of vertices by range of vertices ("bucket"): one thread adds up
// all hits that touch its range in the order of the batch and applies the optimiser on the spot, while the sums lie in its
// own cache. The order of every sum is fixed by the batch, so the result is the same to the last bit for any number of
// threads.
#pragma once
#include <algorithm>
#include <memory>
#include <mutex>

#include "adjoint.h"

namespace NERFVOL_ISA {

using nerfvol::GradientSink;
using nerfvol::kBuckets;
using nerfvol::LeafStatistics;
using nerfvol::Optimizer;

// A visited leaf, for phase 2. Self-contained, so that phase 2 reads records in a row and nothing else of phase 1's.
struct LeafGradient {
    int32_t corners[8];
    int32_t leaf, n_points;
    float max_weight, error, near, side;
};

// What phase 1 leaves of one packet, grouped by bucket: a leaf whose corners lie in several stands in several groups. Kept
// between steps to spare the allocations.
struct PacketRecord {
    std::vector<LeafGradient> leaves;
    std::unique_ptr<PointGradient[]> points;
    size_t capacity = 0;
    int32_t first_leaf[kBuckets + 1], first_point[kBuckets + 1];
    alignas(64) float basis[kTile * 64];  // rows of BasisRows, 16 * B floats each
    StepReport report;
};

inline int bucket_shift(int64_t n_vertices) {
    int shift = 0;
    while (((n_vertices - 1) >> shift) >= kBuckets) ++shift;
    return shift;
}

// Copies visits and their gradients into the record, bucket by bucket, in the order of the walk within each.
inline void group_by_bucket(const Tree& tree, int shift, const Workspace& work, PacketRecord& rec) {
    std::memset(rec.first_leaf, 0, sizeof(rec.first_leaf));
    std::memset(rec.first_point, 0, sizeof(rec.first_point));
    const size_t n = work.visits.size();
    const auto distinct_buckets = [&](const int32_t* corners, int32_t* out) {
        int m = 0;
        for (int o = 0; o < 8; ++o) {
            const int32_t b = corners[o] >> shift;
            bool known = false;
            for (int j = 0; j < m; ++j) known |= out[j] == b;
            if (!known) out[m++] = b;
        }
        return m;
    };
    int32_t b[8];
    for (size_t v = 0; v < n; ++v)
        for (int j = distinct_buckets(tree.corners + 8 * int64_t(work.visits[v].leaf), b); j-- > 0;) {
            ++rec.first_leaf[b[j] + 1];
            rec.first_point[b[j] + 1] += work.visits[v].n_hits;
        }
    for (int k = 0; k < kBuckets; ++k) {
        rec.first_leaf[k + 1] += rec.first_leaf[k];
        rec.first_point[k + 1] += rec.first_point[k];
    }
    rec.leaves.resize(size_t(rec.first_leaf[kBuckets]));
    if (size_t(rec.first_point[kBuckets]) > rec.capacity) {
        rec.capacity = size_t(rec.first_point[kBuckets]) * 5 / 4;
        rec.points.reset(new PointGradient[rec.capacity]);
    }
    int32_t leaf_at[kBuckets], point_at[kBuckets];
    std::memcpy(leaf_at, rec.first_leaf, sizeof(leaf_at));
    std::memcpy(point_at, rec.first_point, sizeof(point_at));
    for (size_t v = 0; v < n; ++v) {
        const Visit& visit = work.visits[v];
        const int32_t* corners = tree.corners + 8 * int64_t(visit.leaf);
        LeafGradient out = {{}, visit.leaf, visit.n_hits, visit.max_weight, visit.error, visit.near, visit.side};
        std::memcpy(out.corners, corners, sizeof(out.corners));
        const PointGradient* points = work.points.get() + work.first_hit[v];
        const int m = distinct_buckets(corners, b);
        for (int j = 0; j < m; ++j) {
            rec.leaves[size_t(leaf_at[b[j]]++)] = out;
            std::copy(points, points + visit.n_hits, rec.points.get() + point_at[b[j]]);
            point_at[b[j]] += visit.n_hits;
        }
    }
}

// Gradient sums of the vertices in one bucket.
template <int B> struct Sums {
    std::vector<float> rows;
    std::vector<int32_t> touched;

    float* row(int32_t vertex, int32_t* slots) {
        int32_t& slot = slots[vertex];
        if (slot < 0) {
            slot = int32_t(touched.size());
            touched.push_back(vertex);
            rows.resize(rows.size() + 16 * B, 0.0f);
        }
        return rows.data() + size_t(slot) * 16 * B;
    }
};

template <int B>
void add_leaf(const LeafGradient& leaf, const PointGradient* h, const float* basis_rows, int bucket, int shift, int32_t* slots,
              Sums<B>& sums) {
    f16 corner[8][B];
    for (int o = 0; o < 8; ++o)
        for (int k = 0; k < B; ++k) corner[o][k] = f16{};
    for (int i = 0; i < leaf.n_points; ++i) {
        alignas(32) float w[8];
        store(w, trilinear(h[i].fx, h[i].fy, h[i].fz));
        keep_in_memory(w);
        const f4 v4 = h[i].value;
        const f16 g = __builtin_shufflevector(v4, v4, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
        const float* basis = basis_rows + 16 * B * h[i].lane;
        for (int k = 0; k < B; ++k) {
            f16 b = load<f16>(basis + 16 * k);
            f16 gk = g;
            if (B == 2 && k == 1) gk = __builtin_shufflevector(v4, v4, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 0, 1, 2, 3);
            gk *= b;
            for (int o = 0; o < 8; ++o) corner[o][k] += w[o] * gk;
        }
    }
    for (int o = 0; o < 8; ++o) {
        if (leaf.corners[o] >> shift != bucket) continue;
        float* row = sums.row(leaf.corners[o], slots);
        for (int k = 0; k < B; ++k) store(row + 16 * k, load<f16>(row + 16 * k) + corner[o][k]);
    }
}

template <int B> void apply(const GradientSink& sink, Sums<B>& sums) {
    const int n = int(sums.touched.size());
    const float dc = sink.optimizer ? sink.optimizer->rate_dc : 0, sh = sink.optimizer ? sink.optimizer->rate_sh : 0;
    const float density = sink.optimizer ? sink.optimizer->rate_density : 0;
    f16 rate[B];
    for (int k = 0; k < B; ++k) rate[k] = splat16(sh);
    rate[0] = f16{dc, sh, sh, sh, dc, sh, sh, sh, dc, sh, sh, sh, density, 0, 0, 0};
    for (int i = 0; i < n; ++i) {
        const int32_t vertex = sums.touched[size_t(i)];
        const int64_t at = 16 * B * int64_t(vertex);
        if (sink.optimizer && i + 8 < n) {
            const int64_t ahead = 16 * B * int64_t(sums.touched[size_t(i) + 8]);
            for (int k = 0; k < B; ++k) {
                __builtin_prefetch(sink.optimizer->moments + ahead + 16 * k, 1);
                __builtin_prefetch(sink.optimizer->values + ahead + 16 * k, 1);
            }
        }
        for (int k = 0; k < B; ++k) {
            const f16 g = load<f16>(sums.rows.data() + 16 * (size_t(i) * B + size_t(k)));
            if (sink.gradient) {
                store(sink.gradient + at + 16 * k, load<f16>(sink.gradient + at + 16 * k) + g);
                continue;
            }
            const Optimizer& opt = *sink.optimizer;
            float* moment = opt.moments + at + 16 * k;
            float* value = opt.values + at + 16 * k;
            const f16 old = load<f16>(moment), g2 = g * g;
            const f16 m = old > 0.0f ? old * opt.beta + g2 * (1 - opt.beta) : g2;
            alignas(64) float root[16];
            store(root, m);
            for (int j = 0; j < 16; ++j) root[j] = std::sqrt(root[j]) + opt.eps;
            store(moment, m);
            store(value, load<f16>(value) - rate[k] * g / load<f16>(root));
        }
        sink.slots[vertex] = -1;
    }
    sums.touched.clear();
    sums.rows.clear();
}

inline void add_statistics(const LeafGradient& leaf, const LeafStatistics& out, float pixel_angle) {
    float& w = out.max_weight[leaf.leaf];
    w = std::max(w, leaf.max_weight);
    out.error[leaf.leaf] += leaf.error;
    float& f = out.footprint[leaf.leaf];
    f = std::max(f, leaf.side / (std::max(leaf.near, 1e-6f) * pixel_angle));
}

template <int B>
StepReport backward_rays(const Tree& tree, const Rays& rays, const RenderOptions& options, const Cotangents* cotangents,
                         const Loss* loss, const GradientSink& sink, const LeafStatistics& statistics, float pixel_angle) {
    // Packets: runs of at most 64 rays from one origin.
    std::vector<std::pair<int64_t, int>> packets;
    for (int64_t i = 0; i < rays.n;) {
        const int64_t tile_end = std::min<int64_t>((i / kTile + 1) * kTile, rays.n);
        int64_t j = i + 1;
        if (rays.origin_per_tile) j = tile_end;
        else
            while (j < tile_end && !std::memcmp(rays.origins + 3 * j, rays.origins + 3 * i, 12)) ++j;
        packets.emplace_back(i, int(j - i));
        i = j;
    }
    static std::mutex one_call;
    const std::lock_guard<std::mutex> lock(one_call);
    static std::vector<std::unique_ptr<PacketRecord>> records;
    while (records.size() < packets.size()) records.emplace_back(new PacketRecord);
    const int n = int(packets.size()), shift = bucket_shift(tree.n_vertices);

    nerfvol::parallel_for(n, [&](int i, int) {
        PacketRecord& rec = *records[size_t(i)];
        const int64_t first = packets[size_t(i)].first;
        const int count = packets[size_t(i)].second;
        Packet p;
        load_packet(tree, rays, first, first + count, p);
        if (loss)
            for (int l = 0; l < count; ++l)
                if (!(loss->weight[first + l] > 0)) p.alive &= ~(1ull << l);
        if (loss) bound_packet(p);
        BasisRows<B> basis;
        basis.fill(p, tree.sh_degree);
        for (int l = 0; l < count; ++l) std::memcpy(rec.basis + 16 * B * l, basis.row[l], sizeof(basis.row[l]));
        PacketState state;
        static thread_local Workspace workspace;
        Workspace& work = workspace;
        forward_packet<B>(tree, p, basis, options.early_stop_eps, state, work);
        Adjoint adjoint;
        rec.report = {0, 0, double(work.size)};
        if (loss) adjoint_of_loss(*loss, state, first, count, adjoint, rec.report);
        else adjoint_of_cotangents(tree, *cotangents, options, state, first, count, adjoint);
        backward_packet(work, adjoint, 1.0f / tree.size);
        group_by_bucket(tree, shift, work, rec);
    });

    nerfvol::parallel_for(kBuckets, [&](int bucket, int) {
        static thread_local Sums<B> per_thread;
        Sums<B>& sums = per_thread;
        for (int i = 0; i < n; ++i) {
            const PacketRecord& rec = *records[size_t(i)];
            const PointGradient* points = rec.points.get() + rec.first_point[bucket];
            for (int32_t k = rec.first_leaf[bucket]; k < rec.first_leaf[bucket + 1]; ++k) {
                const LeafGradient& leaf = rec.leaves[size_t(k)];
                add_leaf<B>(leaf, points, rec.basis, bucket, shift, sink.slots, sums);
                points += leaf.n_points;
                if (statistics.max_weight && leaf.corners[0] >> shift == bucket) add_statistics(leaf, statistics, pixel_angle);
            }
        }
        apply<B>(sink, sums);
    });

    StepReport total{0, 0, 0};
    for (int i = 0; i < n; ++i) {
        total.squared_error += records[size_t(i)]->report.squared_error;
        total.weight += records[size_t(i)]->report.weight;
        total.samples += records[size_t(i)]->report.samples;
    }
    return total;
}

inline StepReport backward(const Tree& tree, const Rays& rays, const RenderOptions& options, const Cotangents* cotangents,
                           const Loss* loss, const GradientSink& sink, const LeafStatistics& statistics, float pixel_angle) {
    switch (tree.blocks) {
        case 1: return backward_rays<1>(tree, rays, options, cotangents, loss, sink, statistics, pixel_angle);
        case 2: return backward_rays<2>(tree, rays, options, cotangents, loss, sink, statistics, pixel_angle);
        default: return backward_rays<4>(tree, rays, options, cotangents, loss, sink, statistics, pixel_angle);
    }
}

}  // namespace NERFVOL_ISA
