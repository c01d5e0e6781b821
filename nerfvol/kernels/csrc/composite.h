// Emission-absorption quadrature along the rays of one packet, and its adjoint, side by side.
//
// Forward:  alpha = 1 - exp(-tau), w = T alpha, C += w c, T *= exp(-tau).
// Adjoint:  with q = dL/dw of a segment and S the sum of w q behind it (plus T_N q_N),
//           dL/dtau = T_after q - S,  dL/dc = w dL/dC + ...   [Max 95; docs/mathematics.md]
// A packet's segments are kept, in the order of the walk, for as long as the adjoint needs them: some 50 kB that stay in
// the core's own cache, where a second traversal would cost more than it saves.
#pragma once
#include <vector>

#include "shade.h"

namespace NERFVOL_ISA {

// One segment: a ray in a leaf.
struct Hit {
    f4 value;                      // r, g, b (without 1/2), raw density
    float fx, fy, fz;              // place in the leaf
    float length;                  // scene units
    float weight, trans_after, middle;
    float tau_slope;               // d tau / d raw
    int32_t lane;
};

struct Visit {                     // a leaf and its hits, consecutive in the packet's list
    int32_t leaf, n_hits;
    float max_weight, error, near;
    float side;
};

template <int S> struct PacketState {
    alignas(64) float trans[S * kTile];
    f4 colour[S * kTile];          // r, g, b, expected distance

    PacketState() {
        for (int l = 0; l < S * kTile; ++l) { trans[l] = 1.0f; colour[l] = f4{}; }
    }
};

// Slope of the optical depth in the raw density, exp(-tau) and alpha of up to 64 hits.
struct Extinction {
    alignas(64) float slope[kTile], through[kTile], alpha[kTile];

    // Of n hits; raw and length (scene units) are read up to the next multiple of 16.
    void evaluate(const float* raw, const float* length, int n, float density_scale, bool with_slope) {
        for (int i = 0; i < n; i += 16) {
            const f16 r = load<f16>(raw + i), scaled = load<f16>(length + i) * density_scale;
            const f16 tau = scaled * explin(r), e = vexp(-tau);
            store(through + i, e);
            store(alpha + i, one_minus_exp(tau, e));
            if (with_slope) store(slope + i, scaled * explin_slope(r));
        }
    }
};

// The segments of one packet, delivered leaf by leaf: sink(leaf, hits, segments, cell), the hits as bits and the segments by
// strip. Leaves wait in a queue while their memory arrives: the walk asks for a leaf's corners, kRows leaves later the corners
// are read and their rows asked for, kAhead leaves later it is used. Returns how many leaves were tested against the rays.
template <int B, int S, class Sink> int64_t march(const Tree& tree, const Packet<S>& p, Sink&& sink) {
    constexpr uint32_t kAhead = 16, kRows = 8;
    Walk walk(tree, p.pyramid);
    Leaf queue[kAhead];
    uint32_t found = 0, asked = 0, used = 0;
    const auto ask = [&] {
        const Cell c = cell(tree, queue[asked++ % kAhead].index);
        for (int o = 0; o < 8; ++o)
            for (int k = 0; k < B; ++k) __builtin_prefetch(c.values + 16 * (B * int64_t(c.corners[o]) + k));
    };
    Segments segments[S];
    int64_t tested = 0;
    for (;;) {
        while (found - used < kAhead && walk.next(queue[found % kAhead])) {
            ++found;
            if (found - asked > kRows) ask();
        }
        if (found == used) return tested;
        if (found - used < kAhead)
            while (asked != found) ask();
        Leaf& leaf = queue[used++ % kAhead];
        leaf.patches &= p.pyramid.alive;
        if (!leaf.patches) continue;
        ++tested;
        uint64_t hits[S], some = 0;
        for (int s = 0; s < S; ++s) {
            const uint64_t lanes = Packet<S>::lanes_of(leaf.patches, s) & p.strips[s].alive;
            hits[s] = lanes ? intersect(p.strips[s], p.pyramid.o, leaf, lanes, segments[s]) : 0;
            some |= hits[s];
        }
        if (!some) continue;
        const Cell c = cell(tree, leaf.index);
        sink(leaf, hits, segments, c);
    }
}

}  // namespace NERFVOL_ISA
