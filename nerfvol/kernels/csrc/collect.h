// From a leaf's hits to a picture: a queue of them, and what their rays gather.
#pragma once
#include <algorithm>

#include "composite.h"

namespace NERFVOL_ISA {

using nerfvol::RenderOptions;
using nerfvol::RenderOutput;

// Hits that wait to be composited, front to back: extinction is expensive and worked out for sixteen at a time, while a leaf
// is met by three rays on average. A ray that ends leaves a few hits behind here, which are dropped.
struct Waiting {
    static constexpr int kCapacity = 2 * kTile;  // small, to stay in the core's nearest cache
    int first = 0, end = 0;
    int32_t lane[kCapacity];
    f4 value[kCapacity];                   // r, g, b, distance
    float raw[kCapacity + 16], length[kCapacity + 16];  // read sixteen at a time, a few beyond the end
    float slope[kCapacity][3];             // of the raw density, for normals

    int size() const { return end - first; }

    // Makes room for a strip's hits behind those that wait.
    void make_room(bool with_slopes) {
        if (end + kTile <= kCapacity) return;
        const auto forward = [&](auto* rows) { std::memmove(rows, rows + first, size() * sizeof(*rows)); };
        forward(lane); forward(value); forward(raw); forward(length);
        if (with_slopes) forward(slope);
        end -= first;
        first = 0;
    }
};

// What a packet's rays gather besides colour.
template <int S> struct Extras {
    float median[S * kTile] = {}, normal[S * kTile][3] = {};
};

inline void add_normal(const float* slope, float w, float* normal) {
    const float norm = std::sqrt(dot3(slope, slope));
    if (norm > 1e-12f)
        for (int k = 0; k < 3; ++k) normal[k] -= w * slope[k] / norm;
}

// Distance at which the transmittance falls to 1/2 inside a segment that starts with more and ends with less.
inline float median_distance(float before, float raw, float length, float middle, float density_scale) {
    const float tau = length * density_scale * (raw < 1.0f ? std::exp(raw - 1.0f) : raw);
    const float f = tau > 0 ? std::log(2.0f * before) / tau : 0.0f;
    return middle + (f - 0.5f) * length;
}

// Composites the first `m` <= 64 of the hits that wait.
template <int S>
void composite(const Tree& tree, Packet<S>& p, const RenderOptions& options, const RenderOutput& out, Waiting& waiting, int m,
               PacketState<S>& state, Extras<S>& extras) {
    Extinction x;
    x.evaluate(waiting.raw + waiting.first, waiting.length + waiting.first, m, tree.density_scale, false);
    const bool with_median = out.median_depth, with_normal = out.normal;
    bool some_end = false;
    for (int i = 0, j = waiting.first; i < m; ++i, ++j) {
        const int l = waiting.lane[j];
        uint64_t& alive = p.strips[l / kTile].alive;
        if (!(alive >> l % kTile & 1)) continue;
        const float before = state.trans[l], after = before * x.through[i], w = before * x.alpha[i];
        state.colour[l] += w * waiting.value[j];
        state.trans[l] = after;
        if (with_median && before > 0.5f && after <= 0.5f)
            extras.median[l] = median_distance(before, waiting.raw[j], waiting.length[j], waiting.value[j][3], tree.density_scale);
        if (with_normal) add_normal(waiting.slope[j], w, extras.normal[l]);
        if (after < options.early_stop_eps) {
            alive &= ~(1ull << l % kTile);
            some_end = true;
        }
    }
    if (some_end) p.find_alive();
    waiting.first += m;
}

// Puts a leaf's hits in the queue and composites them by sixteens: value_of(x, y, z, strip, lane), slope_of(x, y, z, slope).
template <int S> struct Collector {
    const Tree& tree;
    Packet<S>& packet;
    const RenderOptions& options;
    const RenderOutput& out;
    Waiting waiting;
    PacketState<S> state;
    Extras<S> extras;

    template <class Value, class Slope> void collect(const uint64_t* hits, const Segments* segments, Value&& value_of, Slope&& slope_of) {
        for (int s = 0; s < S; ++s) {
            if (!hits[s]) continue;
            const Segments& at = segments[s];
            waiting.make_room(out.normal);
            int i = waiting.end;
            for (uint64_t h = hits[s]; h; h &= h - 1, ++i) {
                const int l = __builtin_ctzll(h);
                f4 value = value_of(at.fx[l], at.fy[l], at.fz[l], s, l);
                waiting.lane[i] = s * kTile + l;
                waiting.raw[i] = value[3];
                value += 0.5f;
                value[3] = at.middle[l] * tree.size;
                waiting.value[i] = value;
                waiting.length[i] = at.length[l] * tree.size;
                if (out.normal) slope_of(at.fx[l], at.fy[l], at.fz[l], waiting.slope[i]);
            }
            waiting.end = i;
            if (waiting.size() >= 16) composite_first(std::min(waiting.size() & ~15, kTile));
        }
    }
    void composite_first(int m) { composite(tree, packet, options, out, waiting, m, state, extras); }
};

}  // namespace NERFVOL_ISA
