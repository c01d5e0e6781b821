// The field inside a leaf: trilinear interpolation of packed vertex rows, then spherical harmonics along the ray.
#pragma once
#include "simd.h"
#include "traverse.h"

namespace NERFVOL_ISA {

typedef float f4 __attribute__((vector_size(16)));

// Real spherical harmonics, the sign convention of PlenOctrees and 3DGS. y has (degree + 1)^2 entries.
inline void sh_basis(int degree, float x, float y, float z, float* b) {
    b[0] = 0.28209479177387814f;
    if (degree < 1) return;
    b[1] = -0.4886025119029199f * y;
    b[2] = 0.4886025119029199f * z;
    b[3] = -0.4886025119029199f * x;
    if (degree < 2) return;
    b[4] = 1.0925484305920792f * x * y;
    b[5] = -1.0925484305920792f * y * z;
    b[6] = 0.31539156525252005f * (2 * z * z - x * x - y * y);
    b[7] = -1.0925484305920792f * x * z;
    b[8] = 0.5462742152960396f * (x * x - y * y);
    if (degree < 3) return;
    b[9] = -0.5900435899266435f * y * (3 * x * x - y * y);
    b[10] = 2.890611442640554f * x * y * z;
    b[11] = -0.4570457994644658f * y * (4 * z * z - x * x - y * y);
    b[12] = 0.3731763325901154f * z * (2 * z * z - 3 * x * x - 3 * y * y);
    b[13] = -0.4570457994644658f * x * (4 * z * z - x * x - y * y);
    b[14] = 1.445305721320277f * z * (x * x - y * y);
    b[15] = -0.5900435899266435f * x * (x * x - 3 * y * y);
}

// Where coefficient k of channel c stands in a vertex row (nerfvol/octree.py has the same rule). Slot 12 is raw density.
inline int sh_slot(int degree, int c, int k) {
    return degree == 2 && k == 8 ? 28 + c : 16 * (k / 4) + 4 * c + k % 4;
}
constexpr int kDensitySlot = 12;

// Per ray: the basis in the places of a vertex row, with 1 at the raw density.
template <int B> struct BasisRows {
    alignas(64) float row[kTile][16 * B];

    void fill(const Packet& p, int degree) {
        std::memset(row, 0, sizeof(row));
        const int n = (degree + 1) * (degree + 1);
        for (int l = 0; l < kTile; ++l) {
            if (!(p.alive >> l & 1)) continue;
            float b[16];
            sh_basis(degree, p.dx[l], p.dy[l], p.dz[l], b);
            for (int c = 0; c < 3; ++c)
                for (int k = 0; k < n; ++k) row[l][sh_slot(degree, c, k)] = b[k];
            row[l][kDensitySlot] = 1.0f;
        }
    }
};

// Trilinear weights of the eight corners; corner o stands at offsets (o>>2&1, o>>1&1, o&1).
inline f8 trilinear(float fx, float fy, float fz) {
    const f8 sx = {-1, -1, -1, -1, 1, 1, 1, 1}, ax = {1, 1, 1, 1, 0, 0, 0, 0};
    const f8 sy = {-1, -1, 1, 1, -1, -1, 1, 1}, ay = {1, 1, 0, 0, 1, 1, 0, 0};
    const f8 sz = {-1, 1, -1, 1, -1, 1, -1, 1}, az = {1, 0, 1, 0, 1, 0, 1, 0};
    return (sx * fx + ax) * (sy * fy + ay) * (sz * fz + az);
}

// (r, g, b, raw density) at a point: rgb without the constant 1/2.
template <int B> inline f4 evaluate(const float* const* rows, f8 weights, const float* basis) {
    alignas(32) float w[8];
    store(w, weights);
    keep_in_memory(w);
    f4 out{};
    for (int k = 0; k < B; ++k) {
        f16 sum = w[0] * load<f16>(rows[0] + 16 * k), other = w[4] * load<f16>(rows[4] + 16 * k);
        for (int o = 1; o < 4; ++o) {  // two chains: half the latency
            sum += w[o] * load<f16>(rows[o] + 16 * k);
            other += w[o + 4] * load<f16>(rows[o + 4] + 16 * k);
        }
        sum = (sum + other) * load<f16>(basis + 16 * k);
        const f16 q = quad_sums(sum);
        f4 rgb = __builtin_shufflevector(q, q, 0, 4, 8, 12);
        if (k > 0) {
            rgb[3] = 0;  // only the first block holds a density
            if (B == 2) rgb += __builtin_shufflevector(sum, splat16(0.0f), 12, 13, 14, 16);  // degree 2's ninth coefficient
        }
        out += rgb;
    }
    return out;
}

// sigma / density_scale: exponential below 1, linear above (value and slope are continuous).
inline f16 explin(f16 raw) { return raw < 1.0f ? exp16(raw - 1.0f) : raw; }
inline f16 explin_slope(f16 raw) { return raw < 1.0f ? exp16(raw - 1.0f) : splat16(1.0f); }

}  // namespace NERFVOL_ISA
