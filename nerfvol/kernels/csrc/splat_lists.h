// Which tiles and blocks a Gaussian touches: exact to a thousandth of a pixel, a tile's sixteen blocks at a time [Speedy].
//
// In rows dy from the mean, the ellipse alpha >= 1/255 reaches from k dy - h(dy) to k dy + h(dy), h^2 = w (1 - dy^2 / half_height^2).
// Its right edge is farthest at dy = tip, its left edge at -tip, so that a band's extremes are at the tips clamped to the band.
#pragma once
#include <algorithm>
#include <cmath>

#include "splat_project.h"

namespace NERFVOL_ISA {

struct TileMask { uint32_t tile, mask; };    // bit 4 row + column of the mask: a block of 4x4 pixels

// The picture in tiles and in blocks.
struct TileGrid {
    int32_t columns, rows;
    explicit TileGrid(const SplatView& v) : columns(int32_t((v.width + 15) / 16)), rows(int32_t((v.height + 15) / 16)) {}
    int64_t size() const { return int64_t(columns) * rows; }
};

// Where the blocks of a tile begin, in the order of a mask's bits.
alignas(64) inline constexpr float kBlockX[16] = {0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12};
alignas(64) inline constexpr float kBlockY[16] = {0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12};

// How far the ellipse reaches in the four bands of a row of tiles, as x of the picture, one lane per block.
struct BandEdges {
    float k, tip, width2, over, tall, margin, x, y;

    explicit BandEdges(const Record& g) : x(g.x), y(g.y) {
        margin = 1e-3f + 1e-6f * (std::abs(g.x) + g.half_width);
        tall = g.half_height + margin;
        const float inverse = 1 / (g.a * g.c), slope = -0.5f * g.b * inverse;
        k = slope * g.c;
        tip = slope * g.a * g.half_width;
        width2 = (g.log2_opacity + kLog2Of255) * (g.c * inverse);
        over = width2 / (g.half_height * g.half_height);
    }
    // A band that is not touched has left > right.
    void of(int32_t tile_row, f16& left, f16& right) const {
        const f16 from = load<f16>(kBlockY) + (16.0f * float(tile_row) + 0.5f - y);
        const f16 low = vmax(from, splat16(-tall)), high = vmin(from + 3.0f, splat16(tall));
        const f16 right_at = vmin(vmax(splat16(tip), low), high), left_at = vmin(vmax(splat16(-tip), low), high), zero = splat16(0);
        right = right_at * k + vsqrt(vmax(width2 - over * right_at * right_at, zero)) + (x + margin);
        left = left_at * k - vsqrt(vmax(width2 - over * left_at * left_at, zero)) + (x - margin);
        left = select_less(high, low, splat16(1e9f), left);
        right = select_less(high, low, splat16(-1e9f), right);
    }
};

// The tiles that one Gaussian touches, row by row from the left; returns their number. `out` has room for its box.
template <class Count> int32_t list_tiles(const Record& g, const TileGrid& grid, TileMask* out, Count&& count) {
    int32_t n = 0;
    const float margin = 1e-2f;
    const int32_t top = int32_t(std::max(g.y - g.half_height - 0.5f - margin, 0.0f)) / 16;
    const int32_t bottom = int32_t(std::clamp(g.y + g.half_height + margin, 0.0f, 16.0f * float(grid.rows) - 1)) / 16;
    const BandEdges edges(g);
    const f16 first_pixel = load<f16>(kBlockX) + 0.5f;
    for (int32_t row = top; row <= bottom; ++row) {
        f16 left, right;
        edges.of(row, left, right);
        const float from = std::max(least(left) - 0.5f, 0.0f), to = std::min(-least(-right), 16.0f * float(grid.columns) - 1);
        if (!(from <= to)) continue;
        right -= first_pixel;              // a block is touched where its first pixel is left of that
        left -= first_pixel + 3.0f;        // and its last one right of this
        for (int32_t tile = int32_t(from) / 16; tile <= int32_t(to) / 16; ++tile) {
            const f16 begin = splat16(16.0f * float(tile));
            const uint32_t mask = ~(greater_bits(begin, right) | greater_bits(left, begin)) & 0xffff;
            out[n] = {uint32_t(row * grid.columns + tile), mask};
            if (mask) count(out[n++].tile);
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
