// A chunk of rays through the field: they march in waves of a few samples a ray, so that little is evaluated behind what is
// opaque, and each wave goes through encoding, network and compositing before the next begins.
#pragma once
#include "arena.h"
#include "field_layers.h"
#include "field_march.h"
#include "sh_basis.h"
#include "simd_math.h"

namespace NERFVOL_ISA {
using nerfvol::FieldLoss;
using nerfvol::FieldRays;
constexpr int kRays = nerfvol::kFieldChunk;

struct ChunkRay {
    float o[3], d[3], start;          // units of the inner cube
    float trans, colour[3], depth;
    int segment;                      // the last one of its samples, -1: none
};

// Samples [start, start + count) of a ray that one wave looked at, and the segment before.
struct Segment { int start, count, before; };

// sigma's activation: raw values to optical thickness and its derivative, both of a segment of length delta.
inline void activate(const FieldShape& f, const f16& raw, const f16& length, f16& tau, f16& slope) {
    const f16 x = raw + splat16(f.density_bias);
    if (!f.softplus) {
        const f16 e = vexp(vmin(x, splat16(80.0f)));
        tau = e * length;
        slope = vmin(e, splat16(3269017.3724721107f)) * length;  // exp(15): a large value cannot overflow the step it causes
        return;
    }
    const f16 e = vexp(vmin(x, splat16(0.0f) - x));
    const f16 one = splat16(1.0f), big = one / (one + e), small = e * big;
    slope = vmax(x, splat16(0.0f)) + vlog2(one + e) * 0.6931471805599453f;
    tau = slope * length;
    slope = select_less(x, 0.0f, small, big) * length;
}

inline f16 sigmoid(const f16& x) {
    const f16 e = vexp(vmin(x, splat16(0.0f) - x)), one = splat16(1.0f), big = one / (one + e);
    return select_less(x, 0.0f, e * big, big);
}

class Chunk {
public:
    const FieldShape& f;
    Layers layers;
    int n = 0, samples = 0, used = 0;
    ChunkRay rays[kRays];
    std::vector<Segment> segments;
    // Packets: encoding (rows, 16), position (3, 16), colour (3, 16); else one number a sample.
    float *encoded = nullptr, *position = nullptr, *colour = nullptr;
    float *tau = nullptr, *slope = nullptr, *weight = nullptr, *behind = nullptr, *middle = nullptr, *length = nullptr;
    int32_t* ray = nullptr;

    Chunk(const Network& net, const FieldParameters& given, const Marcher& marcher, nerfvol::Arena& arena, bool training)
        : f(net.f), layers(net, training), table_(given.table), marcher_(marcher), arena_(arena), bits_(std::size_t(marcher.words()) * kRays) {
        basis_.resize(std::size_t(kRays * std::max(16, f.encoded_dir)));
        directions_.resize(std::size_t(kBlockPackets * kLanes * std::max(16, f.encoded_dir)));
    }

    // Rays [from, from + count).
    void forward(const FieldRays& given, int64_t from, int count, float eps) {
        begin(given, from, count);
        int live[kRays], alive = 0;
        for (int r = 0; r < n; ++r) live[alive++] = r;
        while (alive) {
            const int base = samples;
            const std::size_t first = segments.size();
            int kept = 0;
            const int wave = wave_of(alive);
            for (int i = 0; i < alive; ++i)
                if (take(live[i], wave)) live[kept++] = live[i];
            alive = kept;
            if (samples == base) break;
            fill_up();
            evaluate(base);
            kept = 0;
            std::size_t s = first;
            for (int i = 0; i < alive; ++i, ++s)
                if (composite(rays[live[i]], segments[s], eps)) live[kept++] = live[i];
            alive = kept;
        }
    }

