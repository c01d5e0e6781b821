// Random numbers that are a function of (seed, pixel, path, how many were drawn), and the functions that shape them.
#pragma once
#include <cstdint>
#include <cstring>

namespace NERFVOL_ISA::paths {

// SplitMix64 (Steele, Lea & Flood 2014): a counter, scrambled. A path's counter begins at a scrambled place of its own.
inline uint64_t mix64(uint64_t z) {
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return z ^ (z >> 31);
}

struct Random {
    uint64_t counter;
    Random(uint64_t seed, uint64_t pixel, uint64_t path)
        : counter(mix64(mix64(mix64(seed + 0xD1B54A32D192ED03u) + pixel) + path)) {}
    uint64_t bits() { return mix64(counter += 0x9E3779B97F4A7C15u); }
    // In (0, 1), never 0 or 1: 23 bits and a half.
    static float unit(uint32_t bits) { return (float(bits >> 9) + 0.5f) * 0x1p-23f; }
    float uniform() { return unit(uint32_t(bits() >> 32)); }
};

// -ln(u) for u in (0, 1): u = 2^n m with m in [sqrt(1/2), sqrt(2)), then artanh's series; absolute error 2e-7.
inline float exponential(float u) {
    int32_t i;
    std::memcpy(&i, &u, 4);
    const int32_t n = (i - 0x3f3504f3) >> 23;
    i -= n << 23;
    float m;
    std::memcpy(&m, &i, 4);
    const float s = (m - 1.0f) / (m + 1.0f), s2 = s * s;
    const float p = (((2.0f / 9.0f * s2 + 2.0f / 7.0f) * s2 + 2.0f / 5.0f) * s2 + 2.0f / 3.0f) * s2 + 2.0f;
    const float x = -(float(n) * 0.693147181f + p * s);
    return x > 0.0f ? x : 0.0f;
}

struct Turn { float cosine, sine; };

// Cosine and sine of 2 pi u: of half the angle by their series on [-pi/2, pi/2], then doubled. Error 1e-7.
inline Turn turn(float u) {
    const float a = 3.14159265f * (u - 0.5f), q = a * a;
    const float s = a * (1.0f + q * (-1.66666667e-1f + q * (8.33333310e-3f + q * (-1.98408743e-4f + q * (2.75239710e-6f - q * 2.38893047e-8f)))));
    const float c = 1.0f + q * (-0.5f + q * (4.16666642e-2f + q * (-1.38888717e-3f + q * (2.47606952e-5f - q * 2.60511611e-7f))));
    return {2.0f * s * s - 1.0f, -2.0f * s * c};  // u - 1/2 turns by half a circle
}

}  // namespace NERFVOL_ISA::paths
