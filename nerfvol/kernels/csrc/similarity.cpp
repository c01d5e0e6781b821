#include "similarity.h"

#include <vector>

#include "clones.h"

namespace nerfvol {
namespace {

constexpr float kMiddle = 0.5f;  // moments about it, a constant that cancels in the covariances, lose less to rounding
constexpr int kMoments = 5;      // a, b, aa, bb, ab

// Sums of the moments of one window's rows, weighted: sums (kMoments, n) of rows of n numbers each.
NERFVOL_INLINE void down(const float* a, const float* b, int64_t n, const float* weights, int taps, float* sums) {
    float *sa = sums, *sb = sums + n, *saa = sums + 2 * n, *sbb = sums + 3 * n, *sab = sums + 4 * n;
    for (int64_t i = 0; i < kMoments * n; ++i) sums[i] = 0;
    for (int k = 0; k < taps; ++k) {
        const float *row_a = a + k * n, *row_b = b + k * n, w = weights[k];
        NERFVOL_APART
        for (int64_t i = 0; i < n; ++i) {
            const float x = row_a[i] - kMiddle, y = row_b[i] - kMiddle, wx = w * x, wy = w * y;
            sa[i] += wx;
            sb[i] += wy;
            saa[i] += wx * x;
            sbb[i] += wy * y;
            sab[i] += wx * y;
        }
    }
}

// The same along a row: means (kMoments, m), m numbers of which the next pixel's lie `channels` on.
NERFVOL_INLINE void along(const float* sums, int64_t n, int64_t m, int64_t channels, const float* weights, int taps, float* means) {
    for (int j = 0; j < kMoments; ++j) {
        const float* row = sums + j * n;
        float* mean = means + j * m;
        for (int64_t i = 0; i < m; ++i) mean[i] = 0;
        for (int k = 0; k < taps; ++k) {
            const float *from = row + k * channels, w = weights[k];
            NERFVOL_APART
            for (int64_t i = 0; i < m; ++i) mean[i] += w * from[i];
        }
    }
}

NERFVOL_INLINE void compare(const float* means, int64_t m, float c1, float c2, float* out) {
    const float *ma = means, *mb = means + m, *aa = means + 2 * m, *bb = means + 3 * m, *ab = means + 4 * m;
    NERFVOL_APART
    for (int64_t i = 0; i < m; ++i) {
        const float x = ma[i], y = mb[i], both = aa[i] - x * x + (bb[i] - y * y), joint = ab[i] - x * y;
        const float mean_a = x + kMiddle, mean_b = y + kMiddle;
        out[i] = (2 * mean_a * mean_b + c1) * (2 * joint + c2) / ((mean_a * mean_a + mean_b * mean_b + c1) * (both + c2));
    }
}

struct Sides {
    int64_t rows, n, m, channels;
};

NERFVOL_INLINE void similarity_body(const float* a, const float* b, const Sides& s, const float* weights, int taps, float c1,
                                    float c2, float* space, float* out) {
    for (int64_t y = 0; y < s.rows; ++y) {
        down(a + y * s.n, b + y * s.n, s.n, weights, taps, space);
        along(space, s.n, s.m, s.channels, weights, taps, space + kMoments * s.n);
        compare(space + kMoments * s.n, s.m, c1, c2, out + y * s.m);
    }
}

using Body = void (*)(const float*, const float*, const Sides&, const float*, int, float, float, float*, float*);

void baseline(const float* a, const float* b, const Sides& s, const float* w, int taps, float c1, float c2, float* space, float* out) {
    similarity_body(a, b, s, w, taps, c1, c2, space, out);
}
#ifdef NERFVOL_CLONES
NERFVOL_AVX2 void avx2(const float* a, const float* b, const Sides& s, const float* w, int taps, float c1, float c2, float* space,
                       float* out) {
    similarity_body(a, b, s, w, taps, c1, c2, space, out);
}
NERFVOL_AVX512 void avx512(const float* a, const float* b, const Sides& s, const float* w, int taps, float c1, float c2,
                           float* space, float* out) {
    similarity_body(a, b, s, w, taps, c1, c2, space, out);
}
#endif

}  // namespace

void similarity(const float* a, const float* b, int64_t height, int64_t width, int64_t channels, const float* weights, int taps,
                float c1, float c2, float* out) {
    const Sides s{height - taps + 1, width * channels, (width - taps + 1) * channels, channels};
    std::vector<float> space(size_t(kMoments * (s.n + s.m)));
#ifdef NERFVOL_CLONES
    const Body body = choose_clone<Body>(baseline, avx2, avx512);
#else
    const Body body = baseline;
#endif
    body(a, b, s, weights, taps, c1, c2, space.data(), out);
}

}  // namespace nerfvol
