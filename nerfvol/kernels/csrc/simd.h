// Short vectors in the compilers' own vector extension: one source for SSE, AVX2, AVX-512 and NEON.
//
// A vector wider than the machine's registers lives in memory when the compiler splits it, and its comparisons and shuffles
// fall apart into single numbers. So sixteen floats are one vector where registers are that wide, and else a Pair of halves.
#pragma once
#include <cstdint>
#include <cstring>
#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__wasm_simd128__)
#include <wasm_simd128.h>
#endif

namespace NERFVOL_ISA {

typedef float f4 __attribute__((vector_size(16)));
typedef float f8 __attribute__((vector_size(32)));
typedef int32_t i4v __attribute__((vector_size(16)));
typedef int32_t i8v __attribute__((vector_size(32)));
typedef int64_t l8 __attribute__((vector_size(64)));
typedef uint64_t u8l __attribute__((vector_size(64)));

// Two vectors as one of twice the width.
template <class H> struct Pair {
    H lo, hi;
    Pair& operator+=(const Pair& b) { lo += b.lo; hi += b.hi; return *this; }
    Pair& operator-=(const Pair& b) { lo -= b.lo; hi -= b.hi; return *this; }
    Pair& operator*=(const Pair& b) { lo *= b.lo; hi *= b.hi; return *this; }
};
template <class H> inline Pair<H> operator-(const Pair<H>& a) { return {-a.lo, -a.hi}; }
#define NERFVOL_PAIRWISE(op)                                                                                          \
    template <class H> inline Pair<H> operator op(const Pair<H>& a, const Pair<H>& b) { return {a.lo op b.lo, a.hi op b.hi}; } \
    template <class H> inline Pair<H> operator op(const Pair<H>& a, float b) { return {a.lo op b, a.hi op b}; }       \
    template <class H> inline Pair<H> operator op(float a, const Pair<H>& b) { return {a op b.lo, a op b.hi}; }
NERFVOL_PAIRWISE(+)
NERFVOL_PAIRWISE(-)
NERFVOL_PAIRWISE(*)
NERFVOL_PAIRWISE(/)
#undef NERFVOL_PAIRWISE

#if defined(__AVX512F__)
typedef float f16 __attribute__((vector_size(64)));
typedef int32_t i16v __attribute__((vector_size(64)));
#elif defined(__AVX__)
typedef Pair<f8> f16;
#else
typedef Pair<Pair<f4>> f16;
#endif

// The widest vector that is one register.
#if defined(__AVX512F__)
typedef f16 fwide;
#elif defined(__AVX__)
typedef f8 fwide;
#else
typedef f4 fwide;
#endif
constexpr int kWide = sizeof(fwide) / sizeof(float);

inline f4 splat4(float x) { return f4{x, x, x, x}; }
inline f8 splat8(float x) { return f8{x, x, x, x, x, x, x, x}; }
inline void splat(float x, f4& v) { v = splat4(x); }
inline void splat(float x, f8& v) { v = splat8(x); }
#if defined(__AVX512F__)
inline void splat(float x, f16& v) { v = f16{x, x, x, x, x, x, x, x, x, x, x, x, x, x, x, x}; }
#endif
template <class H> inline void splat(float x, Pair<H>& v) { splat(x, v.lo); splat(x, v.hi); }
template <class V> inline V splat(float x) { V v; splat(x, v); return v; }
inline f16 splat16(float x) { return splat<f16>(x); }

// A Pair goes half by half: as a whole GCC copies it through the stack in pieces of 16 bytes, and reading back a vector
// of 32 from those waits for all of them.
template <class V> inline void read(const void* p, V& v) { std::memcpy(&v, p, sizeof(V)); }
template <class H> inline void read(const void* p, Pair<H>& v) {
    read(p, v.lo);
    read(static_cast<const char*>(p) + sizeof(H), v.hi);
}
template <class V> inline V load(const void* p) { V v; read(p, v); return v; }
template <class V> inline void store(void* p, const V& v) { std::memcpy(p, &v, sizeof(V)); }
template <class H> inline void store(void* p, const Pair<H>& v) {
    store(p, v.lo);
    store(static_cast<char*>(p) + sizeof(H), v.hi);
}

// Keeps eight numbers in memory: broadcasting from there is one load, from a register several shuffles.
inline void keep_in_memory(float (&w)[8]) { __asm__("" : "+m"(w)); }

// a < b ? a : b and a > b ? a : b; compilers do not see the one instruction in that. (GCC warns of the unmasked forms.)
#if defined(__SSE2__)
inline f4 vmin(f4 a, f4 b) { return (f4)_mm_min_ps((__m128)a, (__m128)b); }
inline f4 vmax(f4 a, f4 b) { return (f4)_mm_max_ps((__m128)a, (__m128)b); }
#elif defined(__wasm_simd128__)  // pmin(b, a) is a < b ? a : b
inline f4 vmin(f4 a, f4 b) { return (f4)wasm_f32x4_pmin((v128_t)b, (v128_t)a); }
inline f4 vmax(f4 a, f4 b) { return (f4)wasm_f32x4_pmax((v128_t)b, (v128_t)a); }
#else
inline f4 vmin(f4 a, f4 b) { return a < b ? a : b; }
inline f4 vmax(f4 a, f4 b) { return a > b ? a : b; }
#endif
#if defined(__AVX__)
inline f8 vmin(f8 a, f8 b) { return (f8)_mm256_min_ps((__m256)a, (__m256)b); }
inline f8 vmax(f8 a, f8 b) { return (f8)_mm256_max_ps((__m256)a, (__m256)b); }
#else
inline f8 vmin(f8 a, f8 b) { return a < b ? a : b; }
inline f8 vmax(f8 a, f8 b) { return a > b ? a : b; }
#endif
#if defined(__AVX512F__)
inline f16 vmin(f16 a, f16 b) { return (f16)_mm512_maskz_min_ps(0xffff, (__m512)a, (__m512)b); }
inline f16 vmax(f16 a, f16 b) { return (f16)_mm512_maskz_max_ps(0xffff, (__m512)a, (__m512)b); }
#endif
template <class H> inline Pair<H> vmin(const Pair<H>& a, const Pair<H>& b) { return {vmin(a.lo, b.lo), vmin(a.hi, b.hi)}; }
template <class H> inline Pair<H> vmax(const Pair<H>& a, const Pair<H>& b) { return {vmax(a.lo, b.lo), vmax(a.hi, b.hi)}; }

// x < limit ? a : b, lane by lane.
template <class V> inline V select_less(const V& x, float limit, const V& a, const V& b) { return x < splat<V>(limit) ? a : b; }
template <class H> inline Pair<H> select_less(const Pair<H>& x, float limit, const Pair<H>& a, const Pair<H>& b) {
    return {select_less(x.lo, limit, a.lo, b.lo), select_less(x.hi, limit, a.hi, b.hi)};
}

// The least of eight numbers.
inline float least(f8 v) {
    v = vmin(v, __builtin_shufflevector(v, v, 4, 5, 6, 7, 0, 1, 2, 3));
    v = vmin(v, __builtin_shufflevector(v, v, 2, 3, 0, 1, 6, 7, 4, 5));
    return v[0] < v[1] ? v[0] : v[1];
}

// One bit per lane of a comparison's result.
inline uint32_t mask_bits(i4v m) {
#if defined(__SSE2__)
    return uint32_t(_mm_movemask_ps((__m128)m));
#elif defined(__wasm_simd128__)
    return wasm_i32x4_bitmask((v128_t)m);
#else
    return uint32_t(m[0] & 1) | uint32_t(m[1] & 2) | uint32_t(m[2] & 4) | uint32_t(m[3] & 8);
#endif
}
inline uint32_t mask_bits(i8v m) {
#if defined(__AVX__)
    return uint32_t(_mm256_movemask_ps((__m256)m));
#else
    uint32_t b = 0;
    for (int i = 0; i < 8; ++i) b |= uint32_t(m[i] & 1) << i;
    return b;
#endif
}

// One bit per lane in which a > b.
inline uint32_t greater_bits(f4 a, f4 b) { return mask_bits(a > b); }
inline uint32_t greater_bits(f8 a, f8 b) { return mask_bits(a > b); }
#if defined(__AVX512F__)
inline uint32_t greater_bits(f16 a, f16 b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ); }
#endif
template <class H> inline uint32_t greater_bits(const Pair<H>& a, const Pair<H>& b) {
    return greater_bits(a.lo, b.lo) | greater_bits(a.hi, b.hi) << (sizeof(H) / sizeof(float));
}

