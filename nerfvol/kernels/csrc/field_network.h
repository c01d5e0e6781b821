// Products of the network for packets of sixteen samples: lanes are samples, so that a row of a packet is one neuron.
//
// In float32 throughout: the processors this was measured on do bfloat16 products at half that speed, unless they have
// matrix units (AMX), which are not used.
#pragma once
#include <algorithm>
#include <new>
#include <vector>

#include "field.h"
#include "simd.h"

namespace NERFVOL_ISA {
using nerfvol::FieldLayer;
using nerfvol::FieldShape;
constexpr int kLanes = nerfvol::kFieldLanes, kBlockPackets = nerfvol::kFieldBlock / kLanes;

// Memory that begins on a cache line: a vector of 64 bytes then never lies on two.
template <class T> struct OnLines {
    typedef T value_type;
    OnLines() = default;
    template <class U> OnLines(const OnLines<U>&) {}
    T* allocate(std::size_t n) { return static_cast<T*>(::operator new(n * sizeof(T), std::align_val_t{64})); }
    void deallocate(T* p, std::size_t) { ::operator delete(p, std::align_val_t{64}); }
    template <class U> bool operator==(const OnLines<U>&) const { return true; }
    template <class U> bool operator!=(const OnLines<U>&) const { return false; }
};
typedef std::vector<float, OnLines<float>> Floats;

inline int64_t padded(int64_t n, int64_t to) { return (n + to - 1) / to * to; }

// How much of a product stays in registers: kOuts rows of kPairs packets, and kRows rows of an outer product.
#if defined(__AVX512F__)
constexpr int kOuts = 8, kPairs = 2, kRows = 16;
#elif defined(__AVX__)
constexpr int kOuts = 4, kPairs = 1, kRows = 4;
#else
constexpr int kOuts = 2, kPairs = 1, kRows = 2;
#endif

// A matrix as the products read it: eight rows at a time, one column after the other.
struct Packed {
    int in = 0, out = 0;
    Floats weights, biases;

