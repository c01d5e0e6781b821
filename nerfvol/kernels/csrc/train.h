// Forward and adjoint over a batch of tiles, then the gradient's sum per vertex and the optimiser.
//
// Two phases, both parallel, neither with atomics. Phase 1 works tile by tile and leaves one row of gradients for each
// vertex that the tile touches. Phase 2 works range of vertices by range of vertices ("bucket"): one thread adds up the
// rows of its range in the order of the batch and applies the optimiser on the spot, while the sums lie in its own cache.
// The order of every sum is fixed by the batch, so the result is the same to the last bit for any number of threads.
#pragma once
#include <algorithm>

#include "adjoint.h"
#include "arena.h"

namespace NERFVOL_ISA {

using nerfvol::Arena;
using nerfvol::Arenas;
using nerfvol::GradientSink;
using nerfvol::kBuckets;
using nerfvol::LeafStatistics;
using nerfvol::Optimizer;

template <class T> T* take(Arena& arena, size_t n) { return static_cast<T*>(arena.take(n * sizeof(T))); }

// What phase 1 leaves of one packet, in an arena.
struct PacketRecord {
    const int32_t* vertices;              // of the rows of gradients: by bucket, and as they were met within each
    const float* rows;
    const Visit* visits;                  // by the bucket of the leaf's first corner
    int32_t first_row[kBuckets + 1], first_visit[kBuckets + 1];
    StepReport report;
};

inline int bucket_shift(int64_t n_vertices) {
    int shift = 0;
    while (((n_vertices - 1) >> shift) >= kBuckets) ++shift;
    return shift;
}

// Stable counting sort of n items into buckets: first[b] is where bucket b begins; place(from, to) moves one.
template <class BucketOf, class Place> void sort_by_bucket(size_t n, int32_t* first, BucketOf bucket_of, Place place) {
    std::memset(first, 0, (kBuckets + 1) * sizeof(int32_t));
    for (size_t i = 0; i < n; ++i) ++first[bucket_of(i) + 1];
    for (int b = 0; b < kBuckets; ++b) first[b + 1] += first[b];
    int32_t at[kBuckets];
    std::memcpy(at, first, sizeof(at));
    for (size_t i = 0; i < n; ++i) place(i, size_t(at[bucket_of(i)]++));
}

template <int B> void group_rows(int shift, const VertexGradients& gradients, Arena& arena, PacketRecord& rec) {
    const std::vector<int32_t>& met = gradients.vertices;
    int32_t* vertices = take<int32_t>(arena, met.size());
    float* rows = take<float>(arena, 16 * B * met.size());
    sort_by_bucket(met.size(), rec.first_row, [&](size_t i) { return met[i] >> shift; }, [&](size_t i, size_t to) {
        vertices[to] = met[i];
        for (int k = 0; k < B; ++k) store(rows + 16 * (B * to + k), load<f16>(gradients.row(i) + 16 * k));
    });
    rec.vertices = vertices;
    rec.rows = rows;
}

inline void group_visits(const Tree& tree, int shift, const std::vector<Visit>& visits, Arena& arena, PacketRecord& rec) {
    Visit* by_bucket = take<Visit>(arena, visits.size());
    sort_by_bucket(visits.size(), rec.first_visit, [&](size_t i) { return tree.corners[8 * int64_t(visits[i].leaf)] >> shift; },
                   [&](size_t i, size_t to) { by_bucket[to] = visits[i]; });
    rec.visits = by_bucket;
}

// Adds a packet's gradients of the vertices in one bucket to the bucket's sums; slots has the place of each vertex there.
template <int B> void add_rows(const PacketRecord& rec, int bucket, int32_t* slots, VertexGradients& sums) {
    for (int32_t i = rec.first_row[bucket]; i < rec.first_row[bucket + 1]; ++i) {
        const float* row = rec.rows + 16 * B * size_t(i);
        int32_t& slot = slots[rec.vertices[i]];
        if (slot < 0) {
            slot = int32_t(sums.vertices.size());
            float* sum = sums.append(rec.vertices[i]);
            for (int k = 0; k < B; ++k) store(sum + 16 * k, load<f16>(row + 16 * k));
        } else {
            float* sum = sums.row(size_t(slot));
            for (int k = 0; k < B; ++k) store(sum + 16 * k, load<f16>(sum + 16 * k) + load<f16>(row + 16 * k));
        }
    }
}

// Asks for what add_rows will read; the rows' vertices were asked for before.
template <int B> void prefetch_rows(const PacketRecord& rec, int bucket, const int32_t* slots) {
    for (int32_t i = rec.first_row[bucket]; i < rec.first_row[bucket + 1]; ++i) {
        for (int k = 0; k < B; ++k) __builtin_prefetch(rec.rows + 16 * (B * size_t(i) + size_t(k)));
        __builtin_prefetch(slots + rec.vertices[i], 1);
    }
}

template <int B> void apply(const GradientSink& sink, const VertexGradients& sums) {
    const size_t n = sums.vertices.size();
    const nerfvol::Rates rates = sink.optimizer ? sink.optimizer->rates : nerfvol::Rates{};
    f16 rate[B];
    for (int k = 0; k < B; ++k) rate[k] = splat16(rates.sh);
    const f4 channel = {rates.dc, rates.sh, rates.sh, rates.sh};
    rate[0] = join(channel, channel, channel, f4{rates.density, 0, 0, 0});
    for (size_t i = 0; i < n; ++i) {
        const int32_t vertex = sums.vertices[i];
        const int64_t at = 16 * B * int64_t(vertex);
        if (sink.optimizer && i + 8 < n) {
            const int64_t ahead = 16 * B * int64_t(sums.vertices[i + 8]);
            for (int k = 0; k < B; ++k) {
                __builtin_prefetch(sink.optimizer->moments + ahead + 16 * k, 1);
                __builtin_prefetch(sink.optimizer->values + ahead + 16 * k, 1);
            }
        }
        for (int k = 0; k < B; ++k) {
            const f16 g = load<f16>(sums.row(i) + 16 * k);
            if (sink.gradient) {
                store(sink.gradient + at + 16 * k, load<f16>(sink.gradient + at + 16 * k) + g);
                continue;
            }
            const Optimizer& opt = *sink.optimizer;
            float* moment = opt.moments + at + 16 * k;
            float* value = opt.values + at + 16 * k;
            const f16 old = load<f16>(moment), g2 = g * g;
            const f16 m = select_less(-old, 0.0f, old * rates.beta + g2 * (1 - rates.beta), g2);
            alignas(64) float root[16];
            store(root, m);
            for (int j = 0; j < 16; ++j) root[j] = std::sqrt(root[j]) + rates.eps;
            store(moment, m);
            store(value, load<f16>(value) - rate[k] * g / load<f16>(root));
        }
        sink.slots[vertex] = -1;
    }
}

inline void add_statistics(const PacketRecord& rec, int bucket, const LeafStatistics& out) {
    for (int32_t k = rec.first_visit[bucket]; k < rec.first_visit[bucket + 1]; ++k) {
        const Visit& leaf = rec.visits[size_t(k)];
        float& w = out.max_weight[leaf.leaf];
        w = std::max(w, leaf.max_weight);
        out.error[leaf.leaf] += leaf.error;
        float& f = out.footprint[leaf.leaf];
        f = std::max(f, leaf.side / (std::max(leaf.near, 1e-6f) * out.pixel_angle));
    }
}

// A run of at most 64 rays from one origin.
struct Run { int64_t first; int n; };

inline std::vector<Run> runs_of(const Rays& rays) {
    std::vector<Run> runs;
    for (int64_t i = 0; i < rays.n;) {
        const int64_t tile_end = std::min<int64_t>((i / kTile + 1) * kTile, rays.n);
        int64_t j = i + 1;
        if (rays.origin_per_tile) j = tile_end;
        else
            while (j < tile_end && !std::memcmp(rays.origins + 3 * j, rays.origins + 3 * i, 12)) ++j;
        runs.push_back({i, int(j - i)});
        i = j;
    }
    return runs;
}

// What is asked of a batch: an adjoint of the cotangents or, where there is one, of the loss. statistics: null arrays, none.
struct Batch {
    const Tree& tree;
    const Rays& rays;
    const RenderOptions& options;
    const Cotangents* cotangents;
    const Loss* loss;
    const LeafStatistics& statistics;
};

// What a thread uses for one packet or bucket and keeps for the next: one for all degrees.
struct Scratch {
    Workspace work;
    VertexTable table;
    VertexGradients gradients;
};

inline Scratch& scratch() {
    static thread_local Scratch of_thread;
    return of_thread;
}

// Loads the rays of a run and marches them; rays of weight 0 are not walked.
template <int B> void forward_run(const Batch& batch, Run run, BasisRows<B>& basis, PacketState<1>& state, Workspace& work) {
    Packet<1> p;
    load_packet(batch.tree, batch.rays, run.first, run.first + run.n, p);
    if (batch.loss) {
        uint64_t& alive = p.strips[0].alive;
        const uint64_t all = alive;
        for (int l = 0; l < run.n; ++l)
            if (!(batch.loss->weight[run.first + l] > 0)) alive &= ~(1ull << l);
        if (alive != all) bound_packet(p);  // without the padding the pyramid is tighter
    }
    basis.fill(p.strips[0], batch.tree.sh_degree);
    forward_packet<B>(batch.tree, p, basis, batch.options.early_stop_eps, state, work);
}

// Phase 1 of one packet: its record, in the arena.
template <int B> void backward_run(const Batch& batch, Run run, int shift, Arena& arena, PacketRecord& rec) {
    Scratch& mine = scratch();
    BasisRows<B> basis;
    PacketState<1> state;
    forward_run<B>(batch, run, basis, state, mine.work);
    Adjoint adjoint;
    rec.report = {0, 0, double(mine.work.size), double(mine.work.tested)};
    if (batch.loss) adjoint_of_loss(*batch.loss, state, run.first, run.n, adjoint, rec.report);
    else adjoint_of_cotangents(batch.tree, *batch.cotangents, batch.options, state, run.first, run.n, adjoint);
    backward_packet<B>(batch.tree, basis, mine.work, adjoint, mine.table, mine.gradients);
    group_rows<B>(shift, mine.gradients, arena, rec);
    if (!batch.statistics.max_weight) mine.work.visits.clear();
    group_visits(batch.tree, shift, mine.work.visits, arena, rec);
}

// The same where only the leaves' statistics are asked for: no rows.
template <int B> void observe_run(const Batch& batch, Run run, int shift, Arena& arena, PacketRecord& rec) {
    Workspace& work = scratch().work;
    BasisRows<B> basis;
    PacketState<1> state;
    forward_run<B>(batch, run, basis, state, work);
    Adjoint adjoint;
    rec.report = {0, 0, double(work.size), double(work.tested)};
    adjoint_of_loss(*batch.loss, state, run.first, run.n, adjoint, rec.report);
    for (size_t v = 0; v < work.visits.size(); ++v) {
        const Hit* h = work.hits.get() + work.first_hit[v];
        for (int i = 0; i < work.visits[v].n_hits; ++i) work.visits[v].error += h[i].weight * adjoint.error[h[i].lane];
    }
    group_visits(batch.tree, shift, work.visits, arena, rec);
}

inline StepReport total_of(const PacketRecord* records, size_t n) {
    StepReport total{0, 0, 0, 0};
    for (size_t i = 0; i < n; ++i) {
        total.squared_error += records[i].report.squared_error;
        total.weight += records[i].report.weight;
        total.samples += records[i].report.samples;
        total.tested += records[i].report.tested;
    }
    return total;
}

template <int B> StepReport backward_rays(const Batch& batch, const GradientSink& sink) {
    const std::vector<Run> runs = runs_of(batch.rays);
    const int n = int(runs.size()), shift = bucket_shift(batch.tree.n_vertices);
    Arenas arenas;
    PacketRecord* records = take<PacketRecord>(arenas.of_thread(0), runs.size());
    nerfvol::parallel_for(n, [&](int i, int thread) {
        backward_run<B>(batch, runs[size_t(i)], shift, arenas.of_thread(thread), records[i]);
    });
    nerfvol::parallel_for(kBuckets, [&](int bucket, int) {
        VertexGradients& sums = scratch().gradients;
        sums.start(size_t(1) << shift, 16 * B);
        for (int i = 0; i < n; ++i) {
            if (i + 2 < n) __builtin_prefetch(records[i + 2].vertices + records[i + 2].first_row[bucket]);
            if (i + 1 < n) prefetch_rows<B>(records[i + 1], bucket, sink.slots);
            add_rows<B>(records[i], bucket, sink.slots, sums);
            add_statistics(records[i], bucket, batch.statistics);
        }
        apply<B>(sink, sums);
    });
    return total_of(records, runs.size());
}

template <int B> StepReport observe_rays(const Batch& batch) {
    const std::vector<Run> runs = runs_of(batch.rays);
    const int n = int(runs.size()), shift = bucket_shift(batch.tree.n_vertices);
    Arenas arenas;
    PacketRecord* records = take<PacketRecord>(arenas.of_thread(0), runs.size());
    nerfvol::parallel_for(n, [&](int i, int thread) {
        observe_run<B>(batch, runs[size_t(i)], shift, arenas.of_thread(thread), records[i]);
    });
    nerfvol::parallel_for(kBuckets, [&](int bucket, int) {
        for (int i = 0; i < n; ++i) add_statistics(records[i], bucket, batch.statistics);
    });
    return total_of(records, runs.size());
}

inline StepReport backward_batch(const Batch& batch, const GradientSink& sink) {
    switch (batch.tree.blocks) {
        case 1: return backward_rays<1>(batch, sink);
        case 2: return backward_rays<2>(batch, sink);
        default: return backward_rays<4>(batch, sink);
    }
}

inline void backward(const Tree& tree, const Rays& rays, const RenderOptions& options, const Cotangents& cotangents,
                     const GradientSink& sink) {
    backward_batch({tree, rays, options, &cotangents, nullptr, LeafStatistics{}}, sink);
}

inline StepReport train_step(const Tree& tree, const Rays& rays, const Loss& loss, const GradientSink& sink,
                             const LeafStatistics& statistics) {
    return backward_batch({tree, rays, loss.options, nullptr, &loss, statistics}, sink);
}

inline StepReport leaf_statistics(const Tree& tree, const Rays& rays, const Loss& loss, const LeafStatistics& statistics) {
    const Batch batch{tree, rays, loss.options, nullptr, &loss, statistics};
    switch (tree.blocks) {
        case 1: return observe_rays<1>(batch);
        case 2: return observe_rays<2>(batch);
        default: return observe_rays<4>(batch);
    }
}

}  // namespace NERFVOL_ISA
