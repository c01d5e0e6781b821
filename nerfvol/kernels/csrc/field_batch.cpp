// Batches of a field's training, and the bits of its occupied cells. Memory bound: one build for all instruction sets.
#include <algorithm>
#include <cstring>
#include <vector>

#include "field.h"
#include "pool.h"

namespace nerfvol {
namespace {

// The finaliser of splitmix64 [Steele, Lea and Flood 2014].
uint64_t mixed(uint64_t x) {
    x ^= x >> 30;
    x *= 0xBF58476D1CE4E5B9ull;
    x ^= x >> 27;
    x *= 0x94D049BB133111EBull;
    return x ^ x >> 31;
}

// The larger of each cell and its two neighbours along one axis.
void dilate(std::vector<uint8_t>& cells, int n, int stride) {
    std::vector<uint8_t> out(cells);
    const int line = stride * n;
    for (int from = 0; from < n * n * n; from += line) {
        uint8_t *to = out.data() + from, *at = cells.data() + from;
        for (int i = 0; i < line - stride; ++i) to[i] |= at[i + stride];
        for (int i = stride; i < line; ++i) to[i] |= at[i - stride];
    }
    cells.swap(out);
}

// A bit for each cell from bit `at` on.
void pack(const std::vector<uint8_t>& cells, int64_t at, uint64_t* bits) {
    const int64_t n = int64_t(cells.size());
    if (at % 64 || n % 64) {  // few cells
        for (int64_t i = 0; i < n; ++i) {
            uint64_t& word = bits[(at + i) / 64];
            const uint64_t bit = uint64_t(1) << (at + i) % 64;
            word = cells[std::size_t(i)] ? word | bit : word & ~bit;
        }
        return;
    }
    parallel_for(int((n / 64 + 255) / 256), [&](int task, int) {
        for (int64_t w = int64_t(task) * 256; w < std::min<int64_t>(n / 64, int64_t(task + 1) * 256); ++w) {
            uint64_t word = 0;
            for (int64_t k = 0; k < 8; ++k) {
                uint64_t eight;
                std::memcpy(&eight, cells.data() + 64 * w + 8 * k, 8);
                word |= (eight * 0x0102040810204080ull >> 56) << 8 * k;  // eight bytes of 0 or 1 become eight bits
            }
            bits[at / 64 + w] = word;
        }
    });
}

}  // namespace

void draw_pixels(const FieldPixels& from, uint64_t key, int64_t n, float* origins, float* directions, float* target, float* jitter) {
    constexpr int64_t kChunk = 256;
    const uint64_t pixels = uint64_t(from.starts[from.views]);
    parallel_for(int((n + kChunk - 1) / kChunk), [&](int chunk, int) {
        struct Place { uint64_t drawn; int64_t view; const float* direction; const uint8_t* colour; } places[kChunk];
        const int64_t first = chunk * kChunk, count = std::min(n - first, kChunk);
        for (int64_t k = 0; k < count; ++k) {  // all are asked for before the first is waited for: pictures do not fit into a cache
            const uint64_t h = mixed(key + uint64_t(first + k) * 0x9E3779B97F4A7C15ull);
            const int64_t pixel = int64_t((h >> 32) * pixels >> 32);
            int64_t view = int64_t((h >> 32) * uint64_t(from.views) >> 32);  // it is this one where pictures are of one size
            while (pixel < from.starts[view]) --view;
            while (pixel >= from.starts[view + 1]) ++view;
            const int64_t at = 3 * (pixel - from.starts[view]);
            places[k] = {h, view, from.directions[view] + at, from.colours[view] + at};
            __builtin_prefetch(places[k].direction);
            __builtin_prefetch(places[k].colour);
        }
        for (int64_t k = 0, i = first; k < count; ++k, ++i) {
            const Place& a = places[k];
            const float *d = a.direction, *r = from.rotations + 9 * a.view;
            for (int axis = 0; axis < 3; ++axis) {
                origins[3 * i + axis] = from.origins[3 * a.view + axis];
                directions[3 * i + axis] = r[3 * axis] * d[0] + r[3 * axis + 1] * d[1] + r[3 * axis + 2] * d[2];
                target[3 * i + axis] = float(a.colour[axis]) * (1.0f / 255.0f);
            }
            jitter[i] = float(mixed(a.drawn) >> 40) * (1.0f / 16777216.0f);
        }
    });
}

void refresh_occupancy(const float* sigmas, int cubes, int resolution, const float* thresholds, uint64_t* occupied, uint64_t* coarse) {
    const int r = resolution, half = r / 2, c = r / 4;
    std::vector<uint8_t> cells(std::size_t(r) * r * r), before, pooled(std::size_t(c) * c * c);
    for (int cube = 0; cube < cubes; ++cube) {
        const float* s = sigmas + int64_t(cube) * r * r * r;
        parallel_for(r, [&](int x, int) {
            const std::size_t from = std::size_t(x) * r * r, to = from + std::size_t(r) * r;
            for (std::size_t i = from; i < to; ++i) cells[i] = s[i] > thresholds[cube];
            if (cube == 0 || x < r / 4 || x >= r - r / 4) return;
            // Points are noted in the smallest cube that holds them: the middle of a larger one is that one's summary.
            for (int y = 0; y < half; ++y)
                for (int z = 0; z < half; ++z) {
                    uint8_t any = 0;
                    for (int o = 0; o < 8; ++o)
                        any |= before[(std::size_t(2 * (x - r / 4) + (o >> 2)) * r + std::size_t(2 * y + (o >> 1 & 1))) * r + std::size_t(2 * z + (o & 1))];
                    cells[from + std::size_t(y + r / 4) * r + std::size_t(z + r / 4)] = any;
                }
        });
        pack(cells, int64_t(cube) * r * r * r, occupied);
        parallel_for(c, [&](int x, int) {
            for (int y = 0; y < c; ++y)
                for (int z = 0; z < c; ++z) {
                    uint32_t any = 0;
                    for (int i = 0; i < 16; ++i) {
                        uint32_t four;
                        std::memcpy(&four, &cells[(std::size_t(4 * x + i / 4) * r + std::size_t(4 * y + i % 4)) * r + std::size_t(4 * z)], 4);
                        any |= four;
                    }
                    pooled[(std::size_t(x) * c + y) * c + z] = any != 0;
                }
        });
        for (int stride : {1, c, c * c}) dilate(pooled, c, stride);
        pack(pooled, int64_t(cube) * c * c * c, coarse);
        if (cube + 1 < cubes) before = cells;
    }
}

}  // namespace nerfvol
