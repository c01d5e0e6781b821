// What a chunk of rays misses its targets by, and the derivatives: of each sample's raw density and colour, then through the
// network. One adjoint serves all terms: v_i = dL/dw_i, dL/dtau_i = T_{i+1} v_i - sum_{j>i} w_j v_j - T_N dL/dT_N.
#pragma once
#include "field_chunk.h"

namespace NERFVOL_ISA {

struct ChunkLoss { double squared_error = 0, loss = 0; };

// Gradients of a chunk's samples: d_raw a number each, d_colour packets of (3, 16).
struct SampleGradients { Floats raw, colour; };

// The distances between samples count in edges of the inner cube.
inline void distortion_totals(const Chunk& c, const ChunkRay& a, float unit, float& mass, float& moment) {
    mass = moment = 0;
    for (int g = a.segment; g >= 0; g = c.segments[std::size_t(g)].before) {
        const Segment& segment = c.segments[std::size_t(g)];
        for (int s = segment.start; s < segment.start + segment.count; ++s) {
            mass += c.weight[s];
            moment += c.weight[s] * c.middle[s] * unit;
        }
    }
}

inline ChunkLoss adjoint_of_ray(const Chunk& c, const ChunkRay& a, const float* target, const FieldLoss& loss, int64_t n_rays, SampleGradients& out) {
    const float pixel = 1.0f / (3.0f * float(n_rays)), ray = 1.0f / float(n_rays), unit = 1.0f / (2.0f * c.f.half);
    ChunkLoss sum;
    float g[3], beyond = 0, apart = 0;
    for (int k = 0; k < 3; ++k) {
        const float error = a.colour[k] + a.trans * loss.background[k] - target[k], off = loss.background[k] - target[k];
        sum.squared_error += double(error) * error;
        g[k] = 2 * error * pixel;
        beyond += g[k] * loss.background[k];
        apart += off * off;
    }
    sum.loss = sum.squared_error * pixel + double(loss.colour * pixel) * apart * a.trans;
    beyond += loss.colour * pixel * apart;
    if (loss.entropy > 0) {
        const float t = std::min(std::max(a.trans, 1e-4f), 1.0f - 1e-4f);
        sum.loss -= double(loss.entropy * ray) * (t * std::log(t) + (1 - t) * std::log(1 - t));
        if (t == a.trans) beyond += loss.entropy * ray * (std::log(1 - t) - std::log(t));
    }
    float mass = 0, moment = 0, mass_behind = 0, moment_behind = 0;
    if (loss.distortion > 0) distortion_totals(c, a, unit, mass, moment);
    const float own = loss.colour * pixel;
    float later = a.trans * beyond;
    for (int index = a.segment; index >= 0; index = c.segments[std::size_t(index)].before) {
        const Segment& segment = c.segments[std::size_t(index)];
        for (int s = segment.start + segment.count - 1; s >= segment.start; --s) {
            const std::size_t i = std::size_t(s);
            const std::size_t at = std::size_t(s / kLanes * 3 * kLanes + s % kLanes);
            const float w = c.weight[i];
            float v = 0, off = 0;
            for (int k = 0; k < 3; ++k) {
                const float rgb = c.colour[at + std::size_t(k * kLanes)], d = rgb - target[k];
                v += g[k] * rgb;
                off += d * d;
                out.colour[at + std::size_t(k * kLanes)] = w * (g[k] + 2 * own * d);
            }
            v += own * off;
            sum.loss += double(own) * w * off;
            if (loss.distortion > 0) {
                const float m = c.middle[i] * unit, before = mass - mass_behind - w, moment_before = moment - moment_behind - w * m;
                const float far = m * before - moment_before + moment_behind - m * mass_behind, wide = w * c.length[i] * unit / 3;
                v += loss.distortion * ray * 2 * (far + wide);
                sum.loss += double(loss.distortion * ray) * w * (far + wide);
                mass_behind += w;
                moment_behind += w * m;
            }
            out.raw[i] = (c.behind[i] * v - later) * c.slope[i];
            later += w * v;
        }
    }
    return sum;
}

inline ChunkLoss adjoint(const Chunk& c, const FieldRays& rays, int64_t from, const FieldLoss& loss, SampleGradients& out) {
    out.raw.assign(std::size_t(c.samples), 0.0f);  // what lies behind the end of its ray has no part in anything
    out.colour.assign(std::size_t(3 * c.samples), 0.0f);
    ChunkLoss sum;
    for (int r = 0; r < c.n; ++r) {
        const ChunkLoss one = adjoint_of_ray(c, c.rays[r], rays.target + 3 * (from + r), loss, rays.n, out);
        sum.squared_error += one.squared_error;
        sum.loss += one.loss;
    }
    return sum;
}

// Decorrelated bits of a number [Wellons 2018, lowbias32].
inline uint32_t scrambled(uint32_t x) {
    x = (x ^ x >> 16) * 0x7feb352du;
    x = (x ^ x >> 15) * 0x846ca68bu;
    return x ^ x >> 16;
}

// How much of a sample's gradient goes backwards, by Russian roulette [Arvo and Kirk 1990]: one below `least` stays with a
// probability in proportion to it and is then as large as `least`, so that the sum's expectation is what it was.
struct Roulette {
    float least = 0;
    uint32_t seed = 0;