// Four floats of sixteen, from number 4 I on; sixteen from four times four.
#if defined(__AVX512F__)
template <int I> inline f4 quarter(const f16& v) {
    return __builtin_shufflevector(v, v, 4 * I, 4 * I + 1, 4 * I + 2, 4 * I + 3);
}
inline f16 join(f4 a, f4 b, f4 c, f4 d) {
    const f8 lo = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7), hi = __builtin_shufflevector(c, d, 0, 1, 2, 3, 4, 5, 6, 7);
    return __builtin_shufflevector(lo, hi, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
}
#elif defined(__AVX__)
template <int I> inline f4 quarter(const f16& v) {
    return (f4)_mm256_extractf128_ps((__m256)(I < 2 ? v.lo : v.hi), I % 2);
}
inline f16 join(f4 a, f4 b, f4 c, f4 d) {
    return {(f8)_mm256_set_m128((__m128)b, (__m128)a), (f8)_mm256_set_m128((__m128)d, (__m128)c)};
}
#else
template <int I> inline f4 quarter(const f16& v) {
    const Pair<f4>& half = I < 2 ? v.lo : v.hi;
    return I % 2 ? half.hi : half.lo;
}
inline f16 join(f4 a, f4 b, f4 c, f4 d) { return {{a, b}, {c, d}}; }
#endif

