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
    alignas(32) float col_min[8], col_max[8], row_min[8], row_max[8];  // slopes along u of columns, along v of rows
    float u_min, u_max, v_min, v_max;
};

// A leaf on the packet's way: its smallest corner, its side and the rays that may meet it.
struct Leaf {
    int32_t index;
    float x, y, z, side;
    uint64_t rays;
};

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

// Computes the pyramid around the rays in `alive`. Lanes are thought of as 8 rows of 8; any arrangement is correct, an
// image tile is tight. Packets wider than about 140 degrees are left unbounded.
inline void bound_packet(Packet& p) {
    p.bounded = false;
    float axis[3] = {0, 0, 0}, across[3] = {0, 0, 0};
    int first = -1, last_in_row = -1;
    for (int l = 0; l < kTile; ++l)
        if (p.alive >> l & 1) {
            axis[0] += p.dx[l]; axis[1] += p.dy[l]; axis[2] += p.dz[l];
            if (first < 0) first = l;
            if (l / 8 == first / 8) last_in_row = l;
        }
    if (first < 0 || dot3(axis, axis) < 1e-6f) return;
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
    for (int k = 0; k < 8; ++k) { p.col_min[k] = p.row_min[k] = 1e30f; p.col_max[k] = p.row_max[k] = -1e30f; }
    for (int l = 0; l < kTile; ++l) {
        if (!(p.alive >> l & 1)) continue;
        const float d[3] = {p.dx[l], p.dy[l], p.dz[l]};
        const float depth = dot3(d, axis);
        if (depth < 0.3f) return;
        const float su = dot3(d, across) / depth, sv = dot3(d, down) / depth;
        const int c = l % 8, r = l / 8;
        p.col_min[c] = std::fmin(p.col_min[c], su); p.col_max[c] = std::fmax(p.col_max[c], su);
        p.row_min[r] = std::fmin(p.row_min[r], sv); p.row_max[r] = std::fmax(p.row_max[r], sv);
    }
    p.u_min = p.v_min = 1e30f; p.u_max = p.v_max = -1e30f;
    for (int k = 0; k < 8; ++k) {
        p.u_min = std::fmin(p.u_min, p.col_min[k]); p.u_max = std::fmax(p.u_max, p.col_max[k]);
        p.v_min = std::fmin(p.v_min, p.row_min[k]); p.v_max = std::fmax(p.v_max, p.row_max[k]);
    }
    for (int k = 0; k < 3; ++k) { p.axis[k] = axis[k]; p.u[k] = across[k]; p.v[k] = down[k]; }
    p.bounded = true;
}

struct Entry {  // on the stack: an interior node (leaf < 0) or a leaf
    int32_t node, leaf;
    float x, y, z, side;
    uint64_t rays;
};

// The eight children of a node against the pyramid: for each, the interval of slopes that its cube may cover.
struct Interval { f8 lo, hi; };

inline Interval slopes(f8 across, float radius, f8 near_inverse, f8 far_inverse) {
    const f8 lo = across - radius, hi = across + radius;
    return {lo * (lo >= 0.0f ? far_inverse : near_inverse), hi * (hi >= 0.0f ? near_inverse : far_inverse)};
}

inline uint64_t rays_inside(const Packet& p, float u_lo, float u_hi, float v_lo, float v_hi) {
    const uint64_t cols = mask_bits((load<f8>(p.col_max) >= splat8(u_lo)) & (load<f8>(p.col_min) <= splat8(u_hi)));
    const uint64_t rows = mask_bits((load<f8>(p.row_max) >= splat8(v_lo)) & (load<f8>(p.row_min) <= splat8(v_hi)));
    // Row bit r becomes byte r: first one bit in each byte, then all eight, then the columns are kept.
    const uint64_t ones = 0x0101010101010101ull, one_each = (rows * ones) & 0x8040201008040201ull;
    const uint64_t bytes = (((one_each + 0x7f7f7f7f7f7f7f7full) | one_each) >> 7 & ones) * 0xff;
    return bytes & (cols * ones);
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
        if (tree.n_nodes > 0) stack_[n_++] = {0, -1, 0, 0, 0, 1, p_.alive};
    }

    // The next leaf that some unfinished ray may meet.
    bool next(Leaf& leaf) {
        while (n_ > 0) {
            const Entry e = stack_[--n_];
            const uint64_t rays = e.rays & p_.alive;
            if (!rays) continue;
            if (e.leaf >= 0) {
                leaf = {e.leaf, e.x, e.y, e.z, e.side, rays};
                return true;
            }
            expand(e, rays);
        }
        return false;
    }

private:
    void expand(const Entry& e, uint64_t rays) {
        const float h = 0.5f * e.side;
        const uint32_t nodes = tree_.node_mask[e.node], leaves = tree_.leaf_mask[e.node];
        uint32_t present = nodes | leaves;
        Interval su, sv;
        uint32_t near = 0;  // children too close for a bound on their slopes
        if (p_.bounded) {
            const float c[3] = {e.x + 0.5f * h - p_.o[0], e.y + 0.5f * h - p_.o[1], e.z + 0.5f * h - p_.o[2]};
            const f8 a = dot3(c, p_.u) + h * off_u_, b = dot3(c, p_.v) + h * off_v_, w = dot3(c, p_.axis) + h * off_w_;
            const f8 w_near = w - (r_w_ * h + 1e-6f), w_far = w + (r_w_ * h + 1e-6f);
            present &= mask_bits(w_far > 0.0f);
            near = mask_bits(w_near < splat8(0.02f * h)) & present;
            const f8 near_inverse = 1.0f / w_near, far_inverse = 1.0f / w_far;
            su = slopes(a, r_u_ * h + 1e-6f, near_inverse, far_inverse);
            sv = slopes(b, r_v_ * h + 1e-6f, near_inverse, far_inverse);
            present &= near | mask_bits((su.hi >= p_.u_min) & (su.lo <= p_.u_max) & (sv.hi >= p_.v_min) & (sv.lo <= p_.v_max));
        }
        const uint32_t first = (p_.o[0] >= e.x + h ? 4u : 0u) | (p_.o[1] >= e.y + h ? 2u : 0u) | (p_.o[2] >= e.z + h ? 1u : 0u);
        for (int k = 7; k >= 0; --k) {  // pushed back to front
            const uint32_t o = first ^ uint32_t(k), bit = 1u << o;
            if (!(present & bit)) continue;
            uint64_t inside = rays;
            if (p_.bounded && !(near & bit)) inside &= rays_inside(p_, su.lo[o], su.hi[o], sv.lo[o], sv.hi[o]);
            if (!inside) continue;
            const float x = e.x + (o & 4 ? h : 0.0f), y = e.y + (o & 2 ? h : 0.0f), z = e.z + (o & 1 ? h : 0.0f);
            if (leaves & bit) {
                const int32_t leaf = tree_.first_leaf[e.node] + __builtin_popcount(leaves & (bit - 1));
                __builtin_prefetch(tree_.corners + 8 * int64_t(leaf));
                stack_[n_++] = {-1, leaf, x, y, z, h, inside};
            } else {
                const int32_t node = tree_.first_node[e.node] + __builtin_popcount(nodes & (bit - 1));
                __builtin_prefetch(tree_.node_mask + node);
                __builtin_prefetch(tree_.first_leaf + node);
                stack_[n_++] = {node, -1, x, y, z, h, inside};
            }
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
        hits |= uint64_t(mask_bits(tf > tn)) << base;
    }
    return hits & leaf.rays;
}

}  // namespace NERFVOL_ISA
