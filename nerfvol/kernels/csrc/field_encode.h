// Positions to the network's input: contraction to the unit cube, hash grid or sines and cosines; directions to theirs.
#pragma once
#include "field_grid.h"

namespace NERFVOL_ISA {

// Positions in units of the inner cube to [-1, 1]: linear inside, x -> 2 - 1 / x outside, each axis alone [Reiser 2023].
inline void contract(const FieldShape& f, float* p, int n) {
    if (f.outer <= 1.0f) {
        for (int k = 0; k < n; ++k) p[k] = p[k] < -1.0f ? -1.0f : p[k] > 1.0f ? 1.0f : p[k];
        return;
    }
    const float scale = 1.0f / (2.0f - 1.0f / f.outer);
    for (int k = 0; k < n; ++k) {
        const float size = std::fabs(p[k]);
        const float bent = size <= 1.0f ? p[k] : std::copysign(2.0f - 1.0f / size, p[k]);
        const float x = bent * scale;
        p[k] = x < -1.0f ? -1.0f : x > 1.0f ? 1.0f : x;
    }
}

// sin and cos of pi x: the angle is brought to [-1/2, 1/2] first, exactly. Errors below 3e-7 (Taylor polynomials).
inline void sin_cos_pi(const float* x, float* sine, float* cosine) {
    for (int k = 0; k < kLanes; ++k) {
        const float magic = 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer
        const float shifted = x[k] + magic, turns = shifted - magic;
        int32_t bits;
        std::memcpy(&bits, &shifted, 4);
        const float sign = bits & 1 ? -1.0f : 1.0f;
        const float a = (x[k] - turns) * 3.14159265358979f, q = a * a;
        float s = 1.0f / 6227020800.0f * q - 1.0f / 39916800.0f;
        s = s * q + 1.0f / 362880.0f;
        s = s * q - 1.0f / 5040.0f;
        s = s * q + 1.0f / 120.0f;
        s = s * q - 1.0f / 6.0f;
        float c = 1.0f / 479001600.0f * q - 1.0f / 3628800.0f;
        c = c * q + 1.0f / 40320.0f;
        c = c * q - 1.0f / 720.0f;
        c = c * q + 1.0f / 24.0f;
        c = c * q - 0.5f;
        sine[k] = sign * (s * q * a + a);
        cosine[k] = sign * (c * q + 1.0f);
    }
}

// gamma(p) = (p, sin(2^k pi p), cos(2^k pi p)), three rows each [Mildenhall et al. 2020, eq. 4].
inline void encode_frequencies(int n, const float* p, float* out) {
    std::memcpy(out, p, 3 * kLanes * sizeof(float));
    float scale = 1.0f;
    for (int f = 0; f < n; ++f, scale *= 2.0f)
        for (int axis = 0; axis < 3; ++axis) {
            alignas(64) float x[kLanes];
            for (int k = 0; k < kLanes; ++k) x[k] = p[axis * kLanes + k] * scale;
            float* row = out + (3 + 6 * f + axis) * kLanes;
            sin_cos_pi(x, row, row + 3 * kLanes);
        }
}

// p: rows x, y, z of contracted positions: [0, 1] for a hash grid, [-1, 1] else.
inline void encode(const FieldShape& f, const float* table, const float* p, float* out) {
    if (!f.hashed) return encode_frequencies(f.frequencies, p, out);
    with_features(f.features, [&](auto features) {
        Corners corners[2];  // the next level's are found, and asked for, before this one's are read
        const int row = features * kLanes;
        if (f.active < f.levels) std::fill(out + f.active * row, out + f.levels * row, 0.0f);
        if (f.active) find_corners(f, 0, p, corners[0]);
        for (int level = 0; level < f.active; ++level) {
            if (level + 1 < f.active) {
                find_corners(f, level + 1, p, corners[(level + 1) % 2]);
                prefetch<features>(corners[(level + 1) % 2], table + f.start[level + 1] * features);
            }
            interpolate<features>(corners[level % 2], table + f.start[level] * features, out + level * features * kLanes);
        }
    });
}

// Positions in units of the inner cube become what `encode` reads.
inline void to_encoding(const FieldShape& f, float* p) {
    contract(f, p, 3 * kLanes);
    if (f.hashed)
        for (int k = 0; k < 3 * kLanes; ++k) p[k] = p[k] * 0.5f + 0.5f;
}

}  // namespace NERFVOL_ISA