    float factor(float size, int sample) const {
        if (size >= least) return 1.0f;
        const float draw = float(scrambled(seed + uint32_t(sample)) >> 8) * (1.0f / 16777216.0f);
        return draw * least < size ? least / size : 0.0f;
    }
};

inline float gradient_size(const SampleGradients& d, int s) {
    const float* colour = d.colour.data() + s / kLanes * 3 * kLanes + s % kLanes;
    return std::max(std::max(std::fabs(d.raw[std::size_t(s)]), std::fabs(colour[0])), std::max(std::fabs(colour[kLanes]), std::fabs(colour[2 * kLanes])));
}

// Takes out of the chunk, in place, what lies behind the end of its ray and what the roulette leaves out: more than half of the
// samples. Of a chunk's rays half of the samples have a fiftieth of the gradient.
inline void drop_unused(Chunk& c, SampleGradients& d, float negligible, uint32_t seed) {
    Roulette roulette;
    roulette.seed = seed;
    if (negligible > 0) {
        double sizes = 0;
        for (const Segment& segment : c.segments)
            for (int s = segment.start; s < segment.start + segment.count; ++s) sizes += gradient_size(d, s);
        roulette.least = negligible * float(sizes / std::max(c.used, 1));
    }
    const int rows = encoded_rows(c.f), before = c.samples;
    int to = 0;
    const auto move = [&](int s, float factor) {
        const auto at = [](int sample, int of, int row) { return (std::size_t(sample / kLanes * of) + std::size_t(row)) * kLanes + std::size_t(sample % kLanes); };
        for (int i = 0; i < rows && s != to; ++i) c.encoded[at(to, rows, i)] = c.encoded[at(s, rows, i)];
        for (int k = 0; k < 3; ++k) {
            c.position[at(to, 3, k)] = c.position[at(s, 3, k)];
            c.colour[at(to, 3, k)] = c.colour[at(s, 3, k)];
            d.colour[at(to, 3, k)] = factor * d.colour[at(s, 3, k)];
        }
        d.raw[std::size_t(to)] = factor * d.raw[std::size_t(s)];
        c.ray[to++] = c.ray[s];
    };
    for (const Segment& segment : c.segments)
        for (int s = segment.start; s < segment.start + segment.count; ++s) {
            const float factor = roulette.least > 0 ? roulette.factor(gradient_size(d, s), s) : 1.0f;
            if (factor != 0.0f) move(s, factor);
        }
    if (to == 0 && before) move(0, 0.0f);
    for (const int last = to - 1; to % (2 * kLanes) && to < before;) {  // whole pairs of packets
        move(last, 1.0f);
        d.raw[std::size_t(to - 1)] = 0;
        for (int k = 0; k < 3; ++k) d.colour[std::size_t(((to - 1) / kLanes * 3 + k) * kLanes + (to - 1) % kLanes)] = 0;
    }
    c.samples = to;
}

// The network again, block by block, and backwards; `encoding` gets the gradient of the encoding, packets of
// (features, 16) for each level, or null.
inline void network_adjoint(Chunk& c, const SampleGradients& d, float* sums, float* encoding) {
    const FieldShape& f = c.f;
    Layers& layers = c.layers;
    const int64_t es = int64_t(encoded_rows(f)) * kLanes;
    for (int s = 0; s < c.samples; s += nerfvol::kFieldBlock) {
        const int packets = std::min(kBlockPackets, (c.samples - s) / kLanes);
        c.run_block(s, packets, f.n_layers - 2);  // what the last layer made is not asked for
        for (int p = 0; p < packets; ++p) {
            const int at = s + p * kLanes;
            const float* colour = d.colour.data() + 3 * at;
            if (f.sh_head) {
                float* raw = layers.output_gradient(f.head) + p * layers.stride(f.head + 1);
                const float* y = c.block_directions(p);
                const int k = f.coefficients();
                for (int channel = 0; channel < 3; ++channel)
                    for (int i = 0; i < k; ++i)
                        store(raw + (1 + channel * k + i) * kLanes, load<f16>(colour + channel * kLanes) * load<f16>(y + i * kLanes));
            } else {
                float* rgb = layers.output_gradient(f.n_layers - 1) + p * layers.stride(f.n_layers);
                for (int channel = 0; channel < 3; ++channel) {
                    const f16 v = load<f16>(c.colour + 3 * at + channel * kLanes);
                    store(rgb + channel * kLanes, load<f16>(colour + channel * kLanes) * v * (1.0f - v));
                }
            }
        }
        const float* e = c.encoded + s / kLanes * es;
        layers.back(e, packets, sums, d.raw.data() + s);
        const std::size_t row = std::size_t(f.features * kLanes);
        for (int p = 0; p < packets && encoding; ++p)
            for (int level = 0; level < f.active; ++level)
                std::memcpy(encoding + (std::size_t(level) * std::size_t(c.samples / kLanes) + std::size_t(s / kLanes + p)) * row,
                            layers.g[0].data() + p * es + int64_t(level) * int64_t(row), row * sizeof(float));
    }
}

}  // namespace NERFVOL_ISA
