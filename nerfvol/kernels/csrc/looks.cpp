// What pictures of splats say of an octree's vertices. Results are of each vertex alone, so that they do not depend on the
// number of threads.
#include <algorithm>
#include <cmath>
#include <cstddef>

#include "around.h"
#include "clones.h"
#include "pool.h"

namespace nerfvol {
namespace {

constexpr int kMost = 4;                       // coefficients of a colour
constexpr int kTogether = 8;                   // looks whose places are worked out side by side

// Solves a x = b for three right sides; a (k, k) is positive definite and is overwritten [Cholesky].
void solve(double (&a)[kMost][kMost], double (&b)[3][kMost], int k) {
    for (int i = 0; i < k; ++i)
        for (int j = 0; j <= i; ++j) {
            double sum = a[i][j];
            for (int l = 0; l < j; ++l) sum -= a[i][l] * a[j][l];
            a[i][j] = i == j ? std::sqrt(sum) : sum / a[j][j];
        }
    for (auto& x : b) {
        for (int i = 0; i < k; ++i) {
            for (int l = 0; l < i; ++l) x[i] -= a[i][l] * x[l];
            x[i] /= a[i][i];
        }
        for (int i = k; i-- > 0;) {
            for (int l = i + 1; l < k; ++l) x[i] -= a[l][i] * x[l];
            x[i] /= a[i][i];
        }
    }
}

// Eight looks, number by number; those that are none have a width of 0.
struct Group {
    double rotation[9][kTogether], position[3][kTogether], fx[kTogether], fy[kTogether], cx[kTogether], cy[kTogether];
    double width[kTogether], height[kTogether];
    const Look* look[kTogether];

    Group(const Look* first, std::size_t n) {
        for (std::size_t i = 0; i < kTogether; ++i) {
            const Look& from = first[std::min(i, n - 1)];
            for (int k = 0; k < 9; ++k) rotation[k][i] = from.rotation[k];
            for (int k = 0; k < 3; ++k) position[k][i] = from.position[k];
            fx[i] = from.fx; fy[i] = from.fy; cx[i] = from.cx; cy[i] = from.cy;
            width[i] = i < n ? double(from.width) : 0;
            height[i] = double(from.height);
            look[i] = &from;
        }
    }
};

// Where a group sees a point: offsets from its cameras, distances, pixels, and whether those lie in its pictures.
struct Places {
    double d[3][kTogether], far[kTogether], x[kTogether], y[kTogether];
    int64_t in[kTogether];
};

NERFVOL_INLINE void places_body(const Group& g, const double* p, Places& to) {
    for (int i = 0; i < kTogether; ++i) {
        const double d0 = p[0] - g.position[0][i], d1 = p[1] - g.position[1][i], d2 = p[2] - g.position[2][i];
        const double c0 = g.rotation[0][i] * d0 + g.rotation[1][i] * d1 + g.rotation[2][i] * d2;
        const double c1 = g.rotation[3][i] * d0 + g.rotation[4][i] * d1 + g.rotation[5][i] * d2;
        const double c2 = g.rotation[6][i] * d0 + g.rotation[7][i] * d1 + g.rotation[8][i] * d2;
        const double x = g.fx[i] * c0 / c2 + g.cx[i], y = g.fy[i] * c1 / c2 + g.cy[i];
        to.d[0][i] = d0; to.d[1][i] = d1; to.d[2][i] = d2;
        to.far[i] = std::sqrt(d0 * d0 + d1 * d1 + d2 * d2);
        to.x[i] = x; to.y[i] = y;
        to.in[i] = (c2 > 0) & (x >= 0) & (x < g.width[i]) & (y >= 0) & (y < g.height[i]);
    }
}

using FindPlaces = void (*)(const Group&, const double*, Places&);

void places_baseline(const Group& g, const double* p, Places& to) { places_body(g, p, to); }
#ifdef NERFVOL_CLONES
NERFVOL_AVX2 void places_avx2(const Group& g, const double* p, Places& to) { places_body(g, p, to); }
NERFVOL_AVX512 void places_avx512(const Group& g, const double* p, Places& to) { places_body(g, p, to); }
#endif

FindPlaces find_places() {
#ifdef NERFVOL_CLONES
    return choose_clone<FindPlaces>(places_baseline, places_avx2, places_avx512);
#else
    return places_baseline;
#endif
}

// What the looks say of one vertex.
class Vertex {
  public:
    Vertex(double side, int coefficients, float* sh) : side_(side), k_(coefficients), sh_(sh) {}

