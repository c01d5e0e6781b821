// Short vectors in the compilers' own vector extension: one source for SSE, AVX2, AVX-512 and NEON.
#pragma once
#include <cstdint>
#include <cstring>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace NERFVOL_ISA {

typedef float f8 __attribute__((vector_size(32)));
typedef int32_t i8v __attribute__((vector_size(32)));
typedef float f16 __attribute__((vector_size(64)));
typedef int32_t i16v __attribute__((vector_size(64)));
typedef int64_t l8 __attribute__((vector_size(64)));
typedef uint64_t u8l __attribute__((vector_size(64)));

inline f8 splat8(float x) { return f8{x, x, x, x, x, x, x, x}; }
inline f16 splat16(float x) { return f16{x, x, x, x, x, x, x, x, x, x, x, x, x, x, x, x}; }

template <class V> inline V load(const void* p) { V v; std::memcpy(&v, p, sizeof(V)); return v; }
template <class V> inline void store(void* p, const V& v) { std::memcpy(p, &v, sizeof(V)); }

// Keeps eight numbers in memory: broadcasting from there is one load, from a register several shuffles.
inline void keep_in_memory(float (&w)[8]) { __asm__("" : "+m"(w)); }

// a < b ? a : b and a > b ? a : b; compilers do not see the one instruction in that. (GCC warns of the unmasked forms.)
#if defined(__AVX512F__)
inline f16 vmin(f16 a, f16 b) { return (f16)_mm512_maskz_min_ps(0xffff, (__m512)a, (__m512)b); }
inline f16 vmax(f16 a, f16 b) { return (f16)_mm512_maskz_max_ps(0xffff, (__m512)a, (__m512)b); }
#else
inline f16 vmin(f16 a, f16 b) { return a < b ? a : b; }
inline f16 vmax(f16 a, f16 b) { return a > b ? a : b; }
#endif
#if defined(__AVX__)
inline f8 vmin(f8 a, f8 b) { return (f8)_mm256_min_ps((__m256)a, (__m256)b); }
inline f8 vmax(f8 a, f8 b) { return (f8)_mm256_max_ps((__m256)a, (__m256)b); }
#else
inline f8 vmin(f8 a, f8 b) { return a < b ? a : b; }
inline f8 vmax(f8 a, f8 b) { return a > b ? a : b; }
#endif

// One bit per lane of a comparison's result.
inline uint32_t mask_bits(i8v m) {
#if defined(__AVX__)
    return uint32_t(_mm256_movemask_ps((__m256)m));
#else
    uint32_t b = 0;
    for (int i = 0; i < 8; ++i) b |= uint32_t(m[i] & 1) << i;
    return b;
#endif
}
inline uint32_t mask_bits(i16v m) {
#if defined(__AVX512DQ__)
    return uint32_t(_mm512_movepi32_mask((__m512i)m));
#else
    i8v lo, hi;
    std::memcpy(&lo, &m, 32);
    std::memcpy(&hi, reinterpret_cast<const char*>(&m) + 32, 32);
    return mask_bits(lo) | (mask_bits(hi) << 8);
#endif
}

// e^x, about 1 ulp (Cephes' polynomial); x below -87.3 gives a number below 1.3e-38 rather than exactly zero.
inline f16 exp16(f16 x) {
    x = vmin(vmax(x, splat16(-87.3f)), splat16(88.0f));
    f16 n = x * 1.44269504088896341f;
    const f16 magic = splat16(12582912.0f);  // 1.5 * 2^23: adding it rounds to an integer
    const f16 shifted = n + magic;
    n = shifted - magic;
    i16v bits = (i16v)shifted - (i16v)magic;
    f16 r = x - n * 0.693359375f;
    r = r - n * -2.12194440e-4f;
    f16 p = splat16(1.9875691500e-4f);
    p = p * r + 1.3981999507e-3f;
    p = p * r + 8.3334519073e-3f;
    p = p * r + 4.1665795894e-2f;
    p = p * r + 1.6666665459e-1f;
    p = p * r + 5.0000001201e-1f;
    p = p * r * r + r + 1.0f;
    return p * (f16)((bits + 127) << 23);
}

// 1 - e^-x for x >= 0 without cancellation: a Taylor polynomial below 1/4 (remainder under 2e-8), the exponential above.
inline f16 one_minus_exp(f16 x, f16 exp_of_minus_x) {
    f16 p = splat16(1.0f / 5040.0f);
    p = p * -x + 1.0f / 720.0f;
    p = p * -x + 1.0f / 120.0f;
    p = p * -x + 1.0f / 24.0f;
    p = p * -x + 1.0f / 6.0f;
    p = p * -x + 0.5f;
    p = p * -x + 1.0f;
    return x < 0.25f ? p * x : 1.0f - exp_of_minus_x;
}

// Sums of each group of four, repeated in the group.
inline f16 quad_sums(f16 v) {
    f16 s = v + __builtin_shufflevector(v, v, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14);
    return s + __builtin_shufflevector(s, s, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13);
}

}  // namespace NERFVOL_ISA
