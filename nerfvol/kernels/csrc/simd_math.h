// Mathematics on short vectors that the splats need beside simd.h: square roots, powers and logarithms of two, sums.
#pragma once
#include "simd.h"

namespace NERFVOL_ISA {
// x < limit ? a : b with a vector of limits.
template <class V> inline V select_less(const V& x, const V& limit, const V& a, const V& b) { return x < limit ? a : b; }
template <class H> inline Pair<H> select_less(const Pair<H>& x, const Pair<H>& limit, const Pair<H>& a, const Pair<H>& b) {
    return {select_less(x.lo, limit.lo, a.lo, b.lo), select_less(x.hi, limit.hi, a.hi, b.hi)};
}

// Square roots, lane by lane.
#if defined(__SSE2__)
inline f4 vsqrt(f4 v) { return (f4)_mm_sqrt_ps((__m128)v); }
#elif defined(__wasm_simd128__)
inline f4 vsqrt(f4 v) { return (f4)wasm_f32x4_sqrt((v128_t)v); }
#else
inline f4 vsqrt(f4 v) { return f4{__builtin_sqrtf(v[0]), __builtin_sqrtf(v[1]), __builtin_sqrtf(v[2]), __builtin_sqrtf(v[3])}; }
#endif
#if defined(__AVX__)
inline f8 vsqrt(f8 v) { return (f8)_mm256_sqrt_ps((__m256)v); }
#endif
#if defined(__AVX512F__)
inline f16 vsqrt(f16 v) { return (f16)_mm512_maskz_sqrt_ps(0xffff, (__m512)v); }
#endif
template <class H> inline Pair<H> vsqrt(const Pair<H>& v) { return {vsqrt(v.lo), vsqrt(v.hi)}; }

// 2^x for -126 <= x < 128, relative error 2e-7; anything for other x.
template <class V> inline V vexp2_normal(const V& x) {
    typedef typename Integers<V>::bits U;
    const V magic = splat<V>(12582912.0f);  // 1.5 * 2^23
    const V shifted = x + magic;
    const V r = x - (shifted - magic);
    V p = splat<V>(1.327648172e-03f);
    p = p * r + 9.675546330e-03f;
    p = p * r + 5.550713290e-02f;
    p = p * r + 2.402211963e-01f;
    p = p * r + 6.931469670e-01f;
    p = p * r + 1.000000072e+00f;
    return (V)((U)p + ((U)shifted << 23));   // to the exponent; what is above the integer falls off
}
#if defined(__AVX512DQ__)
inline f16 vexp2_normal(const f16& x) {  // x = floor(x) + r in one instruction each way
    const f16 r = (f16)_mm512_maskz_reduce_ps(0xffff, (__m512)x, 1);
    f16 p = splat16(1.877578051e-03f);
    p = p * r + 8.989343715e-03f;
    p = p * r + 5.582630759e-02f;
    p = p * r + 2.401536243e-01f;
    p = p * r + 6.931530715e-01f;
    p = p * r + 9.999999252e-01f;
    return (f16)_mm512_maskz_scalef_ps(0xffff, (__m512)p, (__m512)x);
}
#endif
// The same; below -126 zero or a number that small.
template <class V> inline V vexp2(const V& x) { return vexp2_normal(vmax(x, splat<V>(-126.0f))); }
template <class H> inline Pair<H> vexp2(const Pair<H>& x) { return {vexp2(x.lo), vexp2(x.hi)}; }
// log2(x) for positive normal x, absolute error 2e-7: x = 2^n m with m in [sqrt(1/2), sqrt(2)), then artanh's series.
template <class V> inline V vlog2(const V& x) {
    typedef typename Integers<V>::type I;
    const I n = ((I)x - 0x3f3504f3) >> 23;
    const V m = (V)((I)x - (n << 23));
    const V s = (m - 1.0f) / (m + 1.0f), s2 = s * s;
    V p = splat<V>(2.0f / 9.0f);
    p = p * s2 + 2.0f / 7.0f;
    p = p * s2 + 2.0f / 5.0f;
    p = p * s2 + 2.0f / 3.0f;
    p = p * s2 + 2.0f;
    return __builtin_convertvector(n, V) + p * s * 1.44269504088896341f;
}
template <class H> inline Pair<H> vlog2(const Pair<H>& x) { return {vlog2(x.lo), vlog2(x.hi)}; }

// The sum of sixteen numbers, always in the same order.
inline float sum(const f16& v) {
    const f4 q = (quarter<0>(v) + quarter<1>(v)) + (quarter<2>(v) + quarter<3>(v));
    return (q[0] + q[1]) + (q[2] + q[3]);
}

// The sums of four vectors.
inline f4 four_sums(f4 a, f4 b, f4 c, f4 d) {
    const auto pairs = [](f4 x, f4 y) { return __builtin_shufflevector(x, y, 0, 2, 4, 6) + __builtin_shufflevector(x, y, 1, 3, 5, 7); };
    return pairs(pairs(a, b), pairs(c, d));
}
#if defined(__AVX__)
inline f4 four_sums(const f8& a, const f8& b, const f8& c, const f8& d) {
    const auto pairs = [](f8 x, f8 y) {      // within each half: no register is crossed
        return __builtin_shufflevector(x, y, 0, 2, 8, 10, 4, 6, 12, 14) + __builtin_shufflevector(x, y, 1, 3, 9, 11, 5, 7, 13, 15);
    };
    const f8 sums = pairs(pairs(a, b), pairs(c, d));
    return (f4)_mm256_castps256_ps128((__m256)sums) + (f4)_mm256_extractf128_ps((__m256)sums, 1);
}
#endif
#if defined(__AVX512F__)
inline f4 four_sums(const f16& a, const f16& b, const f16& c, const f16& d) {
    const auto fold = [](const f16& v) { return (quarter<0>(v) + quarter<1>(v)) + (quarter<2>(v) + quarter<3>(v)); };
    return four_sums(fold(a), fold(b), fold(c), fold(d));
}
#endif

// The largest of a vector's numbers.
inline float largest_of(f4 v) {
    v = vmax(v, __builtin_shufflevector(v, v, 2, 3, 0, 1));
    return v[0] > v[1] ? v[0] : v[1];
}
#if defined(__AVX__)
inline float largest_of(const f8& v) { return -least(-v); }
#endif
#if defined(__AVX512F__)
inline float largest_of(const f16& v) { return -least(-v); }
#endif

}  // namespace NERFVOL_ISA
