// Forward and adjoint over a batch of tiles, then the gradient's sum per vertex and the optimiser.
//
// Two phases, both parallel, neither with atomics. Phase 1 works tile by tile and leaves one row of gradients for each
// vertex that the tile touches. Phase 2 works range of vertices by range of vertices ("bucket"): one thread adds up the
// rows of its range in the order of the batch and applies the optimiser on the spot, while the sums lie in its own cache.
// The order of every sum is fixed by the batch, so the result is the same to the last bit for any number of threads.
#pragma once
#include <algorithm>
#include <deque>
#include <memory>
#include <mutex>

#include "adjoint.h"

namespace NERFVOL_ISA {

using nerfvol::GradientSink;
using nerfvol::kBuckets;
using nerfvol::LeafStatistics;
using nerfvol::Optimizer;

// Memory that is taken piece by piece and given back all at once: what one thread's packets leave to phase 2. Kept between
// steps, it is as large as the largest step was; had each packet memory of its own, that would be as large as its largest.
class Arena {
public:
    template <class T> T* take(size_t n) {
        const size_t bytes = (n * sizeof(T) + 63) & ~size_t(63);
        while (block_ < blocks_.size() && used_ + bytes > blocks_[block_].size) { ++block_; used_ = 0; }
        if (block_ == blocks_.size()) blocks_.emplace_back(std::max(bytes, kBlock));
        used_ += bytes;
        return reinterpret_cast<T*>(blocks_[block_].bytes.get() + used_ - bytes);
    }
    void clear() { block_ = used_ = 0; }

private:
    static constexpr size_t kBlock = size_t(4) << 20;
    struct Block {
        explicit Block(size_t n) : bytes(new (std::align_val_t{64}) char[n]), size(n) {}
        struct Free {
            void operator()(char* p) const { ::operator delete[](p, std::align_val_t{64}); }
        };
        std::unique_ptr<char[], Free> bytes;
        size_t size;
    };
    std::vector<Block> blocks_;
    size_t block_ = 0, used_ = 0;  // where the next piece begins
};

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

template <int B>
void group_by_bucket(const Tree& tree, int shift, const VertexGradients& gradients, const std::vector<Visit>& visits, Arena& arena,
                     PacketRecord& rec) {
    const std::vector<int32_t>& met = gradients.vertices;
    int32_t* vertices = arena.take<int32_t>(met.size());
    float* rows = arena.take<float>(16 * B * met.size());
    sort_by_bucket(met.size(), rec.first_row, [&](size_t i) { return met[i] >> shift; }, [&](size_t i, size_t to) {
        vertices[to] = met[i];
        for (int k = 0; k < B; ++k) store(rows + 16 * (B * to + k), load<f16>(gradients.row(i) + 16 * k));
    });
    Visit* by_bucket = arena.take<Visit>(visits.size());
    sort_by_bucket(visits.size(), rec.first_visit, [&](size_t i) { return tree.corners[8 * int64_t(visits[i].leaf)] >> shift; },
                   [&](size_t i, size_t to) { by_bucket[to] = visits[i]; });
    rec.vertices = vertices;
    rec.rows = rows;
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
    const float dc = sink.optimizer ? sink.optimizer->rate_dc : 0, sh = sink.optimizer ? sink.optimizer->rate_sh : 0;
    const float density = sink.optimizer ? sink.optimizer->rate_density : 0;
    f16 rate[B];
    for (int k = 0; k < B; ++k) rate[k] = splat16(sh);
    const f4 channel = {dc, sh, sh, sh};
    rate[0] = join(channel, channel, channel, f4{density, 0, 0, 0});
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
            const f16 m = select_less(-old, 0.0f, old * opt.beta + g2 * (1 - opt.beta), g2);
            alignas(64) float root[16];
            store(root, m);
            for (int j = 0; j < 16; ++j) root[j] = std::sqrt(root[j]) + opt.eps;
            store(moment, m);
            store(value, load<f16>(value) - rate[k] * g / load<f16>(root));
        }
        sink.slots[vertex] = -1;
    }
}

inline void add_statistics(const Visit& leaf, const LeafStatistics& out, float pixel_angle) {
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
    static std::deque<Arena> arenas;  // of the threads
    static std::mutex growing;
    for (Arena& arena : arenas) arena.clear();
    const auto arena_of = [](int thread) -> Arena& {
        const std::lock_guard<std::mutex> lock(growing);
        while (arenas.size() <= size_t(thread)) arenas.emplace_back();
        return arenas[size_t(thread)];
    };
    static std::vector<PacketRecord> records;
    records.resize(packets.size());
    const int n = int(packets.size()), shift = bucket_shift(tree.n_vertices);

    nerfvol::parallel_for(n, [&](int i, int thread) {
        PacketRecord& rec = records[size_t(i)];
        const int64_t first = packets[size_t(i)].first;
        const int count = packets[size_t(i)].second;
        Packet<1> p;
        load_packet(tree, rays, first, first + count, p);
        if (loss) {
            uint64_t& alive = p.strips[0].alive;
            const uint64_t all = alive;
            for (int l = 0; l < count; ++l)
                if (!(loss->weight[first + l] > 0)) alive &= ~(1ull << l);
            if (alive != all) bound_packet(p);  // without the padding the pyramid is tighter
        }
        BasisRows<B> basis;
        basis.fill(p.strips[0], tree.sh_degree);
        PacketState<1> state;
        static thread_local Workspace workspace;
        Workspace& work = workspace;
        forward_packet<B>(tree, p, basis, options.early_stop_eps, state, work);
        Adjoint adjoint;
        rec.report = {0, 0, double(work.size)};
        if (loss) adjoint_of_loss(*loss, state, first, count, adjoint, rec.report);
        else adjoint_of_cotangents(tree, *cotangents, options, state, first, count, adjoint);
        static thread_local VertexTable table;
        static thread_local VertexGradients of_packet;
        VertexGradients& gradients = of_packet;
        backward_packet<B>(tree, basis, work, adjoint, table, gradients);
        if (!statistics.max_weight) work.visits.clear();
        group_by_bucket<B>(tree, shift, gradients, work.visits, arena_of(thread), rec);
    });

    nerfvol::parallel_for(kBuckets, [&](int bucket, int) {
        static thread_local VertexGradients per_thread;
        VertexGradients& sums = per_thread;
        sums.start(size_t(1) << shift, 16 * B);
        for (int i = 0; i < n; ++i) {
            const PacketRecord& rec = records[size_t(i)];
            if (i + 2 < n) __builtin_prefetch(records[size_t(i + 2)].vertices + records[size_t(i + 2)].first_row[bucket]);
            if (i + 1 < n) prefetch_rows<B>(records[size_t(i + 1)], bucket, sink.slots);
            add_rows<B>(rec, bucket, sink.slots, sums);
            for (int32_t k = rec.first_visit[bucket]; k < rec.first_visit[bucket + 1]; ++k)
                add_statistics(rec.visits[size_t(k)], statistics, pixel_angle);
        }
        apply<B>(sink, sums);
    });

    StepReport total{0, 0, 0};
    for (int i = 0; i < n; ++i) {
        total.squared_error += records[size_t(i)].report.squared_error;
        total.weight += records[size_t(i)].report.weight;
        total.samples += records[size_t(i)].report.samples;
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
