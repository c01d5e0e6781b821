// Pictures resampled: through a lens (undistortion and back) and by averaging blocks. Pixel (i, j) covers [i, i + 1) x
// [j, j + 1); positions are (x, y) in pixels. Bicubic is the cubic of R. Keys, 1981, with a = -1/2 (Catmull-Rom).
#pragma once
#include <cstdint>

namespace nerfvol {

// bytes: (height, width, channels), 3 or 4 channels.
struct Bytes {
    const uint8_t* bytes;
    int64_t height, width;
    int channels;
};

// Positions in the source of the centres of every step-th pixel of the target, (rows, columns, 2): linear between them.
struct PositionGrid {
    const float* positions;
    int64_t rows, columns;
    int step;
};

// out (height, width, 4): the source bicubically at the grid's positions. The fourth is the source's own, or 255; outside
// the source it is 0 and colours are those of the nearest edge. Pixels beyond used_height or used_width become 0.
void remap(const Bytes& source, const PositionGrid& grid, int64_t used_height, int64_t used_width, int64_t height,
           int64_t width, uint8_t* out);

// out (height, width, 4): means of factor x factor blocks, colours weighted by the fourth channel (1 where there is none);
// what a block at the edge lacks counts as weight 0.
void reduce(const Bytes& source, int64_t factor, int64_t height, int64_t width, uint8_t* out);

// out (n, channels): the picture (height, width, channels) at positions (n, 2); beyond the edges its nearest pixel.
void sample(const float* picture, int64_t height, int64_t width, int64_t channels, const float* positions, int64_t n,
            bool cubic, float* out);

}  // namespace nerfvol
