// A training step: rays forwards and backwards, then the entries of the grid, each with the same sum for any number of threads.
//
// Rays are cut into a fixed number of ranges; each adds to a gradient of the network of its own, and those are summed in order.
// Positions and gradients of encodings are kept, and in a second pass a thread walks through all of them, in order, for one
// level of the grid (or a slice of it), and moves that level.
#pragma once
#include <memory>

#include "arena.h"
#include "field_adam.h"
#include "field_adjoint.h"
#include "pool.h"

namespace NERFVOL_ISA {
using nerfvol::FieldReport;
constexpr int kGroups = nerfvol::kFieldGroups;

// What a chunk of rays leaves to the second pass: packets of positions, and of gradients, level by level.
struct Left { const float *position, *gradient; int packets; };

struct Range { int64_t from, to; int chunk; };

// The ranges of rays, and the number of the first chunk of each.
inline std::vector<Range> ranges_of(int64_t n) {
    std::vector<Range> out;
    int chunk = 0;
    for (int64_t g = 0; g < kGroups; ++g) {
        out.push_back({n * g / kGroups, n * (g + 1) / kGroups, chunk});
        chunk += int((out.back().to - out.back().from + kRays - 1) / kRays);
    }
    out.push_back({n, n, chunk});
    return out;
}

inline Left leave(const Chunk& c, nerfvol::Arena& arena, float* gradient) {
    const std::size_t bytes = std::size_t(3 * c.samples) * sizeof(float);
    float* position = static_cast<float*>(arena.take(bytes));
    std::memcpy(position, c.position, bytes);
    return {position, gradient, c.samples / kLanes};
}

// A level, or the entries [from, to) of it, through all chunks.
inline void scatter_level(const FieldShape& f, int level, int64_t from, int64_t to, const std::vector<Left>& chunks, float* gradient) {
    const bool whole = from == 0 && to == f.start[level + 1] - f.start[level];
    with_features(f.features, [&](auto features) {
        constexpr int kRow = features * kLanes;
        Corners corners[2];  // the next packet's are found, and asked for, before this one's are written
        const float* waiting = nullptr;
        int turn = 0;
        for (const Left& c : chunks)
            for (int p = 0; p < c.packets; ++p) {
                const float* d = c.gradient + (int64_t(level) * c.packets + p) * kRow;
                uint32_t any = 0, bits[kRow];
                std::memcpy(bits, d, sizeof(bits));
                for (uint32_t b : bits) any |= b << 1;
                if (!any) continue;
                find_corners(f, level, c.position + p * 3 * kLanes, corners[turn]);
                prefetch<features>(corners[turn], gradient);
                turn ^= 1;
                if (waiting) scatter<features>(corners[turn], waiting, gradient, whole, from, to - from);
                waiting = d;
            }
        if (waiting) scatter<features>(corners[turn ^ 1], waiting, gradient, whole, from, to - from);
    });
}

struct FieldStep {
    const FieldShape& f;
    const FieldRays& rays;
    const FieldMarch& march;
    const FieldLoss& loss;
    const nerfvol::FieldRates& rates;
    const nerfvol::FieldMemory& memory;

    FieldStep(const FieldShape& shape, const FieldRays& given, const FieldMarch& where, const FieldLoss& terms, const nerfvol::FieldRates& adam_rates,
              const nerfvol::FieldMemory& arrays)
        : f(shape), rays(given), march(where), loss(terms), rates(adam_rates), memory(arrays) {}

