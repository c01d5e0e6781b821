// Adam on what a step has touched: numbers whose gradient is zero stay as they are, moments included [Mueller et al. 2022].
#pragma once
#include <algorithm>
#include <cmath>

#include "field.h"
#include "simd_math.h"

namespace NERFVOL_ISA {

struct AdamStep {
    float rate, beta1, beta2, eps, decay, scale2;  // scale2: 1 / (1 - beta2^n); the other correction is in the rate

    AdamStep(const nerfvol::FieldRates& r, float with_decay, int64_t n)
        : rate(float(double(r.rate) / (1.0 - std::pow(double(r.beta1), double(n))))), beta1(r.beta1), beta2(r.beta2), eps(r.eps), decay(with_decay),
          scale2(float(1.0 / (1.0 - std::pow(double(r.beta2), double(n))))) {}
};

// Whether one of sixteen gradients is not zero.
inline bool has_gradient(const float* d) {
    uint64_t any = 0;
    for (int k = 0; k < 16; k += 2) {
        uint64_t two;
        std::memcpy(&two, d + k, 8);
        any |= two;
    }
    return any & 0x7fffffff7fffffffull;  // -0 is zero too
}

// One line of sixteen numbers. Vectors by hand: of the same in single numbers GCC makes sixteen branches.
inline void adam_line(float* p, float* m, float* v, float* d, const AdamStep& a) {
    for (int k = 0; k < 16; k += kWide) {
        const fwide value = load<fwide>(p + k), first = load<fwide>(m + k), second = load<fwide>(v + k), given = load<fwide>(d + k);
        const fwide g = given + a.decay * value;
        const fwide m1 = a.beta1 * first + (1.0f - a.beta1) * g, v1 = a.beta2 * second + (1.0f - a.beta2) * g * g;
        const fwide moved = value - a.rate * m1 / (vsqrt(v1 * a.scale2) + a.eps);
        const auto touched = given != splat<fwide>(0.0f);
        store(p + k, touched ? moved : value);
        store(m + k, touched ? m1 : first);
        store(v + k, touched ? v1 : second);
        store(d + k, splat<fwide>(0.0f));
    }
}

// The last numbers, fewer than sixteen.
inline void adam_rest(float* p, float* m, float* v, float* d, int count, const AdamStep& a) {
    float line[4][16] = {};
    float* of[4] = {p, m, v, d};
    for (int k = 0; k < 4; ++k) std::copy(of[k], of[k] + count, line[k]);
    adam_line(line[0], line[1], line[2], line[3], a);
    for (int k = 0; k < 4; ++k) std::copy(line[k], line[k] + count, of[k]);
}

// Moves n numbers and zeroes their gradients; the decay is added to the gradient [L2 in Adam, not AdamW].
//
// Few lines of a level have a gradient: those of 64 are found first and all that they need is asked for, then they are moved.
inline void adam(float* value, float* first, float* second, float* gradient, int64_t n, const AdamStep& a) {
    const int64_t whole = n / 16 * 16;
    for (int64_t from = 0; from < whole; from += 64 * 16) {
        const int64_t to = std::min(whole, from + 64 * 16);
        uint64_t touched = 0;
        for (int64_t i = from; i < to; i += 16) {
            if (!has_gradient(gradient + i)) continue;
            touched |= uint64_t(1) << (i - from) / 16;
            __builtin_prefetch(value + i, 1);
            __builtin_prefetch(first + i, 1);
            __builtin_prefetch(second + i, 1);
        }
        for (; touched; touched &= touched - 1) {
            const int64_t i = from + 16 * __builtin_ctzll(touched);
            adam_line(value + i, first + i, second + i, gradient + i, a);
        }
    }
    if (whole < n) adam_rest(value + whole, first + whole, second + whole, gradient + whole, int(n - whole), a);
}

}  // namespace NERFVOL_ISA
