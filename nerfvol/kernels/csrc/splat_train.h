// A training step: lists, tiles, then each Gaussian adds its own lines, follows the chain rule and takes an Adam step on the spot.
//
// Tiles leave lines in slots that lie together for each Gaussian, and every sum has an order fixed by the picture, so the result
// has the same bits for any number of threads. There are no atomics and no array of gradients.
#pragma once
#include <array>
#include <cmath>
#include <deque>

#include "splat_chain.h"
#include "splat_tile.h"

namespace NERFVOL_ISA {

using nerfvol::SplatMemory;
using nerfvol::SplatRates;
using nerfvol::SplatReport;

struct StepSetting {
    const Splats& splats;
    const SplatView& view;
    const SplatLoss& loss;
    const SplatRates& rates;
    const SplatMemory& memory;
    float per_pixel = 0;                     // one over the sum of the pixels' weights
};

// The sums of a block's sixteen Gaussians; bits of those that have any.
inline uint32_t gather_lines(const Frame& f, const StepLines& lines, int64_t block, float (&rows)[16][16]) {
    uint32_t hit = 0;
    for (int lane = 0; lane < 16; ++lane) {
        const Place place = f.places[size_t(16 * block + lane)];
        f16 sum = splat16(0);
        float largest = 0;
        for (uint32_t k = 0; k < place.count; ++k) {
            const size_t slot = size_t(place.first) + k;
            if (!lines.left[slot]) continue;
            sum += load<f16>(lines.lines[slot].sums);
            largest = std::max(largest, lines.lines[slot].sums[kMaxWeight]);
            hit |= 1u << lane;
        }
        store(rows[lane], sum);
        rows[lane][kMaxWeight] = largest;
    }
    return hit;
}

inline f16 column(const float (&rows)[16][16], int k) {
    alignas(64) float out[16];
    for (int lane = 0; lane < 16; ++lane) out[lane] = rows[lane][k];
    return load<f16>(out);
}

inline void add_statistics(const Frame& f, const float (&rows)[16][16], int64_t block, const SplatMemory& memory) {
    float *error = memory.error + 16 * block, *largest = memory.max_weight + 16 * block, *seen = memory.seen + 16 * block;
    for (int lane = 0; lane < 16; ++lane) {
        error[lane] += rows[lane][kWe];
        largest[lane] = std::max(largest[lane], rows[lane][kMaxWeight]);
        seen[lane] += f.places[size_t(16 * block + lane)].count ? 1.0f : 0.0f;
    }
}

// Adam on one row of a block; lanes that were not hit keep value and moments.
struct Adam {
    f16 hit, correction1, correction2;       // 1 or 0; one over 1 - beta^n
    const SplatRates& rates;

