#include "prefilter.h"

#include <algorithm>
#include <cmath>

#include "pool.h"
#include "topology.h"

namespace nerfvol {
namespace {

constexpr float kOpaque = 1 - 1e-6f;       // lod.OPAQUE
constexpr float kClearest = 1e-12f;        // lod.CLEAREST
constexpr int kDensity = 12, kFewNodes = 256, kAtOnce = 16;  // nodes of a task, tasks whose sums wait to be added

float explin(float raw) { return raw < 1 ? std::exp(raw - 1) : raw; }
float explin_inverse(float value) { return value < 1 ? std::log(value) + 1 : value; }

// Calls f(i) for every i in [0, n).
template <class F> void in_parallel(int64_t n, const F& f) {
    constexpr int64_t kChunk = 8192;
    parallel_for(int((n + kChunk - 1) / kChunk), [&](int chunk, int) {
        for (int64_t i = chunk * kChunk; i < n && i < (chunk + 1) * kChunk; ++i) f(i);
    });
}

// The nodes of one level: where they are, and what they are drawn with.
struct Level {
    int64_t start, end;
    std::vector<int32_t> ijk;              // (n, 3)
    std::vector<int32_t> corners;          // (n, 8) within the level
    std::vector<float> rows, extinction;   // (vertices, row), (vertices)
};

std::vector<Level> place_nodes(const Tree& t) {
    std::vector<Level> levels(1);
    levels[0] = {0, 1, {0, 0, 0}, {}, {}, {}};
    while (levels.back().end < t.n_nodes) {
        const Level& above = levels.back();
        Level next{above.end, above.end, {}, {}, {}, {}};
        for (int64_t node = above.start; node < above.end; ++node)
            for (int o = 0; o < 8; ++o) {
                if (!(t.node_mask[node] >> o & 1)) continue;
                for (int axis = 0; axis < 3; ++axis)
                    next.ijk.push_back(2 * above.ijk[size_t(3 * (node - above.start) + axis)] + (o >> (2 - axis) & 1));
                ++next.end;
            }
        levels.push_back(std::move(next));
    }
    return levels;
}

// Optical depth of a node, the mean over the axes of -log of the mean transmittance of sixteen columns; depths: of each corner
// of each child (octant, corner), over a quarter of the side.
float optical_depth(const float (&depths)[8][8]) {
    float sum = 0;
    for (int axis = 0; axis < 3; ++axis) {
        const int bit = 4 >> axis;
        float opacity = 0;
        for (int child = 0; child < 8; ++child)
            for (int corner = 0; corner < 8; ++corner) {
                if (child & bit || corner & bit) continue;
                opacity -= std::expm1(-(depths[child][corner] + depths[child][corner | bit] + depths[child | bit][corner] +
                                        depths[child | bit][corner | bit]));
            }
        sum -= std::log1p(-std::min(opacity / 16, kOpaque));
    }
    return sum / 3;
}

// Scales the sums (8, row) so that the optical depths of the corners fit the node's own.
void share_out(float depth, float* sums, int64_t row) {
    constexpr float kTiny = 1.17549435e-38f;
    float opacity[8], mean = 0;
    for (int c = 0; c < 8; ++c) {
        opacity[c] = std::min(sums[row * c + kDensity], kOpaque);
        mean += opacity[c] / 8;
    }
    const float factor = depth / std::max(-std::log1p(-mean), kTiny);
    for (int c = 0; c < 8; ++c) {
        const float wanted = -std::expm1(std::log1p(-opacity[c]) * factor), scale = wanted / std::max(sums[row * c + kDensity], kTiny);
        for (int64_t k = 0; k < row; ++k) sums[row * c + k] *= scale;
    }
}

// What hangs below the nodes of a level: leaves, or nodes.
template <class Number> struct Cells {
    const uint8_t* mask;                   // of the level's nodes
    const int32_t* first;
    int32_t offset;                        // what `first` counts from
    const int32_t* corners;
    const Number* rows;
    const float* extinction;
    std::vector<float> weight{};           // opacity of half the level's side

    // Of the corners of cells [from, to).
    void weigh(int64_t n_vertices, int64_t from, int64_t to, float side) {
        weight.assign(size_t(n_vertices), -1.0f);
        for (int64_t c = 8 * from; c < 8 * to; ++c) {
            float& w = weight[size_t(corners[c])];
            if (w < 0) w = -std::expm1(-extinction[corners[c]] * side / 2);
        }
    }
    // Adds to the sums of `n` nodes from `node` on, and notes their optical depths.
    void add(int64_t node, int64_t n, float side, int64_t row, float* sums, float (*depths)[8][8]) const {
        std::vector<int32_t> at(static_cast<size_t>(n));
        for (int64_t i = 0; i < n; ++i) {
            at[size_t(i)] = first[node + i] - offset;
            const int32_t* cell = corners + 8 * int64_t(at[size_t(i)]);
            for (int o = 0; o < 8; ++o) {
                if (!(mask[node + i] >> o & 1)) continue;
                for (int c = 0; c < 8; ++c) depths[i][o][c] = extinction[cell[c]] * side / 4;
                cell += 8;
            }
        }
        restrict_cells(mask + node, at.data(), n, corners, rows, row, weight.data(), kDensity, sums);
    }
};

}  // namespace

Prefiltered prefilter(const Tree& t) {
    const int64_t row = 16 * t.blocks;
    std::vector<float> sigma(static_cast<size_t>(t.n_vertices));
    in_parallel(t.n_vertices, [&](int64_t v) { sigma[size_t(v)] = t.density_scale * explin(t.values[row * v + kDensity]); });
    std::vector<Level> levels = place_nodes(t);
    Prefiltered out;
    out.corners.resize(size_t(8 * t.n_nodes));
    for (size_t l = levels.size(); l-- > 0;) {
        Level& level = levels[l];
        const int64_t n = level.end - level.start;
        const float side = t.size / float(int64_t(1) << l);
        level.corners.resize(size_t(8 * n));
        const std::vector<int8_t> same(static_cast<size_t>(n), static_cast<int8_t>(l));
        const int64_t n_vertices = number_corners(same.data(), level.ijk.data(), n, int(l), level.corners.data());
        Cells<RowNumber> leaves{t.leaf_mask, t.first_leaf, 0, t.corners, t.values, sigma.data()};
        Cells<float> below{};
        const int64_t last_leaf = level.end < t.n_nodes ? t.first_leaf[level.end] : t.n_leaves;
        leaves.weigh(t.n_vertices, t.first_leaf[level.start], last_leaf, side);
        const bool parents = l + 1 < levels.size();
        if (parents) {
            const Level& next = levels[l + 1];
            below = {t.node_mask, t.first_node, int32_t(level.end), next.corners.data(), next.rows.data(), next.extinction.data()};
            below.weigh(int64_t(next.extinction.size()), 0, next.end - next.start, side);
        }
        level.rows.assign(size_t(n_vertices * row), 0);
        std::vector<float> nodes(size_t(n_vertices), 0), all(size_t(kAtOnce * kFewNodes * 8 * row));
        for (int64_t first = 0; first < n; first += kAtOnce * kFewNodes) {
            const int64_t end = std::min<int64_t>(n, first + kAtOnce * kFewNodes);
            parallel_for(int((end - first + kFewNodes - 1) / kFewNodes), [&](int task, int) {
                const int64_t from = first + task * kFewNodes, few = std::min<int64_t>(kFewNodes, end - from);
                float* const sums = all.data() + 8 * row * (from - first);
                std::fill_n(sums, 8 * row * few, 0.0f);
                std::vector<float> of_corners(size_t(64 * few), 0.0f);
                float (*const depths)[8][8] = reinterpret_cast<float (*)[8][8]>(of_corners.data());
                leaves.add(level.start + from, few, side, row, sums, depths);
                if (parents) below.add(level.start + from, few, side, row, sums, depths);
                for (int64_t i = 0; i < few; ++i) share_out(optical_depth(depths[i]), sums + 8 * row * i, row);
            });
            for (int64_t i = 8 * first; i < 8 * end; ++i) {  // in order: nodes share vertices
                const int64_t v = level.corners[size_t(i)];
                const float* const from = all.data() + row * (i - 8 * first);
                ++nodes[size_t(v)];
                for (int64_t k = 0; k < row; ++k) level.rows[size_t(row * v + k)] += from[k];
            }
        }
        level.extinction.resize(size_t(n_vertices));
        in_parallel(n_vertices, [&](int64_t v) {
            float* r = level.rows.data() + row * v;
            const float total = r[kDensity], opacity = std::min(total / nodes[size_t(v)], kOpaque);
            for (int64_t k = 0; k < row; ++k) r[k] /= std::max(total, 1.17549435e-38f);
            level.extinction[size_t(v)] = -std::log1p(-opacity) / side;
            r[kDensity] = explin_inverse(std::max(level.extinction[size_t(v)] / t.density_scale, kClearest));
        });
        const int32_t base = int32_t(out.values.size() / size_t(row));
        for (int64_t i = 0; i < 8 * n; ++i) out.corners[size_t(8 * level.start + i)] = base + level.corners[size_t(i)];
        if (out.values.empty()) out.values.reserve(level.rows.size() * 3 / 2);  // the finest level has most of them
        out.values.insert(out.values.end(), level.rows.begin(), level.rows.end());
        if (parents) levels[l + 1] = {};
    }
    return out;
}

}  // namespace nerfvol
