// Which tiles and blocks a Gaussian touches: exact to a thousandth of a pixel, sixteen bands of four rows at a time [Speedy].
//
// In rows dy from the mean, the ellipse alpha >= 1/255 reaches from k dy - h(dy) to k dy + h(dy), h^2 = w (1 - dy^2 / half_height^2).
// Its right edge is farthest at dy = tip, its left edge at -tip, so that a band's extremes are at the tips clamped to the band.
#pragma once
#include "splat_project.h"

namespace NERFVOL_ISA {

struct TileMask { uint32_t tile, mask; };    // bit 4 row + column of the mask: a block of 4x4 pixels

// The picture in tiles and in blocks.
struct TileGrid {
    int32_t columns, rows;
    explicit TileGrid(const SplatView& v) : columns(int32_t((v.width + 15) / 16)), rows(int32_t((v.height + 15) / 16)) {}
    int64_t size() const { return int64_t(columns) * rows; }
};

#if defined(__AVX512F__)
inline void store_ints(const f16& v, int32_t* out) { store(out, __builtin_convertvector(v, i16v)); }
#endif
inline void store_ints(const f4& v, int32_t* out) { store(out, __builtin_convertvector(v, i4v)); }
inline void store_ints(const f8& v, int32_t* out) { store(out, __builtin_convertvector(v, i8v)); }
template <class H> inline void store_ints(const Pair<H>& v, int32_t* out) {
    store_ints(v.lo, out);
    store_ints(v.hi, out + sizeof(H) / 4);
}

alignas(64) inline constexpr float kSteps[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

// First and last block of sixteen bands; a band that is not touched has first > last.
struct Bands {
    alignas(64) int32_t first[16], last[16];

    // From band `top` on.
    void of(const Record& g, int32_t top, int32_t block_columns) {
        const f16 steps = load<f16>(kSteps);
        const float margin = 1e-3f + 1e-6f * (std::abs(g.x) + g.half_width), tall = g.half_height + margin;
        const f16 from = steps * 4.0f + (4.0f * float(top) + 0.5f - g.y);
        const f16 low = vmax(from, splat16(-tall)), high = vmin(from + 3.0f, splat16(tall));
        const float k = -g.b / (2 * g.a), tip = -g.b / (2 * g.c) * g.half_width;
        const float width2 = (g.log2_opacity + kLog2Of255) / g.a, over = width2 / (g.half_height * g.half_height);
        const f16 right_at = vmin(vmax(splat16(tip), low), high), left_at = vmin(vmax(splat16(-tip), low), high);
        const f16 zero = splat16(0);
        const f16 right = right_at * k + vsqrt(vmax(width2 - over * right_at * right_at, zero));
        const f16 left = left_at * k - vsqrt(vmax(width2 - over * left_at * left_at, zero));
        const f16 a = (left + (g.x - 3.5f - margin)) * 0.25f, b = (right + (g.x - 0.5f + margin)) * 0.25f;
        f16 begin = vmin(vmax(a, zero), splat16(float(block_columns))) + 0.9999f;
        f16 end = vmin(vmax(b, splat16(-1)), splat16(float(block_columns - 1)));
        end = select_less(high, low, splat16(-1), select_less(b, zero, splat16(-1), end));
        store_ints(begin, first);
        store_ints(end, last);
    }
};

// Bits of the blocks from `first` to `last` among 64 that begin with block `base`.
inline uint64_t block_bits(int32_t first, int32_t last, int32_t base) {
    const int32_t a = std::max(first - base, 0), b = std::min(last - base, 63);
    return a > b ? 0 : (~uint64_t(0) << a) & (~uint64_t(0) >> (63 - b));
}

// The tiles that one Gaussian touches, row by row from the left; returns their number. `out` has room for its box.
template <class Count> int32_t list_tiles(const Record& g, const TileGrid& grid, TileMask* out, Count&& count) {
    int32_t n = 0;
    const float margin = 1e-2f;
    const int32_t top = int32_t(std::max(g.y - g.half_height - 0.5f - margin, 0.0f)) / 16;
    const int32_t bottom = std::min(int32_t(std::max(g.y + g.half_height + margin, 0.0f)) / 16, grid.rows - 1);
    Bands bands;
    for (int32_t row = top; row <= bottom; ++row) {
        const int i = 4 * ((row - top) & 3);
        if (i == 0) bands.of(g, 4 * row, 4 * grid.columns);
        const int32_t *first = bands.first + i, *last = bands.last + i;
        const int32_t from = std::min(std::min(first[0], first[1]), std::min(first[2], first[3])) / 4;
        const int32_t to = std::max(std::max(last[0], last[1]), std::max(last[2], last[3]));
        for (int32_t tile = from; 4 * tile <= to; tile += 16) {
            uint64_t bits[4];
            for (int j = 0; j < 4; ++j) bits[j] = block_bits(first[j], last[j], 4 * tile);
            const int32_t end = std::min(tile + 16, to / 4 + 1);
            for (int32_t t = tile; t < end; ++t) {
                uint32_t mask = 0;
                for (int j = 0; j < 4; ++j) {
                    mask |= uint32_t(bits[j] & 15) << (4 * j);
                    bits[j] >>= 4;
                }
                out[n] = {uint32_t(row * grid.columns + t), mask};
                if (mask) count(out[n++].tile);
            }
        }
    }
    return n;
}

// More than list_tiles can return.
inline size_t most_tiles(const Record& g, const TileGrid& grid) {
    const float wide = std::min(2 * g.half_width / 16 + 3, float(grid.columns)), tall = std::min(2 * g.half_height / 16 + 3, float(grid.rows));
    return size_t(wide + 1) * size_t(tall + 1);
}

}  // namespace NERFVOL_ISA
