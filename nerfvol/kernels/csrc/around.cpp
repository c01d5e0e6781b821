// Results are of each Gaussian, pair and vertex alone, so that they do not depend on the number of threads.
#include "around.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <iterator>
#include <utility>

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

std::vector<int64_t> distinct_codes(const int64_t* codes, int64_t n) {
    constexpr int64_t kWorthwhile = 1 << 14;
    const int64_t parts = std::clamp<int64_t>(n / kWorthwhile, 1, get_threads());
    std::vector<std::vector<int64_t>> sorted(static_cast<std::size_t>(parts));
    parallel_for(int(parts), [&](int part, int) {
        auto& mine = sorted[std::size_t(part)];
        mine.assign(codes + n * part / parts, codes + n * (part + 1) / parts);
        std::sort(mine.begin(), mine.end());
        mine.erase(std::unique(mine.begin(), mine.end()), mine.end());
    });
    while (sorted.size() > 1) {
        std::vector<std::vector<int64_t>> merged((sorted.size() + 1) / 2);
        parallel_for(int(merged.size()), [&](int i, int) {
            auto &one = sorted[2 * std::size_t(i)], &to = merged[std::size_t(i)];
            if (2 * std::size_t(i) + 1 == sorted.size()) {
                to = std::move(one);
                return;
            }
            const auto& other = sorted[2 * std::size_t(i) + 1];
            to.reserve(one.size() + other.size());
            std::set_union(one.begin(), one.end(), other.begin(), other.end(), std::back_inserter(to));
        });
        sorted = std::move(merged);
    }
    return std::move(sorted[0]);
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

}  // namespace nerfvol
