// Front-to-back traversal of the octree by a packet of up to 64 rays that share their origin.
//
// Seen from one point the order of a node's children depends on the point alone, so one walk serves all rays of the packet
// and visits leaves in an order that is front to back for each of them. Nodes outside the packet's pyramid are skipped; a
// node whose pixels are all finished is skipped too. The exact ray-box test happens once, at the leaf.
#pragma once
#include <cmath>

#include "simd.h"
#include "tree.h"

namespace NERFVOL_ISA {

using nerfvol::kMaxLevel;
using nerfvol::kTile;
using nerfvol::Tree;

struct Packet {
    alignas(64) float dx[kTile], dy[kTile], dz[kTile];     // directions
    alignas(64) float ix[kTile], iy[kTile], iz[kTile];     // their reciprocals, see reciprocal()
    float o[3];                                            // origin in the unit cube
    uint64_t alive;                                        // rays still to be continued
    bool bounded;                                          // the pyramid below holds
    float axis[3], u[3], v[3];                             // the pyramid's frame
    float u_min, u_max, v_min, v_max;                      // slopes of all rays along u and v
    struct Grid { float low, high, per_step; } columns, rows;  // see bound_grid
};

// A leaf on the packet's way, or a node in place of its leaves (see Cell): its smallest corner, its side and the rays that
// may meet it.
struct Leaf {
    int32_t index;
    float x, y, z, side;
    uint64_t rays;
};

// What a ray crosses: leaf `index`, or node `index - n_leaves` that stands in for its leaves.
struct Cell {
    const int32_t* corners;
    const float* values;
};

inline Cell cell(const Tree& t, int32_t index) {
    if (index < t.n_leaves) return {t.corners + 8 * int64_t(index), t.values};
    return {t.node_corners + 8 * (index - t.n_leaves), t.node_values};
}

// 1/d; a zero component counts as +1e-20, which makes boxes half-open: a ray in the plane of a face belongs to the box
// above the face and to no other.
inline float reciprocal(float d) { return std::fabs(d) < 1e-20f ? 1e20f : 1.0f / d; }

inline float dot3(const float* a, const float* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

inline void normalize3(float* a) {
    const float s = 1.0f / std::sqrt(dot3(a, a));
    for (int k = 0; k < 3; ++k) a[k] *= s;
}

inline void set_direction(Packet& p, int lane, const float* d) {
    p.dx[lane] = d[0]; p.dy[lane] = d[1]; p.dz[lane] = d[2];
    p.ix[lane] = reciprocal(d[0]); p.iy[lane] = reciprocal(d[1]); p.iz[lane] = reciprocal(d[2]);
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
inline Packet::Grid even_grid(const float* lowest, const float* highest) {
    int first = -1, last = -1;
    for (int k = 0; k < 8; ++k)
        if (lowest[k] <= highest[k]) { last = k; if (first < 0) first = k; }
    const float from = lowest[first] + highest[first], to = lowest[last] + highest[last];
    const float step = larger(last > first ? 0.5f * (to - from) / float(last - first) : 0.0f, 1e-7f);
    Packet::Grid g = {-1e30f, 1e30f, 1.0f / step};
    for (int k = first; k <= last; ++k)
        if (lowest[k] <= highest[k]) {
            g.low = larger(g.low, highest[k] - k * step);
            g.high = -larger(-g.high, k * step - lowest[k]);
        }
    g.low += 1e-3f * step + 1e-7f;
    g.high -= 1e-3f * step + 1e-7f;
    return g;
}

// Computes the pyramid around the rays in `alive`. Lanes are thought of as 8 rows of 8; any arrangement is correct, an
// image tile is tight. Packets wider than about 140 degrees are left unbounded.
inline void bound_packet(Packet& p) {
    p.bounded = false;
    if (!p.alive) return;
    const int first = __builtin_ctzll(p.alive), row = first / 8;
    const int last_in_row = 8 * row + 31 - __builtin_clz(uint32_t(p.alive >> 8 * row & 0xff));
    const float *rays[3] = {p.dx, p.dy, p.dz};
    float axis[3], across[3];
    for (int k = 0; k < 3; ++k) axis[k] = sum_where(rays[k], p.alive);
    if (dot3(axis, axis) < 1e-6f) return;
    normalize3(axis);
    across[0] = p.dx[last_in_row] - p.dx[first];
    across[1] = p.dy[last_in_row] - p.dy[first];
    across[2] = p.dz[last_in_row] - p.dz[first];
    float along = dot3(across, axis);
    for (int k = 0; k < 3; ++k) across[k] -= along * axis[k];
    if (dot3(across, across) < 1e-12f) {  // a single column or ray: any perpendicular will do
        const int k = std::fabs(axis[0]) < 0.6f ? 0 : 1;
        for (int j = 0; j < 3; ++j) across[j] = (j == k ? 1.0f : 0.0f) - axis[k] * axis[j];
    }
    normalize3(across);
    const float down[3] = {axis[1] * across[2] - axis[2] * across[1], axis[2] * across[0] - axis[0] * across[2],
                           axis[0] * across[1] - axis[1] * across[0]};
    f8 col_min = splat8(1e30f), col_max = -col_min;
    float row_min[8], row_max[8];
    for (int r = 0; r < 8; ++r) {
        row_min[r] = 1e30f; row_max[r] = -1e30f;
        const uint32_t alive = uint32_t(p.alive >> 8 * r & 0xff);
        if (!alive) continue;
        const f8 x = load<f8>(p.dx + 8 * r), y = load<f8>(p.dy + 8 * r), z = load<f8>(p.dz + 8 * r);
        const f8 depth = x * axis[0] + y * axis[1] + z * axis[2];
        if (mask_bits(depth < splat8(0.3f)) & alive) return;
        const f8 inverse = 1.0f / depth;
        const f8 su = (x * across[0] + y * across[1] + z * across[2]) * inverse;
        const f8 sv = (x * down[0] + y * down[1] + z * down[2]) * inverse;
        const i8v bit = {1, 2, 4, 8, 16, 32, 64, 128};
        const i8v lives = (bit & int32_t(alive)) != 0;
        col_min = lives ? vmin(col_min, su) : col_min;
        col_max = lives ? vmax(col_max, su) : col_max;
        row_min[r] = least(lives ? sv : splat8(1e30f));
        row_max[r] = -least(lives ? -sv : splat8(1e30f));
    }
    float columns_min[8], columns_max[8];
    store(columns_min, col_min);
    store(columns_max, col_max);
    p.u_min = least(col_min); p.u_max = -least(-col_max);
    p.v_min = least(load<f8>(row_min)); p.v_max = -least(-load<f8>(row_max));
    p.columns = even_grid(columns_min, columns_max);
    p.rows = even_grid(row_min, row_max);
    for (int k = 0; k < 3; ++k) { p.axis[k] = axis[k]; p.u[k] = across[k]; p.v[k] = down[k]; }
    p.bounded = true;
}

struct Entry {  // on the stack: interior node `index` to be opened, or cell `~index`
    int32_t index;
    float x, y, z, side;
    uint64_t rays;
};

// The eight children of a node against the pyramid: for each, the interval of slopes that its cube may cover.
struct Interval { f8 lo, hi; };

inline Interval slopes(f8 across, float radius, f8 near_inverse, f8 far_inverse) {
    const f8 lo = across - radius, hi = across + radius;
    return {lo * (lo >= 0.0f ? far_inverse : near_inverse), hi * (hi >= 0.0f ? near_inverse : far_inverse)};
}

// First and last column (or row) that an interval of slopes may meet, in 0..7; first > last: none.
struct Range { i8v first, last; };

inline Range range_of(Interval s, const Packet::Grid& g) {
    const f8 zero = splat8(0.0f), seven = splat8(7.0f);
    const f8 first = vmin(vmax((s.lo - g.low) * g.per_step, zero), seven) + 0.9999f;  // truncation below makes it the ceiling
    const f8 last = vmin(vmax((s.hi - g.high) * g.per_step, zero), seven);
    return {__builtin_convertvector(first, i8v), __builtin_convertvector(last, i8v)};
}

// The rays, as bits, inside the columns and rows of each of eight children (all rays for a child that is near), among `rays`.
// Returns one bit for each child that has any.
inline uint32_t rays_inside(Range columns, Range rows, i8v near, uint64_t rays, uint64_t* inside) {
    const i8v bits = (255 << columns.first) & (255 >> (7 - columns.last));
#if defined(__AVX512F__)
    const u8l every = {~0ull, ~0ull, ~0ull, ~0ull, ~0ull, ~0ull, ~0ull, ~0ull};
    const u8l from = every << __builtin_convertvector(8 * rows.first, u8l);
    const u8l to = every >> __builtin_convertvector(56 - 8 * rows.last, u8l);
    const u8l met = (((__builtin_convertvector(bits, u8l) * 0x0101010101010101ull) & from & to) |
                     (u8l)__builtin_convertvector(near, l8)) & rays;
    store(inside, met);
    return mask_bits(__builtin_convertvector((l8)(met != 0), i8v));
#else
    int32_t in_columns[8], first[8], last[8], close[8];
    store(in_columns, bits);
    store(first, rows.first);
    store(last, rows.last);
    store(close, near);
    uint32_t some = 0;
    for (int k = 0; k < 8; ++k) {
        const uint64_t in_rows = (~0ull << 8 * first[k]) & (~0ull >> (56 - 8 * last[k]));
        inside[k] = ((uint64_t(uint32_t(in_columns[k])) * 0x0101010101010101ull & in_rows) | uint64_t(int64_t(close[k]))) & rays;
        some |= uint32_t(inside[k] != 0) << k;
    }
    return some;
#endif
}

// Bits 0..7 of `m` with bit k moved to k ^ flip.
inline uint32_t flipped(uint32_t m, uint32_t flip) {
    if (flip & 1) m = (m & 0x55) << 1 | (m >> 1 & 0x55);
    if (flip & 2) m = (m & 0x33) << 2 | (m >> 2 & 0x33);
    if (flip & 4) m = (m & 0x0f) << 4 | m >> 4;
    return m;
}

class Walk {
public:
    Walk(const Tree& tree, Packet& packet) : tree_(tree), p_(packet) {
        const f8 bx = {0, 0, 0, 0, 1, 1, 1, 1}, by = {0, 0, 1, 1, 0, 0, 1, 1}, bz = {0, 1, 0, 1, 0, 1, 0, 1};
        if (p_.bounded) {
            off_u_ = bx * p_.u[0] + by * p_.u[1] + bz * p_.u[2];
            off_v_ = bx * p_.v[0] + by * p_.v[1] + bz * p_.v[2];
            off_w_ = bx * p_.axis[0] + by * p_.axis[1] + bz * p_.axis[2];
            // Half extents of a unit cube along the frame, a little enlarged: the slab test decides, this only culls.
            r_u_ = 0.505f * (std::fabs(p_.u[0]) + std::fabs(p_.u[1]) + std::fabs(p_.u[2]));
            r_v_ = 0.505f * (std::fabs(p_.v[0]) + std::fabs(p_.v[1]) + std::fabs(p_.v[2]));
            r_w_ = 0.505f * (std::fabs(p_.axis[0]) + std::fabs(p_.axis[1]) + std::fabs(p_.axis[2]));
        }
        if (tree.n_nodes > 0) stack_[n_++] = {0, 0, 0, 0, 1, p_.alive};
    }

    // The next leaf that some unfinished ray may meet.
    bool next(Leaf& leaf) {
        while (n_ > 0) {
            const Entry e = stack_[--n_];
            const uint64_t rays = e.rays & p_.alive;
            if (!rays) continue;
            if (e.index < 0) {
                leaf = {~e.index, e.x, e.y, e.z, e.side, rays};
                return true;
            }
            expand(e, rays);
        }
        return false;
    }

private:
    // Whether a node is so small, seen from the packet's origin, that it is not opened. The directions have no say: every
    // ray from one point sees the same cells.
    bool stands_in(float x, float y, float z, float side) const {
        if (!(tree_.coarse > 0)) return false;
        const float h = 0.5f * side, to[3] = {x + h - p_.o[0], y + h - p_.o[1], z + h - p_.o[2]};
        return side * side < tree_.coarse * tree_.coarse * dot3(to, to);
    }

    void expand(const Entry& e, uint64_t rays) {
        const float h = 0.5f * e.side;
        const uint32_t nodes = tree_.node_mask[e.index], leaves = tree_.leaf_mask[e.index];
        uint32_t present = nodes | leaves;
        alignas(64) uint64_t inside[8] = {rays, rays, rays, rays, rays, rays, rays, rays};
        if (p_.bounded) {
            const float c[3] = {e.x + 0.5f * h - p_.o[0], e.y + 0.5f * h - p_.o[1], e.z + 0.5f * h - p_.o[2]};
            const f8 a = dot3(c, p_.u) + h * off_u_, b = dot3(c, p_.v) + h * off_v_, w = dot3(c, p_.axis) + h * off_w_;
            const f8 w_near = w - (r_w_ * h + 1e-6f), w_far = w + (r_w_ * h + 1e-6f);
            const i8v near = w_near < splat8(0.02f * h);  // too close for a bound on their slopes
            const f8 near_inverse = 1.0f / w_near, far_inverse = 1.0f / w_far;
            const Interval su = slopes(a, r_u_ * h + 1e-6f, near_inverse, far_inverse);
            const Interval sv = slopes(b, r_v_ * h + 1e-6f, near_inverse, far_inverse);
            const uint32_t some = rays_inside(range_of(su, p_.columns), range_of(sv, p_.rows), near, rays, inside);
            const i8v meets = (su.hi >= p_.u_min) & (su.lo <= p_.u_max) & (sv.hi >= p_.v_min) & (sv.lo <= p_.v_max);
            present &= some & mask_bits((near | meets) & (w_far > 0.0f));
        }
        const uint32_t first = (p_.o[0] >= e.x + h ? 4u : 0u) | (p_.o[1] >= e.y + h ? 2u : 0u) | (p_.o[2] >= e.z + h ? 1u : 0u);
        uint32_t waiting = flipped(present, first);  // bit k: the k-th child on the way
        const int32_t first_leaf = tree_.first_leaf[e.index], first_node = tree_.first_node[e.index];
        while (waiting) {  // pushed back to front
            const uint32_t k = 31 - uint32_t(__builtin_clz(waiting)), o = first ^ k, bit = 1u << o;
            waiting ^= 1u << k;
            const float x = e.x + (o & 4 ? h : 0.0f), y = e.y + (o & 2 ? h : 0.0f), z = e.z + (o & 1 ? h : 0.0f);
            const bool is_leaf = leaves & bit;
            const int32_t leaf = first_leaf + __builtin_popcount(leaves & (bit - 1));
            const int32_t node = first_node + __builtin_popcount(nodes & (bit - 1));
            const bool is_cell = is_leaf || stands_in(x, y, z, h);
            const int32_t index = is_leaf ? leaf : int32_t(tree_.n_leaves) + node;
            __builtin_prefetch(is_cell ? static_cast<const void*>(cell(tree_, index).corners) : tree_.first_leaf + node);
            stack_[n_++] = {is_cell ? ~index : node, x, y, z, h, inside[o]};
        }
    }

    const Tree& tree_;
    Packet& p_;
    f8 off_u_, off_v_, off_w_;
    float r_u_ = 0, r_v_ = 0, r_w_ = 0;
    int n_ = 0;
    Entry stack_[8 * (kMaxLevel + 1)];
};

// Per lane: length and midpoint of the ray's way through a leaf (unit-cube distances) and the midpoint's place in it.
struct Segments {
    alignas(64) float length[kTile], middle[kTile], fx[kTile], fy[kTile], fz[kTile];
};

// Fills `s` for the rays of `leaf.rays` and returns those that really meet the leaf.
inline uint64_t intersect(const Packet& p, const Leaf& leaf, Segments& s) {
    const float per_side = 1.0f / leaf.side;
    const float lo[3] = {leaf.x - p.o[0], leaf.y - p.o[1], leaf.z - p.o[2]};
    const float hi[3] = {leaf.x + leaf.side - p.o[0], leaf.y + leaf.side - p.o[1], leaf.z + leaf.side - p.o[2]};
    uint64_t hits = 0;
    for (int base = 0; base < kTile; base += 16) {
        if (!(leaf.rays >> base & 0xffff)) continue;
        const f16 ix = load<f16>(p.ix + base), iy = load<f16>(p.iy + base), iz = load<f16>(p.iz + base);
        const f16 ax = lo[0] * ix, bx = hi[0] * ix, ay = lo[1] * iy, by = hi[1] * iy, az = lo[2] * iz, bz = hi[2] * iz;
        const f16 tn = vmax(vmax(vmin(ax, bx), vmin(ay, by)), vmax(vmin(az, bz), splat16(0.0f)));
        const f16 tf = vmin(vmin(vmax(ax, bx), vmax(ay, by)), vmax(az, bz));
        const f16 middle = 0.5f * (tn + tf), zero = splat16(0.0f), one = splat16(1.0f);
        store(s.length + base, tf - tn);
        store(s.middle + base, middle);
        store(s.fx + base, vmin(vmax((middle * load<f16>(p.dx + base) - lo[0]) * per_side, zero), one));
        store(s.fy + base, vmin(vmax((middle * load<f16>(p.dy + base) - lo[1]) * per_side, zero), one));
        store(s.fz + base, vmin(vmax((middle * load<f16>(p.dz + base) - lo[2]) * per_side, zero), one));
        hits |= uint64_t(greater_bits(tf, tn)) << base;
    }
    return hits & leaf.rays;
}

}  // namespace NERFVOL_ISA