    int free = 0, on = 0;

    void look(const Group& group, const Places& at, const Verdict& verdict) {
        for (int i = 0; i < kTogether; ++i) {
            if (!at.in[i]) continue;
            const Look& look = *group.look[i];
            const int64_t pixel = int64_t(at.y[i]) * look.width + int64_t(at.x[i]);
            const double there = look.distance[pixel], beyond = (at.far[i] - there) / side_;
            if (!(there > 0)) continue;
            free += beyond < -verdict.before;
            if (std::abs(beyond) >= verdict.reach) continue;
            ++on;
            const double d[3] = {at.d[0][i], at.d[1][i], at.d[2][i]};
            add(d, at.far[i], std::exp(-beyond * beyond), look.rgb + 3 * pixel);
        }
    }

    // Corrects the coefficients; `keep` holds back the higher ones, as so many looks of weight 1 would that miss nothing.
    void correct(double keep) {
        if (!on) return;
        for (int i = 0; i < k_; ++i) a_[i][i] += i ? keep : 1e-9;
        solve(a_, b_, k_);
        for (int channel = 0; channel < 3; ++channel)
            for (int i = 0; i < k_; ++i) sh_[k_ * channel + i] += float(b_[channel][i]);
    }

  private:
    void add(const double* d, double far, double weight, const float* rgb) {
        constexpr double c0 = 0.28209479177387814, c1 = 0.4886025119029199;
        const double basis[kMost] = {c0, -c1 * d[1] / far, c1 * d[2] / far, -c1 * d[0] / far};
        for (int i = 0; i < k_; ++i)
            for (int j = 0; j <= i; ++j) a_[i][j] += weight * basis[i] * basis[j];
        for (int channel = 0; channel < 3; ++channel) {
            double missed = rgb[channel] - 0.5;
            for (int i = 0; i < k_; ++i) missed -= basis[i] * sh_[k_ * channel + i];
            for (int i = 0; i < k_; ++i) b_[channel][i] += weight * basis[i] * missed;
        }
    }

    double side_;
    int k_;
    float* sh_;
    double a_[kMost][kMost] = {}, b_[3][kMost] = {};
};

}  // namespace

void look_at_vertices(const std::vector<Look>& looks, const Verdict& verdict, const double* positions, const double* side, int64_t n,
                      int coefficients, int16_t* free, int16_t* on, float* sh) {
    constexpr int64_t kChunk = 1024;
    std::vector<Group> groups;
    for (std::size_t i = 0; i < looks.size(); i += kTogether)
        groups.emplace_back(&looks[i], std::min<std::size_t>(kTogether, looks.size() - i));
    const FindPlaces find = find_places();
    parallel_for(int((n + kChunk - 1) / kChunk), [&](int chunk, int) {
        for (int64_t i = chunk * kChunk; i < std::min(n, (chunk + 1) * kChunk); ++i) {
            Vertex vertex(side[i], coefficients, sh + 3 * coefficients * i);
            for (const Group& group : groups) {
                Places at;
                find(group, positions + 3 * i, at);
                vertex.look(group, at, verdict);
            }
            vertex.correct(verdict.keep);
            free[i] = int16_t(vertex.free);
            on[i] = int16_t(vertex.on);
        }
    });
}

}  // namespace nerfvol
