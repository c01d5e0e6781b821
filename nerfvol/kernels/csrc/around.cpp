// Results are of each Gaussian, pair and vertex alone, so that they do not depend on the number of threads.
#include "around.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "pool.h"
#include "topology.h"

namespace nerfvol {
namespace {

// The cells of one Gaussian, each once and rising, behind those in `cells`.
void fill(const double* mean, const double* axes, double side, const double* half, const int64_t* steps, int64_t level,
          const double* origin, std::vector<int64_t>& cells) {
    const std::size_t begin = cells.size();
    const int64_t end = int64_t(1) << level;
    int64_t last = -1;
    double at[3];
    const auto sample = [&](int64_t i, int axis) { return steps[axis] ? double(i) / double(steps[axis]) : 0.0; };
    for (int64_t i = -steps[0]; i <= steps[0]; ++i)
        for (int64_t j = -steps[1]; j <= steps[1]; ++j)
            for (int64_t k = -steps[2]; k <= steps[2]; ++k) {
                const double u[3] = {sample(i, 0), sample(j, 1), sample(k, 2)};
                if (u[0] * u[0] + u[1] * u[1] + u[2] * u[2] > 1 + 1e-9) continue;
                for (int a = 0; a < 3; ++a) {
                    at[a] = mean[a];
                    for (int b = 0; b < 3; ++b) at[a] += axes[3 * a + b] * (u[b] * half[b]);
                    at[a] = std::floor((at[a] - origin[a]) / side);
                }
                bool inside = true;
                for (const double x : at) inside = inside && x >= 0 && x < double(end);
                if (!inside) continue;
                const auto c = [&](int a) { return spread_bits(uint64_t(at[a])); };
                const int64_t code = int64_t(c(0) << 2 | c(1) << 1 | c(2));
                if (code != last) cells.push_back(code);
                last = code;
            }
    std::sort(cells.begin() + std::ptrdiff_t(begin), cells.end());
    cells.erase(std::unique(cells.begin() + std::ptrdiff_t(begin), cells.end()), cells.end());
}

// The leaf at the middle of a cell, which is the lowest corner of its last child.
int64_t leaf_at(const Masks& octree, int64_t level, int64_t code) {
    int64_t node = 0;
    for (int64_t depth = 1; node < octree.n_nodes; ++depth) {
        const int octant = depth <= level ? int(code >> 3 * (level - depth) & 7) : depth == level + 1 ? 7 : 0;
        const int bit = 1 << octant;
        if (octree.leaf[node] & bit) return octree.first_leaf[node] + __builtin_popcount(octree.leaf[node] & (bit - 1));
        if (!(octree.node[node] & bit)) return -1;
        node = octree.first_node[node] + __builtin_popcount(octree.node[node] & (bit - 1));
    }
    return -1;
}

double coordinate(int64_t code, int axis) { return double(gather_bits(uint64_t(code) >> (2 - axis))) + 0.5; }

constexpr int kMost = 4;                       // coefficients of a colour

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

// What the looks say of one vertex.
class Vertex {
  public:
    Vertex(const double* position, double side, int coefficients, float* sh) : p_(position), side_(side), k_(coefficients), sh_(sh) {}

    int free = 0, on = 0;

