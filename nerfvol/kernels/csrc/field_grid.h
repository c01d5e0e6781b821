// The hash grid: interpolation of a packet's sixteen points in every level, and the gradient's way back into a level's entries.
//
// A level of up to 2^k vertices stores each, z fastest. A finer one hashes bricks of 2 x 2 x 4 vertices [Mueller et al. 2022
// hash vertices]: sixteen entries that lie next to each other, so that a cell's eight corners are on few cache lines, and the
// two that are neighbours in z are neighbours in memory three times of four.
#pragma once
#include "field_network.h"

namespace NERFVOL_ISA {

// Entries of the eight corners of the cells around sixteen points, and the weights. Corner o is at (o >> 2 & 1, o >> 1 & 1, o & 1).
struct Corners {
    alignas(64) int32_t entry[8][kLanes];
    alignas(64) float face[4][kLanes], low[kLanes], high[kLanes];  // weights in x and y; in z
    bool adjacent;                                             // entries o and o + 1, neighbours in z, lie next to each other
};

// The cells of one axis: lower vertex and the distance from it.
inline void cells_of(const float* p, int n, int32_t* cell, float* high) {
    const float size = float(n), last = float(n - 1);
    for (int k = 0; k < kLanes; ++k) {
        float x = p[k] * size;
        x = x > 0.0f ? x : 0.0f;
        x = x < size ? x : size;
        const float whole = float(int32_t(x));
        const float lower = whole < last ? whole : last;
        cell[k] = int32_t(lower);
        high[k] = x - lower;
    }
}

// p: rows x, y, z of a packet, in the unit cube.
inline void find_corners(const FieldShape& f, int level, const float* p, Corners& c) {
    alignas(64) int32_t x[kLanes], y[kLanes], z[kLanes];
    alignas(64) float hx[kLanes], hy[kLanes];
    const int n = f.resolution[level];
    cells_of(p, n, x, hx);
    cells_of(p + kLanes, n, y, hy);
    cells_of(p + 2 * kLanes, n, z, c.high);
    for (int k = 0; k < kLanes; ++k) {
        c.low[k] = 1.0f - c.high[k];
        c.face[0][k] = (1.0f - hx[k]) * (1.0f - hy[k]);
        c.face[1][k] = (1.0f - hx[k]) * hy[k];
        c.face[2][k] = hx[k] * (1.0f - hy[k]);
        c.face[3][k] = hx[k] * hy[k];
    }
    c.adjacent = level < f.dense;
    if (level < f.dense) {
        const int row = n + 1, plane = row * row;
        for (int o = 0; o < 8; ++o) {
            const int shift = (o >> 2) * plane + (o >> 1 & 1) * row + (o & 1);
            for (int k = 0; k < kLanes; ++k) c.entry[o][k] = x[k] * plane + y[k] * row + z[k] + shift;
        }
        return;
    }
    // The numbers of brick and of entry within it side by side: their bits do not meet, so that they are hashed as one.
    alignas(64) uint32_t part[3][2][kLanes];
    for (uint32_t o = 0; o < 2; ++o)
        for (int k = 0; k < kLanes; ++k) {
            const uint32_t i = uint32_t(x[k]) + o, j = uint32_t(y[k]) + o, l = uint32_t(z[k]) + o;
            part[0][o][k] = (i >> 1) * 16u + (i & 1u) * 8u;
            part[1][o][k] = (j >> 1) * 2654435761u * 16u + (j & 1u) * 4u;  // primes of Teschner et al. 2003
            part[2][o][k] = (l >> 2) * 805459861u * 16u + (l & 3u);
        }
    const uint32_t mask = f.bricks * 16u - 1u;
    for (int o = 0; o < 8; ++o)
        for (int k = 0; k < kLanes; ++k)
            c.entry[o][k] = int32_t((part[0][o >> 2][k] ^ part[1][o >> 1 & 1][k] ^ part[2][o & 1][k]) & mask);
}

typedef float f2 __attribute__((vector_size(8)));

// Asks for the cache lines of all corners: neighbours in z share one mostly.
template <int F> inline void prefetch(const Corners& c, const float* entries) {
    for (int r = 0; r < 8; r += 2)
        for (int k = 0; k < kLanes; ++k) __builtin_prefetch(entries + F * int64_t(c.entry[r][k]), 1);
}

// Two features of a packet, four lanes at a time. Adjacent: a corner's neighbour in z is the next entry.
template <bool Adjacent> inline void interpolate_pairs(const Corners& c, const float* entries, float* out) {
    for (int k = 0; k < kLanes; k += 4) {
        f4 sum[4];  // of a lane: both features at the lower z, both at the upper
        for (int lane = 0; lane < 4; ++lane) {
            sum[lane] = f4{};
            for (int r = 0; r < 4; ++r) {
                const float* lower = entries + 2 * int64_t(c.entry[2 * r][k + lane]);
                f4 both;
                if constexpr (Adjacent) both = load<f4>(lower);
                else both = __builtin_shufflevector(load<f2>(lower), load<f2>(entries + 2 * int64_t(c.entry[2 * r + 1][k + lane])), 0, 1, 2, 3);
                sum[lane] += both * splat4(c.face[r][k + lane]);
            }
        }
        const f4 low = load<f4>(c.low + k), high = load<f4>(c.high + k);
        const f4 l0 = __builtin_shufflevector(sum[0], sum[1], 0, 4, 1, 5), l1 = __builtin_shufflevector(sum[2], sum[3], 0, 4, 1, 5);
        const f4 h0 = __builtin_shufflevector(sum[0], sum[1], 2, 6, 3, 7), h1 = __builtin_shufflevector(sum[2], sum[3], 2, 6, 3, 7);
        store(out + k, __builtin_shufflevector(l0, l1, 0, 1, 4, 5) * low + __builtin_shufflevector(h0, h1, 0, 1, 4, 5) * high);
        store(out + kLanes + k, __builtin_shufflevector(l0, l1, 2, 3, 6, 7) * low + __builtin_shufflevector(h0, h1, 2, 3, 6, 7) * high);
    }
}

// F rows of a packet's encoding from a level's entries.
template <int F> inline void interpolate(const Corners& c, const float* entries, float* out) {
    if constexpr (F == 2) return c.adjacent ? interpolate_pairs<true>(c, entries, out) : interpolate_pairs<false>(c, entries, out);
    for (int k = 0; k < kLanes; ++k) {
        float sum[F] = {};
        for (int o = 0; o < 8; ++o) {
            const float w = c.face[o >> 1][k] * (o & 1 ? c.high[k] : c.low[k]);
            for (int i = 0; i < F; ++i) sum[i] += w * entries[F * int64_t(c.entry[o][k]) + i];
        }
        for (int i = 0; i < F; ++i) out[i * kLanes + k] = sum[i];
    }
}

// Adds a packet's gradient d (its rows of this level) to the entries of [from, from + count), in the order of samples: whoever
// has another range of the level adds the rest, and each entry's sum is the same.
template <int F> inline void scatter(const Corners& c, const float* d, float* gradient, bool whole, int64_t from, int64_t count) {
    for (int k = 0; k < kLanes; ++k) {
        if constexpr (F == 2) {
            const float a = d[k], b = d[kLanes + k];
            if (a == 0.0f && b == 0.0f) continue;
            const f2 both = {a, b}, low = both * c.low[k], high = both * c.high[k];
            if (whole && c.adjacent) {
                const f4 all = __builtin_shufflevector(low, high, 0, 1, 2, 3);
                for (int r = 0; r < 4; ++r) {
                    float* to = gradient + 2 * int64_t(c.entry[2 * r][k]);
                    store(to, load<f4>(to) + all * splat4(c.face[r][k]));
                }
                continue;
            }
            for (int r = 0; r < 4; ++r) {
                const float w = c.face[r][k];
                const int64_t i = c.entry[2 * r][k], j = c.entry[2 * r + 1][k];
                if (whole || uint64_t(i - from) < uint64_t(count)) store(gradient + 2 * i, load<f2>(gradient + 2 * i) + low * w);
                if (whole || uint64_t(j - from) < uint64_t(count)) store(gradient + 2 * j, load<f2>(gradient + 2 * j) + high * w);
            }
        } else {
            for (int o = 0; o < 8; ++o) {
                const int64_t i = c.entry[o][k];
                if (!whole && uint64_t(i - from) >= uint64_t(count)) continue;
                const float w = c.face[o >> 1][k] * (o & 1 ? c.high[k] : c.low[k]);
                for (int n = 0; n < F; ++n) gradient[F * i + n] += w * d[n * kLanes + k];
            }
        }
    }
}

template <class Function> inline void with_features(int features, const Function& call) {
    switch (features) {
        case 1: call(std::integral_constant<int, 1>{}); break;
        case 2: call(std::integral_constant<int, 2>{}); break;
        case 4: call(std::integral_constant<int, 4>{}); break;
        default: call(std::integral_constant<int, 8>{}); break;
    }
}

}  // namespace NERFVOL_ISA
