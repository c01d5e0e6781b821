// Adam on what a step has touched: numbers whose gradient is zero stay as they are, moments included [Mueller et al. 2022].
#pragma once
#include <algorithm>
#include <cmath>

#include "field.h"
#include "simd.h"

namespace NERFVOL_ISA {

struct AdamStep {
    float rate, beta1, beta2, eps, decay, scale2;  // scale2: 1 / (1 - beta2^n); the other correction is in the rate

    AdamStep(const nerfvol::FieldRates& r, float with_decay, int64_t n)
        : rate(float(double(r.rate) / (1.0 - std::pow(double(r.beta1), double(n))))), beta1(r.beta1), beta2(r.beta2), eps(r.eps), decay(with_decay),
          scale2(float(1.0 / (1.0 - std::pow(double(r.beta2), double(n))))) {}
};

inline bool has_gradient(const float* d, int count) {
    uint32_t any = 0;
    for (int k = 0; k < count; ++k) {
        uint32_t bits;
        std::memcpy(&bits, d + k, 4);
        any |= bits << 1;  // -0 is zero too
    }
    return any;
}

// One line of up to sixteen numbers; of exactly so many the loop becomes vectors.
template <bool Whole> inline void adam_line(float* p, float* m, float* v, float* d, int count, const AdamStep& a) {
    for (int k = 0; k < (Whole ? 16 : count); ++k) {
        const float g = d[k] + a.decay * p[k];
        const float m1 = a.beta1 * m[k] + (1.0f - a.beta1) * g, v1 = a.beta2 * v[k] + (1.0f - a.beta2) * g * g;
        const float moved = p[k] - a.rate * m1 / (std::sqrt(v1 * a.scale2) + a.eps);
        const bool touched = d[k] != 0.0f;
        p[k] = touched ? moved : p[k];
        m[k] = touched ? m1 : m[k];
        v[k] = touched ? v1 : v[k];
        d[k] = 0.0f;
    }
}

// Moves n numbers and zeroes their gradients; the decay is added to the gradient [L2 in Adam, not AdamW].
//
// Few lines of a level have a gradient: those of 64 are found first and all that they need is asked for, then they are moved.
inline void adam(float* value, float* first, float* second, float* gradient, int64_t n, const AdamStep& a) {
    for (int64_t from = 0; from < n; from += 64 * 16) {
        const int64_t to = std::min(n, from + 64 * 16);
        uint64_t touched = 0;
        for (int64_t i = from; i < to; i += 16) {
            if (to - i >= 16 ? !has_gradient(gradient + i, 16) : !has_gradient(gradient + i, int(to - i))) continue;
            touched |= uint64_t(1) << (i - from) / 16;
            __builtin_prefetch(value + i, 1);
            __builtin_prefetch(first + i, 1);
            __builtin_prefetch(second + i, 1);
        }
        for (; touched; touched &= touched - 1) {
            const int64_t i = from + 16 * __builtin_ctzll(touched);
            if (to - i >= 16) adam_line<true>(value + i, first + i, second + i, gradient + i, 16, a);
            else adam_line<false>(value + i, first + i, second + i, gradient + i, int(to - i), a);
        }
    }
}

}  // namespace NERFVOL_ISA