#if defined(__AVX512F__)
// As __builtin_shufflevector GCC writes v to the stack and reads 64 bytes back, which waits for the store.
inline f16 spread_by(f4 v, __m512i places) {
    return (f16)_mm512_maskz_permutexvar_ps(0xffff, places, _mm512_castps128_ps512((__m128)v));
}
#endif

// Each of v's numbers four times: a colour and a raw density over a vertex row. spread_three has v itself in the last quarter,
// where the second block of degree 2 keeps one coefficient of each channel.
inline f16 spread(f4 v) {
#if defined(__AVX512F__)
    return spread_by(v, _mm512_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3));
#else
    return join(splat4(v[0]), splat4(v[1]), splat4(v[2]), splat4(v[3]));
#endif
}
inline f16 spread_three(f4 v) {
#if defined(__AVX512F__)
    return spread_by(v, _mm512_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 0, 1, 2, 3));
#else
    return join(splat4(v[0]), splat4(v[1]), splat4(v[2]), v);
#endif
}

// Sums of each group of four.
inline f4 quad_sums(const f16& v) {
#if defined(__AVX512F__)
    f16 s = v + __builtin_shufflevector(v, v, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14);
    s += __builtin_shufflevector(s, s, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13);
    return __builtin_shufflevector(s, s, 0, 4, 8, 12);
#else
    const auto pairs = [](f4 a, f4 b) { return __builtin_shufflevector(a, b, 0, 2, 4, 6) + __builtin_shufflevector(a, b, 1, 3, 5, 7); };
    return pairs(pairs(quarter<0>(v), quarter<1>(v)), pairs(quarter<2>(v), quarter<3>(v)));
#endif
}

// The least of sixteen numbers, and of each group of four.
inline float least(const f16& v) {
    const f4 m = vmin(vmin(quarter<0>(v), quarter<1>(v)), vmin(quarter<2>(v), quarter<3>(v)));
    const f4 n = vmin(m, __builtin_shufflevector(m, m, 2, 3, 0, 1));
    return n[0] < n[1] ? n[0] : n[1];
}
inline f4 quad_least(const f16& v) {
    const auto pairs = [](f4 a, f4 b) { return vmin(__builtin_shufflevector(a, b, 0, 2, 4, 6), __builtin_shufflevector(a, b, 1, 3, 5, 7)); };
    return pairs(pairs(quarter<0>(v), quarter<1>(v)), pairs(quarter<2>(v), quarter<3>(v)));
}

template <class V> struct Integers;         // bits: sums that may run over
template <> struct Integers<f4> { typedef i4v type; typedef uint32_t bits __attribute__((vector_size(16))); };
template <> struct Integers<f8> { typedef i8v type; typedef uint32_t bits __attribute__((vector_size(32))); };
#if defined(__AVX512F__)
template <> struct Integers<f16> { typedef i16v type; typedef uint32_t bits __attribute__((vector_size(64))); };
#endif

// e^x, about 1 ulp (Cephes' polynomial); x below -87.3 gives a number below 1.3e-38 rather than exactly zero.
template <class V> inline V vexp(const V& given) {
    typedef typename Integers<V>::type I;
    const V x = vmin(vmax(given, splat<V>(-87.3f)), splat<V>(88.0f));
    V n = x * 1.44269504088896341f;
    const V magic = splat<V>(12582912.0f);  // 1.5 * 2^23: adding it rounds to an integer
    const V shifted = n + magic;
    n = shifted - magic;
    const I bits = (I)shifted - (I)magic;
    V r = x - n * 0.693359375f;
    r = r - n * -2.12194440e-4f;
    V p = splat<V>(1.9875691500e-4f);
    p = p * r + 1.3981999507e-3f;
    p = p * r + 8.3334519073e-3f;
    p = p * r + 4.1665795894e-2f;
    p = p * r + 1.6666665459e-1f;
    p = p * r + 5.0000001201e-1f;
    p = p * r * r + r + 1.0f;
    return p * (V)((bits + 127) << 23);
}
template <class H> inline Pair<H> vexp(const Pair<H>& x) { return {vexp(x.lo), vexp(x.hi)}; }

// 1 - e^-x for x >= 0 without cancellation: a Taylor polynomial below 1/4 (remainder under 2e-8), the exponential above.
template <class V> inline V one_minus_exp(const V& x, const V& exp_of_minus_x) {
    V p = splat<V>(1.0f / 5040.0f);
    p = p * -x + 1.0f / 720.0f;
    p = p * -x + 1.0f / 120.0f;
    p = p * -x + 1.0f / 24.0f;
    p = p * -x + 1.0f / 6.0f;
    p = p * -x + 0.5f;
    p = p * -x + 1.0f;
    return select_less(x, 0.25f, p * x, 1.0f - exp_of_minus_x);
}

}  // namespace NERFVOL_ISA