    void look(const Look& look, const Verdict& verdict) {
        double d[3], c[3];
        for (int a = 0; a < 3; ++a) d[a] = p_[a] - look.position[a];
        for (int a = 0; a < 3; ++a) c[a] = look.rotation[3 * a] * d[0] + look.rotation[3 * a + 1] * d[1] + look.rotation[3 * a + 2] * d[2];
        if (!(c[2] > 0)) return;
        const double x = look.fx * c[0] / c[2] + look.cx, y = look.fy * c[1] / c[2] + look.cy;
        if (!(x >= 0 && x < double(look.width) && y >= 0 && y < double(look.height))) return;
        const int64_t pixel = int64_t(y) * look.width + int64_t(x);
        const double there = look.distance[pixel], far = std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        const double beyond = (far - there) / side_;
        free += look.opacity[pixel] <= verdict.nothing || (there > 0 && beyond < -verdict.before);
        if (!(there > 0) || std::abs(beyond) >= verdict.reach) return;
        ++on;
        add(d, far, std::exp(-beyond * beyond), look.rgb + 3 * pixel);
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

    const double* p_;
    double side_;
    int k_;
    float* sh_;
    double a_[kMost][kMost] = {}, b_[3][kMost] = {};
};

}  // namespace

void fill_cells(const GaussianAxes& gaussians, const double* half, const int64_t* steps, const int64_t* level, const double* origin,
                std::vector<int64_t>& gaussian, std::vector<int64_t>& code) {
    constexpr int64_t kChunk = 256;
    const std::size_t chunks = std::size_t((gaussians.n + kChunk - 1) / kChunk);
    std::vector<std::vector<int64_t>> cells(chunks), numbers(chunks);
    parallel_for(int(chunks), [&](int chunk, int) {
        auto& mine = cells[std::size_t(chunk)];
        for (int64_t i = chunk * kChunk; i < std::min(gaussians.n, (chunk + 1) * kChunk); ++i) {
            std::vector<int64_t> own;
            fill(gaussians.means + 3 * i, gaussians.axes + 9 * i, gaussians.side[i], half + 3 * i, steps + 3 * i, level[i], origin, own);
            mine.insert(mine.end(), own.begin(), own.end());
            numbers[std::size_t(chunk)].insert(numbers[std::size_t(chunk)].end(), own.size(), i);
        }
    });
    for (std::size_t c = 0; c < chunks; ++c) {
        code.insert(code.end(), cells[c].begin(), cells[c].end());
        gaussian.insert(gaussian.end(), numbers[c].begin(), numbers[c].end());
    }
}

void weigh_cells(const Masks& octree, const GaussianAxes& gaussians, const double* squares, const double* thickness, double blur,
                 const double* origin, double size, const int64_t* gaussian, const int64_t* level, const int64_t* code, int64_t m,
                 int64_t* leaf, double* weight) {
    constexpr double kTurn = 6.283185307179586;
    constexpr int64_t kChunk = 4096;
    parallel_for(int((m + kChunk - 1) / kChunk), [&](int chunk, int) {
        for (int64_t i = chunk * kChunk; i < std::min(m, (chunk + 1) * kChunk); ++i) {
            const int64_t g = gaussian[i];
            const double side = std::ldexp(size, -int(level[i])), wider = blur * side * (blur * side);
            const double *mean = gaussians.means + 3 * g, *axes = gaussians.axes + 9 * g;
            double d[3], narrowest = 1e300, exponent = 0;
            for (int a = 0; a < 3; ++a) d[a] = origin[a] + coordinate(code[i], a) * side - mean[a];
            for (int b = 0; b < 3; ++b) {
                const double own = axes[b] * d[0] + axes[3 + b] * d[1] + axes[6 + b] * d[2], wide = squares[3 * g + b] + wider;
                narrowest = std::min(narrowest, wide);
                exponent += own * own / wide;
            }
            leaf[i] = leaf_at(octree, level[i], code[i]);
            weight[i] = thickness[g] / std::sqrt(kTurn * narrowest) * std::exp(-0.5 * exponent);
        }
    });
}

void look_at_vertices(const std::vector<Look>& looks, const Verdict& verdict, const double* positions, const double* side, int64_t n,
                      int coefficients, int16_t* free, int16_t* on, float* sh) {
    constexpr int64_t kChunk = 1024;
    parallel_for(int((n + kChunk - 1) / kChunk), [&](int chunk, int) {
        for (int64_t i = chunk * kChunk; i < std::min(n, (chunk + 1) * kChunk); ++i) {
            Vertex vertex(positions + 3 * i, side[i], coefficients, sh + 3 * coefficients * i);
            for (const Look& look : looks) vertex.look(look, verdict);
            vertex.correct(verdict.keep);
            free[i] = int16_t(vertex.free);
            on[i] = int16_t(vertex.on);
        }
    });
}

}  // namespace nerfvol