    FieldReport run() {
        const Network net(f, memory.network, true);
        const Marcher marcher(f, march);
        nerfvol::Arenas arenas;
        const std::vector<Range> ranges = ranges_of(rays.n);
        const std::size_t chunks = std::size_t(ranges.back().chunk);
        left_.resize(chunks);
        losses_.resize(chunks);
        counts_.resize(2 * chunks);
        const int64_t floats = Layers::sums_floats(f);
        sums_.assign(std::size_t(kGroups), nullptr);
        std::vector<std::unique_ptr<Chunk>> of_thread(static_cast<std::size_t>(nerfvol::get_threads()));
        nerfvol::parallel_for(kGroups, [&](int g, int thread) {
            auto& chunk = of_thread[std::size_t(thread)];
            if (!chunk) chunk = std::make_unique<Chunk>(net, FieldParameters{memory.table, memory.network}, marcher, arenas.of_thread(thread), true);
            nerfvol::Arena& arena = arenas.of_thread(thread);
            float* sums = static_cast<float*>(arena.take(std::size_t(floats) * sizeof(float)));
            std::memset(sums, 0, std::size_t(floats) * sizeof(float));
            sums_[std::size_t(g)] = sums;
            const Range& range = ranges[std::size_t(g)];
            int number = range.chunk;
            for (int64_t from = range.from; from < range.to; from += kRays, ++number)
                one_chunk(*chunk, from, int(std::min<int64_t>(kRays, range.to - from)), std::size_t(number), arena, sums);
        });
        second_pass();
        FieldReport report;
        for (std::size_t c = 0; c < chunks; ++c) {
            report.squared_error += losses_[c].squared_error;
            report.loss += losses_[c].loss;
            report.samples += counts_[2 * c];
            report.used += counts_[2 * c + 1];
        }
        report.squared_error /= 3.0 * double(rays.n);
        return report;
    }

private:
    std::vector<Left> left_;
    std::vector<ChunkLoss> losses_;
    std::vector<int64_t> counts_;
    std::vector<float*> sums_;

    void one_chunk(Chunk& chunk, int64_t from, int count, std::size_t number, nerfvol::Arena& arena, float* sums) {
        thread_local SampleGradients gradients;
        chunk.forward(rays, from, count, loss.early_stop_eps);
        losses_[number] = adjoint(chunk, rays, from, loss, gradients);
        counts_[2 * number] = chunk.samples;
        counts_[2 * number + 1] = chunk.used;
        uint32_t seed = uint32_t(from);
        if (rays.jitter) std::memcpy(&seed, rays.jitter + from, 4);  // another one in each step
        drop_unused(chunk, gradients, loss.negligible, scrambled(seed));
        float* encoding = nullptr;
        if (f.hashed) encoding = static_cast<float*>(arena.take(std::size_t(chunk.samples) * std::size_t(f.encoded) * sizeof(float)));
        network_adjoint(chunk, gradients, sums, encoding);
        left_[number] = f.hashed ? leave(chunk, arena, encoding) : Left{nullptr, nullptr, 0};
    }

    void second_pass() {
        // With more threads than levels each level is cut, at bricks; finest levels, which take longest, go first.
        const int slices = f.active ? (nerfvol::get_threads() + f.active - 1) / f.active : 0;
        for (int l = 0; l < f.active && memory.moves; ++l) memory.updates[l] += memory.moves[l] ? 1 : 0;
        if (memory.moves) ++memory.updates[f.levels];
        nerfvol::parallel_for(f.active * slices + 1, [&](int task, int) {
            if (task == f.active * slices) return move_network();
            const int level = f.active - 1 - task / slices, slice = task % slices;
            const int64_t entries = f.start[level + 1] - f.start[level], bricks = (entries + nerfvol::kFieldBrick - 1) / nerfvol::kFieldBrick;
            const int64_t from = bricks * slice / slices * nerfvol::kFieldBrick, to = std::min(entries, bricks * (slice + 1) / slices * nerfvol::kFieldBrick);
            const int64_t first = f.start[level] * f.features;
            scatter_level(f, level, from, to, left_, memory.table_gradient + first);
            if (!memory.moves || !memory.moves[level]) return;
            const int64_t at = first + from * f.features;
            adam(memory.table + at, memory.table_first + at, memory.table_second + at, memory.table_gradient + at, (to - from) * f.features,
                 AdamStep(rates, rates.table_decay, memory.updates[level]));
        });
    }

    void move_network() {
        std::memset(memory.network_gradient, 0, std::size_t(f.n_network) * sizeof(float));
        for (const float* sums : sums_) add_sums(f, sums, memory.network_gradient);
        if (memory.moves)
            adam(memory.network, memory.network_first, memory.network_second, memory.network_gradient, f.n_network,
                 AdamStep(rates, rates.network_decay, memory.updates[f.levels]));
    }
};

inline FieldReport step_field(const FieldShape& f, const FieldRays& rays, const FieldMarch& march, const FieldLoss& loss, const nerfvol::FieldRates& rates,
                              const nerfvol::FieldMemory& memory) {
    return FieldStep(f, rays, march, loss, rates, memory).run();
}

}  // namespace NERFVOL_ISA