    Adam(const SplatRates& r, const f16& lanes, float* updates) : hit(lanes), rates(r) {
        const f16 n = load<f16>(updates) + hit;
        store(updates, n);
        correction1 = 1.0f / vmax(left_over(n, r.beta1), splat16(1e-12f));
        correction2 = 1.0f / vmax(left_over(n, r.beta2), splat16(1e-12f));
    }
    static f16 left_over(const f16& n, float beta) {
        const f16 x = n * -std::log(beta);
        return one_minus_exp(x, vexp(-x));
    }
    void apply(const f16& g, const f16& rate, float* value, float* first, float* second) const {
        const f16 m = load<f16>(first), v = load<f16>(second);
        const f16 m1 = m + (g - m) * (1 - rates.beta1), v1 = v + (g * g - v) * (1 - rates.beta2);
        const f16 step = rate * m1 * correction1 / (vsqrt(v1 * correction2) + rates.eps);
        store(first, select_less(hit, 0.5f, m, m1));
        store(second, select_less(hit, 0.5f, v, v1));
        const f16 x = load<f16>(value);
        store(value, select_less(hit, 0.5f, x, x - step));
    }
};

// No needles: a longest scale is at most `most` above the second, as logarithms. Where a Gaussian was not hit it stays.
inline void blunt(float* scales, const f16& hit, float most) {
    const f16 a = load<f16>(scales), b = load<f16>(scales + 16), c = load<f16>(scales + 32);
    const f16 limit = vmax(vmin(a, b), vmin(vmax(a, b), c)) + most;  // the second is the middle one
    for (int k = 0; k < 3; ++k) {
        const f16 s = load<f16>(scales + 16 * k);
        store(scales + 16 * k, select_less(hit, 0.5f, s, vmin(s, limit)));
    }
}

template <int K> void update_block(const StepSetting& set, int64_t block, const f16& hit, const f16* gradient) {
    constexpr int kRows = nerfvol::kSh + 3 * K;
    const SplatMemory& m = set.memory;
    const int64_t at = block * kRows * 16;
    const float* p = m.params + at;
    const SplatRates& r = set.rates;
    const Adam adam(r, hit, m.updates + 16 * block);
    const f16 size = vexp((load<f16>(p + 48) + load<f16>(p + 64) + load<f16>(p + 80)) * (1.0f / 3));
    for (int row = 0; row < kRows; ++row) {
        const float rate = row < nerfvol::kLogScale ? r.means : row < nerfvol::kQuat ? r.log_scales : row < nerfvol::kLogit ? r.quats
                         : row < nerfvol::kSh ? r.logits : (row - nerfvol::kSh) % K ? r.sh : r.dc;
        const int64_t i = at + 16 * row;
        adam.apply(gradient[row], row < nerfvol::kLogScale ? size * rate : splat16(rate), m.params + i, m.first + i, m.second + i);
    }
    if (r.most_log_ratio > 0) blunt(m.params + at + 16 * nerfvol::kLogScale, hit, r.most_log_ratio);
}

// Adds the motion's gradient of the lanes that were hit, in one order.
inline void add_motion(const f16& lanes, const f16 (&gradient)[6], double (&motion)[6]) {
    alignas(64) float parts[16];
    for (int k = 0; k < 6; ++k) {
        store(parts, select_less(lanes, 0.5f, splat16(0), gradient[k]));
        for (int lane = 0; lane < 16; ++lane) motion[k] += double(parts[lane]);
    }
}

template <int K>
void finish_block(const StepSetting& set, const Frame& f, const StepLines& lines, int64_t block, double (&motion)[6]) {
    constexpr int kRows = nerfvol::kSh + 3 * K;
    alignas(64) float rows[16][16], hits[16];
    const uint32_t hit = gather_lines(f, lines, block, rows);
    const SplatMemory& memory = set.memory;
    if (!memory.gradient) add_statistics(f, rows, block, memory);
    if (!hit) return;
    const float s = set.per_pixel;
    const GaussianSums sums = {column(rows, kH) * s, column(rows, kHx) * s, column(rows, kHy) * s, column(rows, kHxx) * s,
                               column(rows, kHxy) * s, column(rows, kHyy) * s,
                               {column(rows, kWg) * s, column(rows, kWg + 1) * s, column(rows, kWg + 2) * s}, splat16(0)};
    const float* p = set.splats.params + block * kRows * 16;
    f16 gradient[kRows], moved[6];
    chain_block<K>(p, set.view, set.splats.mip, sums, gradient, memory.motion ? moved : nullptr);
    const float per_gaussian = 1.0f / float(std::max<int64_t>(set.splats.n, 1));
    for (int j = nerfvol::kLogScale; j < nerfvol::kQuat; ++j)
        gradient[j] += vexp(load<f16>(p + 16 * j)) * (set.loss.scale * per_gaussian);
    const f16 o = 1.0f / (1.0f + vexp(-load<f16>(p + 16 * nerfvol::kLogit)));
    gradient[nerfvol::kLogit] += o * (1.0f - o) * (set.loss.opacity * per_gaussian);
    for (int lane = 0; lane < 16; ++lane) hits[lane] = float(hit >> lane & 1);
    const f16 lanes = load<f16>(hits);
    if (memory.motion) add_motion(lanes, moved, motion);
    if (!memory.gradient) return update_block<K>(set, block, lanes, gradient);
    for (int row = 0; row < kRows; ++row)
        store(memory.gradient + (block * kRows + row) * 16, select_less(lanes, 0.5f, splat16(0), gradient[row]));
}

// What steps keep of their memory, beside the frame.
struct StepMemory {
    StepLines lines;
    std::deque<TileWork> work;               // of each thread
    std::mutex growing;
    std::vector<LossSums> tiles;
    std::vector<int64_t> blocks;
    std::vector<std::array<double, 6>> motions;   // of each chunk

