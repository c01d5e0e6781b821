// Front-to-back traversal of the octree by a packet of rays that share their origin.
//
// Seen from one point the order of a node's children depends on the point alone, so one walk serves all rays of the packet
// and visits leaves in an order that is front to back for each of them. Nodes outside the packet's pyramid are skipped; a
// node whose pixels are all finished is skipped too. The exact ray-box test happens once, at the leaf.
#pragma once
#include "packet.h"

namespace NERFVOL_ISA {

using nerfvol::kMaxLevel;
using nerfvol::RowNumber;
using nerfvol::Tree;

// A leaf on the packet's way, or a node in place of its leaves (see Cell): its smallest corner, its side and the patches of
// rays that may meet it.
struct Leaf {
    int32_t index;
    float x, y, z, side;
    uint64_t patches;
};

// What a ray crosses: leaf `index`, or node `index - n_leaves` that is drawn in place of its leaves.
struct Cell {
    const int32_t* corners;
    const RowNumber* values;
};

inline Cell cell(const Tree& t, int32_t index) {
    if (index < t.n_leaves) return {t.corners + 8 * int64_t(index), t.values};
    return {t.node_corners + 8 * (index - t.n_leaves), t.node_values};
}

struct Entry {  // on the stack: interior node `index` to be opened, or cell `~index`
    int32_t index;
    float x, y, z, side;
    uint64_t patches;
};

// The eight children of a node against the pyramid: for each, the interval of slopes that its cube may cover.
struct Interval { f8 lo, hi; };

inline Interval slopes(f8 across, float radius, f8 near_inverse, f8 far_inverse) {
    const f8 lo = across - radius, hi = across + radius;
    return {lo * (lo >= 0.0f ? far_inverse : near_inverse), hi * (hi >= 0.0f ? near_inverse : far_inverse)};
}

// First and last column (or row) that an interval of slopes may meet, in 0..7; first > last: none.
struct Range { i8v first, last; };

inline Range range_of(Interval s, const Pyramid::Grid& g) {
    const f8 zero = splat8(0.0f), seven = splat8(7.0f);
    const f8 first = vmin(vmax((s.lo - g.low) * g.per_step, zero), seven) + 0.9999f;  // truncation below makes it the ceiling
    const f8 last = vmin(vmax((s.hi - g.high) * g.per_step, zero), seven);
    return {__builtin_convertvector(first, i8v), __builtin_convertvector(last, i8v)};
}

// The patches, as bits, inside the columns and rows of each of eight children, among `patches`. Returns one bit for each child
// that has any.
inline uint32_t patches_inside(Range columns, Range rows, uint64_t patches, uint64_t* inside) {
    const i8v bits = (255 << columns.first) & (255 >> (7 - columns.last));
#if defined(__AVX512F__)
    const u8l every = {~0ull, ~0ull, ~0ull, ~0ull, ~0ull, ~0ull, ~0ull, ~0ull};
    const u8l from = every << __builtin_convertvector(8 * rows.first, u8l);
    const u8l to = every >> __builtin_convertvector(56 - 8 * rows.last, u8l);
    const u8l met = (__builtin_convertvector(bits, u8l) * 0x0101010101010101ull) & from & to & patches;
    store(inside, met);
    return mask_bits(__builtin_convertvector((l8)(met != 0), i8v));
#else
    int32_t in_columns[8], first[8], last[8];
    store(in_columns, bits);
    store(first, rows.first);
    store(last, rows.last);
    uint32_t some = 0;
    for (int k = 0; k < 8; ++k) {
        const uint64_t in_rows = (~0ull << 8 * first[k]) & (~0ull >> (56 - 8 * last[k]));
        inside[k] = uint64_t(uint32_t(in_columns[k])) * 0x0101010101010101ull & in_rows & patches;
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
    Walk(const Tree& tree, const Pyramid& pyramid) : tree_(tree), p_(pyramid) {
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
            const uint64_t patches = e.patches & p_.alive;
            if (!patches) continue;
            if (e.index < 0) {
                leaf = {~e.index, e.x, e.y, e.z, e.side, patches};
                return true;
            }
            expand(e, patches);
        }
        return false;
    }

private:
    // Whether a node is so small, seen from the packet's origin, that it is not opened. The directions have no say: every
    // ray from one point sees the same cells.
    bool stands_in(float x, float y, float z, float side) const {
        const float h = 0.5f * side, to[3] = {x + h - p_.o[0], y + h - p_.o[1], z + h - p_.o[2]};
        return side * side < tree_.coarse * tree_.coarse * dot3(to, to);
    }

    // Whether some child of a node may be that small: a bound for all of them at once, from the node's centre.
    bool may_be_cut(const float* to_centre, float h) const {
        return h * h < 2 * tree_.coarse * tree_.coarse * (dot3(to_centre, to_centre) + h * h);
    }

    void expand(const Entry& e, uint64_t patches) {
        const float h = 0.5f * e.side, centre[3] = {e.x + h - p_.o[0], e.y + h - p_.o[1], e.z + h - p_.o[2]};
        const bool small = tree_.coarse > 0 && may_be_cut(centre, h);
        const uint32_t nodes = tree_.node_mask[e.index], leaves = tree_.leaf_mask[e.index];
        uint32_t present = nodes | leaves;
        alignas(64) uint64_t inside[8] = {patches, patches, patches, patches, patches, patches, patches, patches};
        if (p_.bounded) {
            const float c[3] = {centre[0] - 0.5f * h, centre[1] - 0.5f * h, centre[2] - 0.5f * h};
            const f8 a = dot3(c, p_.u) + h * off_u_, b = dot3(c, p_.v) + h * off_v_, w = dot3(c, p_.axis) + h * off_w_;
            const f8 w_near = w - (r_w_ * h + 1e-6f), w_far = w + (r_w_ * h + 1e-6f);
            // A child that reaches behind the origin has no nearest depth: its slopes end where it crosses the axis, or nowhere.
            const f8 near_inverse = w_near < splat8(0.02f * h) ? splat8(1e20f) : 1.0f / w_near, far_inverse = 1.0f / w_far;
            const Interval su = slopes(a, r_u_ * h + 1e-6f, near_inverse, far_inverse);
            const Interval sv = slopes(b, r_v_ * h + 1e-6f, near_inverse, far_inverse);
            const uint32_t some = patches_inside(range_of(su, p_.columns), range_of(sv, p_.rows), patches, inside);
            const i8v meets = (su.hi >= p_.u_min) & (su.lo <= p_.u_max) & (sv.hi >= p_.v_min) & (sv.lo <= p_.v_max);
            present &= some & mask_bits(meets & (w_far > 0.0f));
        }
        const uint32_t first = (centre[0] <= 0 ? 4u : 0u) | (centre[1] <= 0 ? 2u : 0u) | (centre[2] <= 0 ? 1u : 0u);
        uint32_t waiting = flipped(present, first);  // bit k: the k-th child on the way
        const int32_t first_leaf = tree_.first_leaf[e.index], first_node = tree_.first_node[e.index];
        while (waiting) {  // pushed back to front
            const uint32_t k = 31 - uint32_t(__builtin_clz(waiting)), o = first ^ k, bit = 1u << o;
            waiting ^= 1u << k;
            const float x = e.x + (o & 4 ? h : 0.0f), y = e.y + (o & 2 ? h : 0.0f), z = e.z + (o & 1 ? h : 0.0f);
            const bool is_leaf = leaves & bit;
            const int32_t leaf = first_leaf + __builtin_popcount(leaves & (bit - 1));
            const int32_t node = first_node + __builtin_popcount(nodes & (bit - 1));
            const bool is_cell = is_leaf || (small && stands_in(x, y, z, h));
            const int32_t index = is_leaf ? leaf : int32_t(tree_.n_leaves) + node;
            __builtin_prefetch(is_cell ? static_cast<const void*>(cell(tree_, index).corners) : tree_.first_leaf + node);
            stack_[n_++] = {is_cell ? ~index : node, x, y, z, h, inside[o]};
        }
    }

    const Tree& tree_;
    const Pyramid& p_;
    f8 off_u_, off_v_, off_w_;
    float r_u_ = 0, r_v_ = 0, r_w_ = 0;
    int n_ = 0;
    Entry stack_[8 * (kMaxLevel + 1)];
};

// Per lane: length and midpoint of the ray's way through a leaf (unit-cube distances) and the midpoint's place in it.
struct Segments {
    alignas(64) float length[kTile], middle[kTile], fx[kTile], fy[kTile], fz[kTile];
};

// Fills `s` for the rays in `lanes` and returns those that really meet the leaf.
inline uint64_t intersect(const Lanes& rays, const float* o, const Leaf& leaf, uint64_t lanes, Segments& s) {
    const float per_side = 1.0f / leaf.side;
    const float lo[3] = {leaf.x - o[0], leaf.y - o[1], leaf.z - o[2]};
    const float hi[3] = {leaf.x + leaf.side - o[0], leaf.y + leaf.side - o[1], leaf.z + leaf.side - o[2]};
    uint64_t hits = 0;
    for (int base = 0; base < kTile; base += 16) {
        if (!(lanes >> base & 0xffff)) continue;
        const f16 ix = load<f16>(rays.ix + base), iy = load<f16>(rays.iy + base), iz = load<f16>(rays.iz + base);
        const f16 ax = lo[0] * ix, bx = hi[0] * ix, ay = lo[1] * iy, by = hi[1] * iy, az = lo[2] * iz, bz = hi[2] * iz;
        const f16 tn = vmax(vmax(vmin(ax, bx), vmin(ay, by)), vmax(vmin(az, bz), splat16(0.0f)));
        const f16 tf = vmin(vmin(vmax(ax, bx), vmax(ay, by)), vmax(az, bz));
        const f16 middle = 0.5f * (tn + tf), zero = splat16(0.0f), one = splat16(1.0f);
        store(s.length + base, tf - tn);
        store(s.middle + base, middle);
        store(s.fx + base, vmin(vmax((middle * load<f16>(rays.dx + base) - lo[0]) * per_side, zero), one));
        store(s.fy + base, vmin(vmax((middle * load<f16>(rays.dy + base) - lo[1]) * per_side, zero), one));
        store(s.fz + base, vmin(vmax((middle * load<f16>(rays.dz + base) - lo[2]) * per_side, zero), one));
        hits |= uint64_t(greater_bits(tf, tn)) << base;
    }
    return hits & lanes;
}

}  // namespace NERFVOL_ISA
