// The network for a block of packets, forwards and backwards.
#pragma once
#include "field_encode.h"

namespace NERFVOL_ISA {
using nerfvol::FieldParameters;

inline int first_row(const FieldShape& f, int layer) { return layer == f.head + 1 ? 1 : 0; }  // colours leave out the raw density
inline int kept_rows(const FieldShape& f, int layer) {  // rows of a layer's input that the layer before made
    const FieldLayer& l = f.layers[layer];
    return l.in - (l.extra == nerfvol::kPosition ? f.encoded : l.extra == nerfvol::kDirection ? f.encoded_dir : 0);
}
inline int encoded_rows(const FieldShape& f) { return int(padded(f.encoded, 16)); }
inline int rows_of(const FieldShape& f, int buffer) {  // of what layer `buffer` reads, or of the last one's output
    if (buffer == 0) return encoded_rows(f);
    const int made = int(padded(f.layers[buffer - 1].out, 16));
    if (buffer == f.n_layers) return made;
    return std::max(made, int(padded(first_row(f, buffer) + padded(f.layers[buffer].in, 16), 16)));
}

// The weights as products read them; once a call.
struct Network {
    const FieldShape& f;
    std::vector<Packed> forward, back;

    Network(const FieldShape& shape, const float* numbers, bool training) : f(shape) {
        forward.resize(std::size_t(f.n_layers));
        back.resize(std::size_t(training ? f.n_layers : 0));
        for (int l = 0; l < f.n_layers; ++l) {
            const FieldLayer& a = f.layers[l];
            forward[std::size_t(l)].fill(a.out, a.in, numbers + a.weights, a.in, 1, numbers + a.biases);
            const int kept = kept_rows(f, l), all = a.extra == nerfvol::kPosition && f.hashed ? a.in : kept;
            const int rows = l || f.hashed ? all : 0;
            if (training) back[std::size_t(l)].fill(rows, a.out, numbers + a.weights, 1, a.in, nullptr);
        }
    }
};

// What one thread keeps of a block: inputs of each layer and their gradients, and sums of the weights' gradients.
struct Layers {
    const Network& net;
    const FieldShape& f;
    std::vector<Floats> x, g;
    Floats turned;

    Layers(const Network& network, bool training) : net(network), f(network.f), x(std::size_t(f.n_layers + 1)), g(training ? x.size() : 0) {
        std::size_t widest = 0;
        for (int b = 0; b <= f.n_layers; ++b) {
            const std::size_t size = std::size_t(rows_of(f, b)) * kLanes * kBlockPackets;
            widest = std::max(widest, size);
            if (b > 0) x[std::size_t(b)].assign(size, 0.0f);
            if (training) g[std::size_t(b)].assign(size, 0.0f);
        }
        turned.assign(training ? widest : 0, 0.0f);
    }

    int64_t stride(int buffer) const { return int64_t(rows_of(f, buffer)) * kLanes; }

    // e: encoded packets; dirs: their encoded directions, packets of (encoded_dir, 16), or null. last: stops behind this layer,
    // of which only `outs` rows are wanted (0: all). `packets` is even.
    void run(const float* e, const float* dirs, int packets, int last, int outs) {
        const float* in = e;
        for (int l = 0; l <= last; ++l) {
            const FieldLayer& a = f.layers[l];
            const int64_t xs = stride(l), ys = stride(l + 1);
            float* y = x[std::size_t(l + 1)].data();
            const int wanted = l == last && outs ? outs : a.out;
            const Packed& m = net.forward[std::size_t(l)];
            const float* from = in + first_row(f, l) * kLanes;
            if (a.relu) product<true>(m, wanted, from, xs, y, ys, packets);
            else product<false>(m, wanted, from, xs, y, ys, packets);
            if (l + 1 < f.n_layers && f.layers[l + 1].extra != nerfvol::kNothing) {
                const bool again = f.layers[l + 1].extra == nerfvol::kPosition;
                const int rows = again ? f.encoded : f.encoded_dir;
                const float* more = again ? e : dirs;
                const int64_t ms = again ? stride(0) : int64_t(f.encoded_dir) * kLanes;
                for (int p = 0; p < packets; ++p)
                    std::memcpy(y + p * ys + a.out * kLanes, more + p * ms, std::size_t(rows) * kLanes * sizeof(float));
            }
            in = y;
        }
    }