    // The basis functions of the directions of a packet's rays, rows of sixteen; for an rgb head their encoding.
    void directions(int first, int rows, float* out) const {
        for (int k = 0; k < kLanes; ++k) {
            const float* from = basis_.data() + std::size_t(ray[first + k] * rows);
            for (int i = 0; i < rows; ++i) out[i * kLanes + k] = from[i];
        }
    }
    int direction_rows() const { return f.sh_head ? f.coefficients() : f.encoded_dir; }

private:
    const float* table_;
    const Marcher& marcher_;
    nerfvol::Arena& arena_;
    std::vector<uint64_t> bits_;
    Floats basis_, directions_;
    float *opacity_ = nullptr, *passed_ = nullptr;
    int room_ = 0;

    void begin(const FieldRays& given, int64_t from, int count) {
        n = count;
        samples = used = 0;
        segments.clear();
        for (int r = 0; r < n; ++r) {
            ChunkRay& a = rays[r];
            const float *o = given.origins + 3 * (from + r), *d = given.directions + 3 * (from + r);
            for (int axis = 0; axis < 3; ++axis) {
                a.o[axis] = (o[axis] - f.center[axis]) / f.half;
                a.d[axis] = d[axis] / f.half;
                a.colour[axis] = 0;
            }
            a.trans = 1;
            a.depth = 0;
            a.segment = -1;
            a.start = marcher_.march(a.o, a.d, given.jitter ? given.jitter[from + r] : 0.5f, bits(r));
            float* basis = basis_.data() + std::size_t(r * direction_rows());
            if (f.sh_head) sh_basis(f.sh_degree, d[0], d[1], d[2], basis);
            else encode_direction(d, basis);
        }
    }
    uint64_t* bits(int r) { return bits_.data() + std::size_t(r * marcher_.words()); }

    void encode_direction(const float* d, float* out) const {
        alignas(64) float p[3 * kLanes] = {};
        Floats rows(std::size_t(f.encoded_dir * kLanes));
        for (int axis = 0; axis < 3; ++axis) p[axis * kLanes] = d[axis];
        encode_frequencies(f.frequencies_dir, p, rows.data());
        for (int i = 0; i < f.encoded_dir; ++i) out[i] = rows[std::size_t(i * kLanes)];
    }

    // Room for so many samples, in the arena, which keeps its memory from call to call.
    void reserve(int wanted) {
        if (room_ >= wanted) return;
        const int before = room_;
        room_ = int(padded(wanted + wanted / 2, 4096));
        const auto grow = [&](float*& a, int rows) {
            float* larger = static_cast<float*>(arena_.take(std::size_t(rows) * std::size_t(room_) * sizeof(float)));
            if (before) std::memcpy(larger, a, std::size_t(rows) * std::size_t(before) * sizeof(float));
            a = larger;
        };
        grow(encoded, encoded_rows(f));
        grow(position, 3);
        grow(colour, 3);
        for (float** a : {&tau, &slope, &weight, &behind, &middle, &length, &opacity_, &passed_}) grow(*a, 1);
        int32_t* rays_of = static_cast<int32_t*>(arena_.take(std::size_t(room_) * sizeof(int32_t)));
        if (before) std::memcpy(rays_of, ray, std::size_t(before) * sizeof(int32_t));
        ray = rays_of;
    }

    void put(int r, float t, float delta) {
        const int s = samples++;
        const ChunkRay& a = rays[r];
        float* p = position + std::size_t(s / kLanes * 3 * kLanes + s % kLanes);
        for (int axis = 0; axis < 3; ++axis) p[axis * kLanes] = a.o[axis] + a.d[axis] * t;
        middle[s] = t;
        length[s] = delta;
        ray[s] = r;
        weight[s] = 0;
    }

    // Samples of each of `alive` rays: few, for most rays end within the first ones they meet; more where a wave of few rays
    // would be mostly what fills its packets up.
    static int wave_of(int alive) {
        return std::min(std::max(nerfvol::kFieldWave, nerfvol::kFieldFew / alive), nerfvol::kFieldLongest);
    }

