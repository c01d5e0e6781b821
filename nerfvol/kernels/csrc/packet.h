// Packets: rays that share their origin, and the pyramid around them that the walk through the octree tests nodes against.
#pragma once
#include <cmath>

#include "simd.h"
#include "tree.h"

namespace NERFVOL_ISA {

using nerfvol::kTile;

// 64 rays.
struct Lanes {
    alignas(64) float dx[kTile], dy[kTile], dz[kTile];     // directions
    alignas(64) float ix[kTile], iy[kTile], iz[kTile];     // their reciprocals, see reciprocal()
    uint64_t alive;                                        // rays still to be continued
};

// What the walk knows of a packet: 8 rows of 8 patches, each of one ray or a few neighbours.
struct Pyramid {
    float o[3];                                            // origin in the unit cube
    uint64_t alive;                                        // patches with rays still to be continued
    bool bounded;                                          // what follows holds
    float axis[3], u[3], v[3];                             // the pyramid's frame
    float u_min, u_max, v_min, v_max;                      // slopes of all rays along u and v
    struct Grid { float low, high, per_step; } columns, rows;  // see even_grid
};

// S = 1: 64 rays, one in a patch; an 8x8 tile of an image is tight, any arrangement is correct. S = 4: a square of 16x16 pixels,
// four in a patch, as four strips of 16x4. Strip s has the patches from 16 s on, four lanes each (the pixel at the top left,
// its right neighbour, the two below), so that 16 lanes are 8x2 pixels either way, and the walk's cost is shared by more rays.
template <int S> struct Packet {
    Pyramid pyramid;
    Lanes strips[S];

    // Of 64 patches, the lanes of one strip.
    static uint64_t lanes_of(uint64_t patches, int strip) {
        if (S == 1) return patches;
        uint64_t x = patches >> 16 * strip & 0xffff;         // each bit to a nibble of its own
        x = (x | x << 24) & 0x000000ff000000ffull;
        x = (x | x << 12) & 0x000f000f000f000full;
        x = (x | x << 6) & 0x0303030303030303ull;
        x = (x | x << 3) & 0x1111111111111111ull;
        return x * 15;
    }

    // The pyramid's patches in which some ray is to be continued.
    void find_alive() {
        if (S == 1) {
            pyramid.alive = strips[0].alive;
            return;
        }
        pyramid.alive = 0;
        for (int s = 0; s < S; ++s) {
            uint64_t x = strips[s].alive;
            x |= x >> 1;
            x = (x | x >> 2) & 0x1111111111111111ull;
            x = (x | x >> 3) & 0x0303030303030303ull;
            x = (x | x >> 6) & 0x000f000f000f000full;
            x = (x | x >> 12) & 0x000000ff000000ffull;
            x = (x | x >> 24) & 0xffff;
            pyramid.alive |= x << 16 * s;
        }
    }
};

// 1/d; a zero component counts as +1e-20, which makes boxes half-open: a ray in the plane of a face belongs to the box
// above the face and to no other.
inline float reciprocal(float d) { return std::fabs(d) < 1e-20f ? 1e20f : 1.0f / d; }

inline float dot3(const float* a, const float* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

inline void normalize3(float* a) {
    const float s = 1.0f / std::sqrt(dot3(a, a));
    for (int k = 0; k < 3; ++k) a[k] *= s;
}

inline void set_direction(Lanes& rays, int lane, const float* d) {
    rays.dx[lane] = d[0]; rays.dy[lane] = d[1]; rays.dz[lane] = d[2];
    rays.ix[lane] = reciprocal(d[0]); rays.iy[lane] = reciprocal(d[1]); rays.iz[lane] = reciprocal(d[2]);
}

// The C library's fmax and fmin are calls, for the sake of NaN.
inline float larger(float a, float b) { return a > b ? a : b; }

// Sum of x[l] over the lanes l in `lanes`.
inline float sum_where(const float* x, uint64_t lanes) {
    float sum = 0;
    if (lanes == ~0ull) {
        f8 sums = load<f8>(x);
        for (int l = 8; l < kTile; l += 8) sums += load<f8>(x + l);
        for (int k = 0; k < 8; ++k) sum += sums[k];
    } else {
        for (; lanes; lanes &= lanes - 1) sum += x[__builtin_ctzll(lanes)];
    }
    return sum;
}

// The slopes of eight columns (or rows) of rays as an even grid: column k has slopes inside k / per_step + [high, low],
// high <= low, so that those at or above a slope s are k >= (s - low) * per_step, those below it k <= (s - high) * per_step,
// and no ray is missed however uneven the columns are.
inline Pyramid::Grid even_grid(const float* lowest, const float* highest) {
    int first = -1, last = -1;
    for (int k = 0; k < 8; ++k)
        if (lowest[k] <= highest[k]) { last = k; if (first < 0) first = k; }
    const float from = lowest[first] + highest[first], to = lowest[last] + highest[last];
    const float step = larger(last > first ? 0.5f * (to - from) / float(last - first) : 0.0f, 1e-7f);
    Pyramid::Grid g = {-1e30f, 1e30f, 1.0f / step};
    for (int k = first; k <= last; ++k)
        if (lowest[k] <= highest[k]) {
            g.low = larger(g.low, highest[k] - k * step);
            g.high = -larger(-g.high, k * step - lowest[k]);
        }
    g.low += 1e-3f * step + 1e-7f;
    g.high -= 1e-3f * step + 1e-7f;
    return g;
}

// Slopes of the rays of each column and row of patches; lowest > highest where there is none.
struct PatchSlopes {
    float columns_min[8], columns_max[8], rows_min[8], rows_max[8];
};

// Of the living rays along the pyramid's axis, u and v. False where one is more than about 70 degrees off the axis.
inline bool patch_slopes(const Packet<1>& p, PatchSlopes& out) {
    const Pyramid& to = p.pyramid;
    const Lanes& rays = p.strips[0];
    f8 col_min = splat8(1e30f), col_max = -col_min;
    for (int r = 0; r < 8; ++r) {
        out.rows_min[r] = 1e30f; out.rows_max[r] = -1e30f;
        const uint32_t alive = uint32_t(rays.alive >> 8 * r & 0xff);
        if (!alive) continue;
        const f8 x = load<f8>(rays.dx + 8 * r), y = load<f8>(rays.dy + 8 * r), z = load<f8>(rays.dz + 8 * r);
        const f8 depth = x * to.axis[0] + y * to.axis[1] + z * to.axis[2];
        if (mask_bits(depth < splat8(0.3f)) & alive) return false;
        const f8 inverse = 1.0f / depth;
        const f8 su = (x * to.u[0] + y * to.u[1] + z * to.u[2]) * inverse;
        const f8 sv = (x * to.v[0] + y * to.v[1] + z * to.v[2]) * inverse;
        const i8v bit = {1, 2, 4, 8, 16, 32, 64, 128};
        const i8v lives = (bit & int32_t(alive)) != 0;
        col_min = lives ? vmin(col_min, su) : col_min;
        col_max = lives ? vmax(col_max, su) : col_max;
        out.rows_min[r] = least(lives ? sv : splat8(1e30f));
        out.rows_max[r] = -least(lives ? -sv : splat8(1e30f));
    }
    store(out.columns_min, col_min);
    store(out.columns_max, col_max);
    return true;
}

// The same where all rays live.
inline bool patch_slopes(const Packet<4>& p, PatchSlopes& out) {
    const Pyramid& to = p.pyramid;
    f16 col_min[2] = {splat16(1e30f), splat16(1e30f)}, col_max[2] = {splat16(-1e30f), splat16(-1e30f)};
    for (int row = 0; row < 8; ++row) {
        const Lanes& rays = p.strips[row / 2];
        f16 row_min = splat16(1e30f), row_max = -row_min;
        for (int half = 0; half < 2; ++half) {
            const int l = 32 * (row % 2) + 16 * half;
            const f16 x = load<f16>(rays.dx + l), y = load<f16>(rays.dy + l), z = load<f16>(rays.dz + l);
            const f16 depth = x * to.axis[0] + y * to.axis[1] + z * to.axis[2];
            if (greater_bits(splat16(0.3f), depth)) return false;
            const f16 inverse = 1.0f / depth;
            const f16 su = (x * to.u[0] + y * to.u[1] + z * to.u[2]) * inverse;
            const f16 sv = (x * to.v[0] + y * to.v[1] + z * to.v[2]) * inverse;
            col_min[half] = vmin(col_min[half], su);
            col_max[half] = vmax(col_max[half], su);
            row_min = vmin(row_min, sv);
            row_max = vmax(row_max, sv);
        }
        out.rows_min[row] = least(row_min);
        out.rows_max[row] = -least(-row_max);
    }
    for (int half = 0; half < 2; ++half) {
        store(out.columns_min + 4 * half, quad_least(col_min[half]));
        store(out.columns_max + 4 * half, -quad_least(-col_max[half]));
    }
    return true;
}

// Computes the pyramid around the living rays. Packets wider than about 140 degrees are left unbounded.
template <int S> void bound_packet(Packet<S>& p) {
    Pyramid& to = p.pyramid;
    to.bounded = false;
    p.find_alive();
    if (!to.alive) return;
    float axis[3] = {}, across[3];
    for (int s = 0; s < S; ++s) {
        const Lanes& rays = p.strips[s];
        axis[0] += sum_where(rays.dx, rays.alive);
        axis[1] += sum_where(rays.dy, rays.alive);
        axis[2] += sum_where(rays.dz, rays.alive);
    }
    if (dot3(axis, axis) < 1e-6f) return;
    normalize3(axis);
    const Lanes& rays = p.strips[0];  // the direction of a row: between two of its rays, far apart
    int first = 0, last = 29;
    if (S == 1) {
        first = __builtin_ctzll(rays.alive);
        last = first / 8 * 8 + 31 - __builtin_clz(uint32_t(rays.alive >> first / 8 * 8 & 0xff));
    }
    across[0] = rays.dx[last] - rays.dx[first];
    across[1] = rays.dy[last] - rays.dy[first];
    across[2] = rays.dz[last] - rays.dz[first];
    const float along = dot3(across, axis);
    for (int k = 0; k < 3; ++k) across[k] -= along * axis[k];
    if (dot3(across, across) < 1e-12f) {  // a single column or ray: any perpendicular will do
        const int k = std::fabs(axis[0]) < 0.6f ? 0 : 1;
        for (int j = 0; j < 3; ++j) across[j] = (j == k ? 1.0f : 0.0f) - axis[k] * axis[j];
    }
    normalize3(across);
    const float down[3] = {axis[1] * across[2] - axis[2] * across[1], axis[2] * across[0] - axis[0] * across[2],
                           axis[0] * across[1] - axis[1] * across[0]};
    for (int k = 0; k < 3; ++k) { to.axis[k] = axis[k]; to.u[k] = across[k]; to.v[k] = down[k]; }
    PatchSlopes slopes;
    if (!patch_slopes(p, slopes)) return;
    to.u_min = least(load<f8>(slopes.columns_min)); to.u_max = -least(-load<f8>(slopes.columns_max));
    to.v_min = least(load<f8>(slopes.rows_min)); to.v_max = -least(-load<f8>(slopes.rows_max));
    to.columns = even_grid(slopes.columns_min, slopes.columns_max);
    to.rows = even_grid(slopes.rows_min, slopes.rows_max);
    to.bounded = true;
}

}  // namespace NERFVOL_ISA