    const float* output(int layer) const { return x[std::size_t(layer + 1)].data(); }
    float* output_gradient(int layer) { return g[std::size_t(layer + 1)].data(); }

    // After `run` to the end and with the gradients of its outputs: adds to `sums` (gradient_floats) and writes the gradient of
    // the encoding to g[0] where it is hashed. d_raw: the raw density's gradient, a number a sample, which a network of colours
    // knows nothing of.
    void back(const float* e, int packets, float* sums, const float* d_raw) {
        float* encoding = g[0].data();
        if (f.hashed) std::fill(encoding, encoding + packets * stride(0), 0.0f);
        int64_t offset = sums_floats(f);
        for (int l = f.n_layers - 1; l >= 0; --l) {
            const FieldLayer& a = f.layers[l];
            const float* in = (l ? x[std::size_t(l)].data() : e) + first_row(f, l) * kLanes;
            float* dy = g[std::size_t(l + 1)].data();
            if (l == f.head)
                for (int p = 0; p < packets; ++p) std::memcpy(dy + p * stride(l + 1), d_raw + p * kLanes, kLanes * sizeof(float));
            const int64_t xs = stride(l), ys = stride(l + 1);
            offset -= layer_floats(a);
            if (a.out <= a.in) outer(in, xs, a.in, dy, ys, a.out, packets, turned.data(), sums + offset);
            else outer(dy, ys, a.out, in, xs, a.in, packets, turned.data(), sums + offset);
            add_rows(dy, ys, a.out, packets, sums + offset + padded(a.in, 16) * padded(a.out, 16));
            const Packed& m = net.back[std::size_t(l)];
            if (!m.out) continue;
            float* dx = g[std::size_t(l)].data() + first_row(f, l) * kLanes;
            product<false>(m, m.out, dy, ys, dx, xs, packets);
            if (l == 0) continue;
            const int kept = kept_rows(f, l), before = f.layers[l - 1].relu ? kept : 0;
            for (int p = 0; p < packets; ++p) {
                for (int r = 0; r < before * kLanes; ++r) dx[p * xs + r] = in[p * xs + r] > 0.0f ? dx[p * xs + r] : 0.0f;
                if (f.hashed && a.extra == nerfvol::kPosition) skipped(dx + p * xs + kept * kLanes, p);
            }
        }
        if (f.hashed && !skips.empty()) add_skipped(encoding, packets);
    }

    // Where the weights' sums of a layer begin: the matrix with both sides padded, then lanes of each bias.
    static int64_t layer_floats(const FieldLayer& a) { return padded(a.in, 16) * padded(a.out, 16) + padded(a.out, 16) * kLanes; }
    static int64_t sums_floats(const FieldShape& f) {
        int64_t n = 0;
        for (int l = 0; l < f.n_layers; ++l) n += layer_floats(f.layers[l]);
        return n;
    }

private:
    Floats skips;  // gradients of the encoding where a layer saw it again

    void skipped(const float* d, int p) {
        const std::size_t size = std::size_t(f.encoded) * kLanes;
        skips.resize(size * kBlockPackets);
        std::memcpy(skips.data() + std::size_t(p) * size, d, size * sizeof(float));
    }
    void add_skipped(float* encoding, int packets) {
        for (int p = 0; p < packets; ++p)
            for (int r = 0; r < f.encoded * kLanes; ++r) encoding[p * stride(0) + r] += skips[std::size_t(p * f.encoded * kLanes + r)];
    }
};

// gradient += the sums of one group of rays, for all weights and biases.
inline void add_sums(const FieldShape& f, const float* sums, float* gradient) {
    for (int l = 0; l < f.n_layers; ++l) {
        const FieldLayer& a = f.layers[l];
        const int64_t in = padded(a.in, 16), out = padded(a.out, 16);
        float* w = gradient + a.weights;
        for (int o = 0; o < a.out; ++o)
            for (int i = 0; i < a.in; ++i) w[int64_t(o) * a.in + i] += a.out <= a.in ? sums[i * out + o] : sums[o * in + i];
        const float* lanes = sums + in * out;
        for (int o = 0; o < a.out; ++o) {
            float sum = 0;
            for (int k = 0; k < kLanes; ++k) sum += lanes[o * kLanes + k];
            gradient[a.biases + o] += sum;
        }
        sums += Layers::layer_floats(a);
    }
}

}  // namespace NERFVOL_ISA
