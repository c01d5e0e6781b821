// Results are of each cell, family or sum alone, so that they do not depend on the number of threads.
#include "distil.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

#include "pool.h"
#include "topology.h"

namespace nerfvol {
namespace {

// A set of cells as 4x4x4 blocks of bits in a hash table: the 26 neighbours of a cell lie in at most eight blocks.
class CellSet {
  public:
    CellSet(const int32_t* cells, const uint8_t* holds, int64_t n) {
        int64_t held = 0;
        for (int64_t i = 0; i < n; ++i) held += holds[i] != 0;
        std::size_t capacity = 64;
        while (capacity < std::size_t(held)) capacity *= 2;  // a block holds several cells: about a fifth is used
        keys_.assign(2 * capacity, kFree);
        bits_.assign(2 * capacity, 0);
        for (int64_t i = 0; i < n; ++i)
            if (holds[i]) {
                const int32_t* c = cells + 3 * i;
                const std::size_t s = slot(key(c[0] >> 2, c[1] >> 2, c[2] >> 2));
                keys_[s] = key(c[0] >> 2, c[1] >> 2, c[2] >> 2);
                bits_[s] |= uint64_t(1) << place(c[0], c[1], c[2]);
            }
    }

    bool touches(const int32_t* c) const {
        uint64_t last = kFree, bits = 0;
        for (int x = c[0] - 1; x <= c[0] + 1; ++x)
            for (int y = c[1] - 1; y <= c[1] + 1; ++y)
                for (int z = c[2] - 1; z <= c[2] + 1; ++z) {
                    if (x < 0 || y < 0 || z < 0) continue;
                    const uint64_t k = key(x >> 2, y >> 2, z >> 2);
                    if (k != last) {
                        last = k;
                        bits = bits_[slot(k)];  // none where the block is not there
                    }
                    if (bits >> place(x, y, z) & 1) return true;
                }
        return false;
    }

  private:
    static constexpr uint64_t kFree = ~uint64_t(0);
    static uint64_t key(int x, int y, int z) { return uint64_t(x) << 42 | uint64_t(y) << 21 | uint64_t(z); }
    static int place(int x, int y, int z) { return (x & 3) << 4 | (y & 3) << 2 | (z & 3); }
    std::size_t slot(uint64_t k) const {
        std::size_t s = std::size_t((k * 0x9E3779B97F4A7C15ull) >> 20) & (keys_.size() - 1);
        while (keys_[s] != kFree && keys_[s] != k) s = (s + 1) & (keys_.size() - 1);
        return s;
    }
    std::vector<uint64_t> keys_, bits_;
};

constexpr int kCorner[8] = {0, 2, 6, 8, 18, 20, 24, 26};  // of the lattice's points, those at corners

float explin(float raw) { return raw < 1 ? std::exp(raw - 1) : raw; }

// The largest difference between the lattice's own values and those between its corners, each times `share` (27).
float largest_change(const float own[27], const float weights[27][8], const float share[27]) {
    float most = 0;
    for (int p = 0; p < 27; ++p) {
        float between = 0;
        for (int o = 0; o < 8; ++o) between += weights[p][o] * own[kCorner[o]];
        most = std::max(most, std::abs(between - own[p]) * share[p]);
    }
    return most;
}

float merge_error(const VertexRows& rows, const int32_t* corners, float scale, const float weights[27][8]) {
    int32_t vertex[27];
    for (int child = 0; child < 8; ++child)
        for (int corner = 0; corner < 8; ++corner) vertex[lattice_place(child, corner)] = corners[8 * child + corner];
    float own[27], opacity[27];
    for (int p = 0; p < 27; ++p) {
        own[p] = rows.values[rows.width * vertex[p] + rows.density];
        opacity[p] = -std::expm1(-scale * explin(own[p]));
    }
    float error = 0;
    for (int p = 0; p < 27; ++p) {
        float between = 0;
        for (int o = 0; o < 8; ++o) between += weights[p][o] * own[kCorner[o]];
        error = std::max(error, std::abs(-std::expm1(-scale * explin(between)) - opacity[p]));
    }
    for (int k = 0; k < rows.coefficients; ++k) {
        for (int p = 0; p < 27; ++p) own[p] = rows.values[rows.width * vertex[p] + rows.slots[k]];
        error = std::max(error, rows.bounds[k] * largest_change(own, weights, opacity));
    }
    return error;
}

}  // namespace

void dilate_cells(const int32_t* cells, const uint8_t* holds, int64_t n, uint8_t* kept) {
    const CellSet set(cells, holds, n);
    constexpr int64_t kChunk = 8192;
    parallel_for(int((n + kChunk - 1) / kChunk), [&](int chunk, int) {
        const int64_t end = std::min(n, (chunk + 1) * kChunk);
        for (int64_t i = chunk * kChunk; i < end; ++i) kept[i] = holds[i] || set.touches(cells + 3 * i);
    });
}

void merge_errors(const VertexRows& rows, const int32_t* corners, const int64_t* first, const float* scale, int64_t m,
                  float* error) {
    float weights[27][8];
    lattice_weights(weights);
    constexpr int64_t kChunk = 1024;
    parallel_for(int((m + kChunk - 1) / kChunk), [&](int chunk, int) {
        const int64_t end = std::min(m, (chunk + 1) * kChunk);
        for (int64_t i = chunk * kChunk; i < end; ++i) error[i] = merge_error(rows, corners + 8 * first[i], scale[i], weights);
    });
}

namespace {

// One thread has a range of the sums and goes through everything for it: the order is the same for any number of threads.
template <class Task> void for_ranges(int64_t n, Task&& task) {
    const int parts = get_threads();
    parallel_for(parts, [&](int part, int) { task(n * part / parts, n * (part + 1) / parts); });
}

void add_row(const double* row, int64_t width, double weight, double* sum) {
    for (int64_t k = 0; k < width; ++k) sum[k] += weight * row[k];
}

}  // namespace

void add_rows(const double* rows, int64_t width, const int64_t* from, const double* weight, const int64_t* to, int64_t m,
              double* sums, int64_t n) {
    for_ranges(n, [&](int64_t low, int64_t high) {
        for (int64_t i = 0; i < m; ++i)
            if (to[i] >= low && to[i] < high) add_row(rows + width * from[i], width, weight[i], sums + width * to[i]);
    });
}

void add_to_corners(const double* rows, int64_t width, const double* weight, const int32_t* corners, int64_t m, double* sums,
                    int64_t n) {
    for_ranges(n, [&](int64_t low, int64_t high) {
        for (int64_t i = 0; i < m; ++i)
            for (int o = 0; o < 8; ++o) {
                const int64_t to = corners[8 * i + o];
                if (to >= low && to < high) add_row(rows + width * i, width, weight[i], sums + width * to);
            }
    });
}

}  // namespace nerfvol