    // Element (o, i) is at w[o * row + i * column].
    void fill(int outs, int ins, const float* w, int64_t row, int64_t column, const float* b) {
        in = ins;
        out = outs;
        weights.assign(std::size_t(padded(out, 8) * in), 0.0f);
        biases.assign(std::size_t(padded(out, 8)), 0.0f);
        for (int o = 0; o < out; ++o) {
            if (b) biases[std::size_t(o)] = b[o];
            for (int i = 0; i < in; ++i) weights[std::size_t((o / 8 * int64_t(in) + i) * 8 + o % 8)] = w[o * row + i * column];
        }
    }
};

template <int O, int P, bool Relu>
inline void product_tile(const float* w, const float* bias, int in, const float* x, int64_t xs, float* y, int64_t ys) {
    f16 sum[O][P];
    for (int o = 0; o < O; ++o)
        for (int p = 0; p < P; ++p) sum[o][p] = splat16(bias[o]);
    for (int i = 0; i < in; ++i, w += 8, x += kLanes) {
        f16 row[P];
        for (int p = 0; p < P; ++p) row[p] = load<f16>(x + p * xs);
        for (int o = 0; o < O; ++o) {
            const f16 weight = splat16(w[o]);
            for (int p = 0; p < P; ++p) sum[o][p] += weight * row[p];
        }
    }
    for (int o = 0; o < O; ++o)
        for (int p = 0; p < P; ++p) store(y + p * ys + o * kLanes, Relu ? vmax(sum[o][p], splat16(0.0f)) : sum[o][p]);
}

// y = relu?(W x + b) for `packets` packets, an even number; xs and ys are floats from one packet to the next. Rows of y are
// written up to a multiple of eight.
template <bool Relu> inline void product(const Packed& m, int outs, const float* x, int64_t xs, float* y, int64_t ys, int packets) {
    for (int o = 0; o < outs; o += 8) {
        const float* w = m.weights.data() + int64_t(o) * m.in;
        for (int p = 0; p < packets; p += kPairs)
            for (int k = 0; k < 8; k += kOuts)
                product_tile<kOuts, kPairs, Relu>(w + k, m.biases.data() + o + k, m.in, x + p * xs, xs, y + p * ys + (o + k) * kLanes, ys);
    }
}

// Sixteen rows of sixteen lanes turned over: out[lane * stride + row].
inline void transpose16(const float* in, float* out, int64_t stride) {
#if defined(__AVX512F__)
    __m512 a[16], b[16];
    for (int i = 0; i < 16; ++i) a[i] = _mm512_loadu_ps(in + 16 * i);
    for (int i = 0; i < 16; i += 2) {
        b[i] = (__m512)__builtin_shufflevector((f16)a[i], (f16)a[i + 1], 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29);
        b[i + 1] = (__m512)__builtin_shufflevector((f16)a[i], (f16)a[i + 1], 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31);
    }
    for (int i = 0; i < 16; i += 4)
        for (int k = 0; k < 2; ++k) {
            const l8 p = (l8)b[i + k], q = (l8)b[i + 2 + k];
            a[i + 2 * k] = (__m512)__builtin_shufflevector(p, q, 0, 8, 2, 10, 4, 12, 6, 14);
            a[i + 2 * k + 1] = (__m512)__builtin_shufflevector(p, q, 1, 9, 3, 11, 5, 13, 7, 15);
        }
    for (int k = 0; k < 4; ++k) {  // a[4 g + k]: rows 4 g .. 4 g + 3 of lanes k, 4 + k, 8 + k, 12 + k
        const l8 r0 = (l8)a[k], r1 = (l8)a[4 + k], r2 = (l8)a[8 + k], r3 = (l8)a[12 + k];
        const l8 lo01 = __builtin_shufflevector(r0, r1, 0, 1, 8, 9, 2, 3, 10, 11), hi01 = __builtin_shufflevector(r0, r1, 4, 5, 12, 13, 6, 7, 14, 15);
        const l8 lo23 = __builtin_shufflevector(r2, r3, 0, 1, 8, 9, 2, 3, 10, 11), hi23 = __builtin_shufflevector(r2, r3, 4, 5, 12, 13, 6, 7, 14, 15);
        store(out + (k)*stride, __builtin_shufflevector(lo01, lo23, 0, 1, 2, 3, 8, 9, 10, 11));
        store(out + (4 + k) * stride, __builtin_shufflevector(lo01, lo23, 4, 5, 6, 7, 12, 13, 14, 15));
        store(out + (8 + k) * stride, __builtin_shufflevector(hi01, hi23, 0, 1, 2, 3, 8, 9, 10, 11));
        store(out + (12 + k) * stride, __builtin_shufflevector(hi01, hi23, 4, 5, 6, 7, 12, 13, 14, 15));
    }
#else
    for (int i = 0; i < 16; i += 4)
        for (int l = 0; l < 16; l += 4) {
            const f4 a = load<f4>(in + 16 * i + l), b = load<f4>(in + 16 * i + 16 + l), c = load<f4>(in + 16 * i + 32 + l), d = load<f4>(in + 16 * i + 48 + l);
            const f4 ab0 = __builtin_shufflevector(a, b, 0, 4, 1, 5), ab1 = __builtin_shufflevector(a, b, 2, 6, 3, 7);
            const f4 cd0 = __builtin_shufflevector(c, d, 0, 4, 1, 5), cd1 = __builtin_shufflevector(c, d, 2, 6, 3, 7);
            store(out + l * stride + i, __builtin_shufflevector(ab0, cd0, 0, 1, 4, 5));
            store(out + (l + 1) * stride + i, __builtin_shufflevector(ab0, cd0, 2, 3, 6, 7));
            store(out + (l + 2) * stride + i, __builtin_shufflevector(ab1, cd1, 0, 1, 4, 5));
            store(out + (l + 3) * stride + i, __builtin_shufflevector(ab1, cd1, 2, 3, 6, 7));
        }
#endif
}

// sums[r][c] += sum over samples of a[r] b[c]: rows of a as they are, `b` turned over into `turned` first. Both are padded to
// sixteen rows; what the padding holds reaches the padding of the sums only.
inline void outer(const float* a, int64_t as, int rows, const float* b, int64_t bs, int columns, int packets, float* turned, float* sums) {
    const int64_t wide = padded(columns, 16);
    for (int p = 0; p < packets; ++p)
        for (int64_t c = 0; c < wide; c += 16) transpose16(b + p * bs + c * kLanes, turned + p * kLanes * wide + c, wide);
    for (int r = 0; r < rows; r += kRows)
        for (int64_t c = 0; c < wide; c += 16) {
            f16 sum[kRows];
            for (int k = 0; k < kRows; ++k) sum[k] = load<f16>(sums + (r + k) * wide + c);
            for (int p = 0; p < packets; ++p) {
                const float *from = a + p * as + r * kLanes, *to = turned + p * kLanes * wide + c;
                for (int s = 0; s < kLanes; ++s) {
                    const f16 v = load<f16>(to + s * wide);
                    for (int k = 0; k < kRows; ++k) sum[k] += splat16(from[k * kLanes + s]) * v;
                }
            }
            for (int k = 0; k < kRows; ++k) store(sums + (r + k) * wide + c, sum[k]);
        }
}

// Sums of a row over the samples of all packets, added lane by lane.
inline void add_rows(const float* y, int64_t ys, int rows, int packets, float* sums) {
    for (int r = 0; r < rows; ++r) {
        f16 sum = load<f16>(sums + r * kLanes);
        for (int p = 0; p < packets; ++p) sum += load<f16>(y + p * ys + r * kLanes);
        store(sums + r * kLanes, sum);
    }
}

}  // namespace NERFVOL_ISA