    TileWork& of(int thread) {
        const std::lock_guard<std::mutex> lock(growing);
        while (work.size() <= size_t(thread)) work.emplace_back();
        return work[size_t(thread)];
    }
};

inline SplatReport train_tiles(const Frame& f, const SplatView& view, const SplatImage& image, const SplatLoss& loss, StepMemory& m) {
    const int64_t tiles = TileGrid(view).size(), slots = int64_t(f.first_entry.back());
    m.lines.lines.need(size_t(slots));
    std::memset(m.lines.left.need(size_t(slots)), 0, size_t(slots));
    m.tiles.resize(size_t(tiles));
    m.blocks.resize(size_t(tiles));
    splat_for(tiles, [&](int tile, int thread) {
        TileWork& work = m.of(thread);
        work.n_blocks = 0;
        train_tile(f, view, tile, image, loss, m.lines, work);
        m.tiles[size_t(tile)] = work.sums;
        m.blocks[size_t(tile)] = int64_t(work.n_blocks);
    });
    SplatReport r{0, 0, 0, f.visible, slots, 0, {}};
    for (size_t t = 0; t < size_t(tiles); ++t) {
        r.loss += m.tiles[t].loss;
        r.squared_error += m.tiles[t].squared;
        r.pixels += m.tiles[t].weight;
        r.blocks += m.blocks[t];
    }
    const double per_pixel = r.pixels > 0 ? 1 / r.pixels : 0;
    r.loss *= per_pixel;
    r.squared_error *= per_pixel;
    return r;
}

template <int K>
SplatReport step_basis(const Splats& splats, const SplatView& view, const SplatImage& image, const SplatLoss& loss,
                       const SplatRates& rates, const SplatMemory& memory) {
    static StepMemory kept;
    Frame& frame = shared_frame();
    prepare_frame<K>(splats, view, frame, false);
    SplatReport report = train_tiles(frame, view, image, loss, kept);
    const StepSetting set{splats, view, loss, rates, memory, report.pixels > 0 ? float(1 / report.pixels) : 0.0f};
    const int64_t chunks = (splats.n_blocks + kChunk - 1) / kChunk;
    kept.motions.resize(size_t(chunks));
    splat_for(chunks, [&](int chunk, int) {
        const int64_t last = std::min((int64_t(chunk) + 1) * kChunk, splats.n_blocks);
        double motion[6] = {};
        for (int64_t b = int64_t(chunk) * kChunk; b < last; ++b) finish_block<K>(set, frame, kept.lines, b, motion);
        std::copy_n(motion, 6, kept.motions[size_t(chunk)].begin());
    });
    for (const auto& motion : kept.motions)
        for (size_t k = 0; k < 6; ++k) report.motion[k] += motion[k];
    return report;
}

inline SplatReport step_splats(const Splats& splats, const SplatView& view, const SplatImage& image, const SplatLoss& loss,
                               const SplatRates& rates, const SplatMemory& memory) {
    const std::lock_guard<nerfvol::Mutex> lock(one_splat_call());
    switch (splats.basis) {
        case 1: return step_basis<1>(splats, view, image, loss, rates, memory);
        case 4: return step_basis<4>(splats, view, image, loss, rates, memory);
        case 9: return step_basis<9>(splats, view, image, loss, rates, memory);
        default: return step_basis<16>(splats, view, image, loss, rates, memory);
    }
}

}  // namespace NERFVOL_ISA
