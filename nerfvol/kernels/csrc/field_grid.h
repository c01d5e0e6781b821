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
    if (level < f.dense) {
        const int row = n + 1, plane = row * row;
        for (int o = 0; o < 8; ++o) {
            const int shift = (o >> 2) * plane + (o >> 1 & 1) * row + (o & 1);
            for (int k = 0; k < kLanes; ++k) c.entry[o][k] = x[k] * plane + y[k] * row + z[k] + shift;
        }
        return;
    }
    const uint32_t mask = f.bricks - 1;
    for (int o = 0; o < 8; ++o) {
        const uint32_t a = uint32_t(o >> 2), b = uint32_t(o >> 1 & 1), d = uint32_t(o & 1);
        for (int k = 0; k < kLanes; ++k) {
            const uint32_t i = uint32_t(x[k]) + a, j = uint32_t(y[k]) + b, l = uint32_t(z[k]) + d;
            const uint32_t brick = ((i >> 1) ^ (j >> 1) * 2654435761u ^ (l >> 2) * 805459861u) & mask;  // primes of Teschner et al. 2003
            c.entry[o][k] = int32_t(brick * 16u + (i & 1u) * 8u + (j & 1u) * 4u + (l & 3u));
        }
    }
}

typedef float f2 __attribute__((vector_size(8)));

// Asks for the cache lines of all corners: neighbours in z share one mostly.
template <int F> inline void prefetch(const Corners& c, const float* entries) {
    for (int r = 0; r < 8; r += 2)
        for (int k = 0; k < kLanes; ++k) __builtin_prefetch(entries + F * int64_t(c.entry[r][k]), 1);
}

// F rows of a packet's encoding from a level's entries.
template <int F> inline void interpolate(const Corners& c, const float* entries, float* out) {
    for (int k = 0; k < kLanes; ++k) {
        if constexpr (F == 2) {
            f4 sum{};
            for (int r = 0; r < 4; ++r) {
                const f2 a = load<f2>(entries + 2 * int64_t(c.entry[2 * r][k])), b = load<f2>(entries + 2 * int64_t(c.entry[2 * r + 1][k]));
                sum += __builtin_shufflevector(a, b, 0, 1, 2, 3) * splat4(c.face[r][k]);
            }
            out[k] = sum[0] * c.low[k] + sum[2] * c.high[k];
            out[kLanes + k] = sum[1] * c.low[k] + sum[3] * c.high[k];
        } else {
            float sum[F] = {};
            for (int o = 0; o < 8; ++o) {
                const float w = c.face[o >> 1][k] * (o & 1 ? c.high[k] : c.low[k]);
                for (int i = 0; i < F; ++i) sum[i] += w * entries[F * int64_t(c.entry[o][k]) + i];
            }
            for (int i = 0; i < F; ++i) out[i * kLanes + k] = sum[i];
        }
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
