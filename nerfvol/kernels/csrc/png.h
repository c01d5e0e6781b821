// PNG files of the plain kind: 8 bits a channel, RGB or RGBA, not interlaced. Whoever gets a no asks a library, which knows the
// other kinds, and what is wrong with a file that is damaged.
#pragma once
#include <cstdint>

namespace nerfvol {

// Sides in pixels and bytes a pixel.
struct PngSize {
    int64_t height = 0, width = 0;
    int channels = 0;
};

// What the header of the file `bytes` (n) declares; no pixels where it is not of the plain kind.
PngSize png_size(const uint8_t* bytes, int64_t n);

// The pixels, out (height, width, channels) as `size` says; false where the file is damaged, holds what is not of the plain kind
// (transparency by colour, animation), or is of another size.
bool decode_png(const uint8_t* bytes, int64_t n, const PngSize& size, uint8_t* out);

}  // namespace nerfvol