    // The next samples of a ray, one wave's; false where there are none.
    bool take(int r, int wave) {
        reserve(samples + wave + 2 * kLanes);
        uint64_t* words = bits(r);
        const int start = samples;
        int left = wave;
        for (int w = 0; w < marcher_.words() && left; ++w)
            for (; words[w] && left; --left, words[w] &= words[w] - 1) {
                const int k = 64 * w + __builtin_ctzll(words[w]);
                put(r, rays[r].start + marcher_.middle[std::size_t(k)], marcher_.m.edges[k + 1] - marcher_.m.edges[k]);
            }
        if (samples == start) return false;
        segments.push_back({start, samples - start, rays[r].segment});
        rays[r].segment = int(segments.size()) - 1;
        return true;
    }

    // Pairs of packets are evaluated: the rest is filled with copies of the last sample, of no length and no weight.
    void fill_up() {
        const int last = samples - 1;
        while (samples % (2 * kLanes)) put(ray[last], middle[last], 0.0f);
    }

    void evaluate(int base) {
        const int64_t es = int64_t(encoded_rows(f)) * kLanes;
        for (int p = base / kLanes; p < samples / kLanes; ++p) {
            float* x = position + p * 3 * kLanes;
            to_encoding(f, x);
            encode(f, table_, x, encoded + p * es);
        }
        for (int s = base; s < samples; s += nerfvol::kFieldBlock) {
            const int packets = std::min(kBlockPackets, (samples - s) / kLanes);
            run_block(s, packets, f.n_layers - 1);
            for (int p = 0; p < packets; ++p) heads(s + p * kLanes, p);
        }
    }

public:
    // The network for a block of samples up to layer `last`; its outputs stay in `layers`.
    void run_block(int s, int packets, int last) {
        const int rows = direction_rows();
        for (int p = 0; p < packets; ++p) directions(s + p * kLanes, rows, directions_.data() + p * rows * kLanes);
        layers.run(encoded + int64_t(s / kLanes) * encoded_rows(f) * kLanes, directions_.data(), packets, last, 0);
    }
    const float* block_directions(int p) const { return directions_.data() + p * direction_rows() * kLanes; }

private:
    void heads(int s, int p) {
        const float* raw = layers.output(f.head) + p * layers.stride(f.head + 1);
        f16 t, d;
        activate(f, load<f16>(raw), load<f16>(length + s) * f.density_scale, t, d);
        store(tau + s, t);
        store(slope + s, d);
        const f16 e = vexp(splat16(0.0f) - t);
        store(passed_ + s, e);
        store(opacity_ + s, one_minus_exp(t, e));
        float* out = colour + 3 * s;
        if (!f.sh_head) {
            const float* rgb = layers.output(f.n_layers - 1) + p * layers.stride(f.n_layers);
            for (int c = 0; c < 3; ++c) store(out + c * kLanes, sigmoid(load<f16>(rgb + c * kLanes)));
            return;
        }
        const float* y = block_directions(p);
        const int k = f.coefficients();
        for (int c = 0; c < 3; ++c) {
            f16 sum = splat16(0.5f);
            for (int i = 0; i < k; ++i) sum += load<f16>(raw + (1 + c * k + i) * kLanes) * load<f16>(y + i * kLanes);
            store(out + c * kLanes, sum);
        }
    }

    // A wave's samples onto a ray; false where the ray ends. A ray ends with the sample behind which T < eps.
    bool composite(ChunkRay& a, Segment& segment, float eps) {
        for (int i = 0; i < segment.count; ++i) {
            const int s = segment.start + i;
            const float* c = colour + s / kLanes * 3 * kLanes + s % kLanes;
            const float w = a.trans * opacity_[s];
            for (int k = 0; k < 3; ++k) a.colour[k] += w * c[k * kLanes];
            a.depth += w * middle[s];
            a.trans *= passed_[s];
            weight[s] = w;
            behind[s] = a.trans;
            ++used;
            if (a.trans < eps) {
                segment.count = i + 1;
                return false;
            }
        }
        return true;
    }
};

}  // namespace NERFVOL_ISA
