// The field inside a leaf: trilinear interpolation of packed vertex rows, then spherical harmonics along the ray.
#pragma once
#include "sh_basis.h"
#include "simd.h"
#include "traverse.h"

namespace NERFVOL_ISA {

// Slot of the raw density in a vertex row. Coefficient k of channel c is stored at 16 (k / 4) + 4 c + k % 4, save that degree 2's
// ninth coefficients at 28 + c (nerfvol/octree/rows.py has the same rule).
constexpr int kDensitySlot = 12;

// Per ray: the basis in the places of a vertex row, with 1 at the raw density.
template <int B> struct BasisRows {
    alignas(64) float row[kTile][16 * B];

    void fill(const Lanes& rays, int degree) {
        for (int l = 0; l < kTile; ++l) {
            if (!(rays.alive >> l & 1)) continue;
            float b[16] = {};
            sh_basis(degree, rays.dx[l], rays.dy[l], rays.dz[l], b);
            for (int k = 0; k < B; ++k) {
                const f4 four = load<f4>(b + 4 * k);
                f4 last{};
                if (k == 0) last[0] = 1.0f;
                else if (B == 2) last = f4{b[8], b[8], b[8], 0.0f};
                store(row[l] + 16 * k, four);
                store(row[l] + 16 * k + 4, four);
                store(row[l] + 16 * k + 8, four);
                store(row[l] + 16 * k + 12, last);
            }
        }
    }
};

// Numbers of a vertex row. Of bfloat16 a shuffle with zeros makes floats.
inline void read_row(const float* p, f16& v) { read(p, v); }
inline void read_row(const nerfvol::Bfloat16* p, f4& v) {
    typedef uint16_t u16x8 __attribute__((vector_size(16)));
    u16x8 bits{};
    std::memcpy(&bits, p, 8);
    v = (f4)__builtin_shufflevector(u16x8{}, bits, 0, 8, 0, 9, 0, 10, 0, 11);
}
template <class H> inline void read_row(const nerfvol::Bfloat16* p, Pair<H>& v) {
    read_row(p, v.lo);
    read_row(p + sizeof(H) / sizeof(float), v.hi);
}

// Trilinear weights of the eight corners; corner o is at offsets (o>>2&1, o>>1&1, o&1).
inline f8 trilinear(float fx, float fy, float fz) {
    const f8 sx = {-1, -1, -1, -1, 1, 1, 1, 1}, ax = {1, 1, 1, 1, 0, 0, 0, 0};
    const f8 sy = {-1, -1, 1, 1, -1, -1, 1, 1}, ay = {1, 1, 0, 0, 1, 1, 0, 0};
    const f8 sz = {-1, 1, -1, 1, -1, 1, -1, 1}, az = {1, 0, 1, 0, 1, 0, 1, 0};
    return (sx * fx + ax) * (sy * fy + ay) * (sz * fz + az);
}

// The field of a leaf as a polynomial in the place (x, y, z) inside it: coefficient o multiplies x^(o>>2&1) y^(o>>1&1)
// z^(o&1). Made once for all rays that meet the leaf; a point then costs seven multiply-adds and three broadcasts.
template <int B> struct LeafField {
    f16 c[8][B];

    LeafField(const RowNumber* values, const int32_t* corners) {
        for (int o = 0; o < 8; ++o)
            for (int k = 0; k < B; ++k) read_row(values + 16 * (B * int64_t(corners[o]) + k), c[o][k]);
        for (int axis = 1; axis < 8; axis *= 2)
            for (int o = 0; o < 8; ++o)
                if (o & axis)
                    for (int k = 0; k < B; ++k) c[o][k] -= c[o ^ axis][k];
    }

    f16 row(int k, float x, float y, float z) const {
        const f16 front = (c[0][k] + z * c[1][k]) + y * (c[2][k] + z * c[3][k]);
        const f16 back = (c[4][k] + z * c[5][k]) + y * (c[6][k] + z * c[7][k]);
        return front + x * back;
    }

    // Only the first block holds a density.
    static f4 without_density(f4 v) { return f4{v[0], v[1], v[2], 0.0f}; }

    // (r, g, b, raw density) at a point along a ray's basis: rgb without the constant 1/2.
    f4 at(float x, float y, float z, const float* basis) const {
        f4 out{};
        for (int k = 0; k < B; ++k) {
            const f16 terms = row(k, x, y, z) * load<f16>(basis + 16 * k);
            out += k == 0 ? quad_sums(terms) : without_density(quad_sums(terms));
            if (k > 0 && B == 2) out += without_density(quarter<3>(terms));  // degree 2's ninth coefficients
        }
        return out;
    }

    // d(raw density)/d(x, y, z) at a point.
    void density_slope(float x, float y, float z, float* g) const {
        float d[8];
        for (int o = 0; o < 8; ++o) d[o] = quarter<kDensitySlot / 4>(c[o][0])[0];
        g[0] = d[4] + z * d[5] + y * (d[6] + z * d[7]);
        g[1] = d[2] + z * d[3] + x * (d[6] + z * d[7]);
        g[2] = d[1] + y * d[3] + x * (d[5] + y * d[7]);
    }
};

// The field of a cell that is small, seen from the rays' origin: its harmonics along the ray through its middle serve all rays
// that meet it, so that only (r, g, b, raw density) is left to be interpolated; rgb without the constant 1/2.
template <int B> struct SmallLeafField {
    f4 c[8];

    // towards: from the origin to the cell's middle, of any length.
    SmallLeafField(const RowNumber* values, const int32_t* corners, int degree, const float* towards) {
        const float inverse = 1.0f / std::sqrt(dot3(towards, towards));
        float b[16] = {};
        sh_basis(degree, inverse * towards[0], inverse * towards[1], inverse * towards[2], b);
        f16 basis[B];
        for (int k = 0; k < B; ++k) {
            const f4 four = load<f4>(b + 4 * k);
            basis[k] = join(four, four, four, f4{k == 0 ? 1.0f : 0.0f, 0, 0, 0});
        }
        const f4 ninth = {b[8], b[8], b[8], 0};
        for (int o = 0; o < 8; ++o) {
            f16 terms{}, row;
            for (int k = 0; k < B; ++k) {
                read_row(values + 16 * (B * int64_t(corners[o]) + k), row);
                terms += row * basis[k];
            }
            c[o] = quad_sums(terms);
            if (B == 2) c[o] += ninth * quarter<3>(row);
        }
        for (int axis = 1; axis < 8; axis *= 2)
            for (int o = 0; o < 8; ++o)
                if (o & axis) c[o] -= c[o ^ axis];
    }

    f4 at(float x, float y, float z) const {
        const f4 front = (c[0] + z * c[1]) + y * (c[2] + z * c[3]), back = (c[4] + z * c[5]) + y * (c[6] + z * c[7]);
        return front + x * back;
    }

    // d(raw density)/d(x, y, z) at a point.
    void density_slope(float x, float y, float z, float* g) const {
        g[0] = c[4][3] + z * c[5][3] + y * (c[6][3] + z * c[7][3]);
        g[1] = c[2][3] + z * c[3][3] + x * (c[6][3] + z * c[7][3]);
        g[2] = c[1][3] + y * c[3][3] + x * (c[5][3] + y * c[7][3]);
    }
};

// sigma / density_scale: exponential below 1, linear above (value and slope are continuous).
inline f16 explin(const f16& raw) { return select_less(raw, 1.0f, vexp(raw - 1.0f), raw); }
inline f16 explin_slope(const f16& raw) { return select_less(raw, 1.0f, vexp(raw - 1.0f), splat16(1.0f)); }

}  // namespace NERFVOL_ISA
