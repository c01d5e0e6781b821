#include "png.h"

#include <cstdlib>
#include <cstring>
#include <vector>

#include "inflate.h"

namespace nerfvol {
namespace {

// Channels of one pixel, or of one pixel and four bytes of the next that nobody looks at.
typedef uint8_t Four __attribute__((vector_size(4)));
typedef uint8_t Eight __attribute__((vector_size(8)));
typedef int16_t Channels __attribute__((vector_size(16)));

constexpr int64_t kMostPacked = 1032;  // bytes that one of a zlib stream may stand for (258 for two bits)

uint32_t big_endian(const uint8_t* p) { return uint32_t(p[0]) << 24 | uint32_t(p[1]) << 16 | uint32_t(p[2]) << 8 | p[3]; }

// Calls use(name, data, length) with each chunk up to the end's until it returns false; whether the end was reached.
template <class Use> bool each_chunk(const uint8_t* bytes, int64_t n, const Use& use) {
    for (int64_t at = 8; n - at >= 12;) {
        const int64_t length = big_endian(bytes + at);
        if (length > n - at - 12 || !use(bytes + at + 4, bytes + at + 8, length)) return false;
        if (!std::memcmp(bytes + at + 4, "IEND", 4)) return true;
        at += 12 + length;
    }
    return false;
}

Channels widen(const uint8_t* p, int n) {
    Eight b = {};
    std::memcpy(&b, p, size_t(n));
    return __builtin_convertvector(b, Channels);
}

Channels absolute(Channels x) {
    const Channels negative = -x;
    return x > negative ? x : negative;
}

// The filters of PNG (ISO/IEC 15948, 9.2): row and above (n pixels) of kBytes a pixel, `from` as it was filtered.
template <int kBytes> void difference_left(const uint8_t* from, int64_t n, uint8_t* row) {
    std::memcpy(row, from, kBytes);
    for (int64_t i = kBytes; i < kBytes * n; ++i) row[i] = uint8_t(from[i] + row[i - kBytes]);
}

template <int kBytes> void difference_mean(const uint8_t* from, const uint8_t* above, int64_t n, uint8_t* row) {
    for (int64_t i = 0; i < kBytes; ++i) row[i] = uint8_t(from[i] + above[i] / 2);
    for (int64_t i = kBytes; i < kBytes * n; ++i) row[i] = uint8_t(from[i] + (row[i - kBytes] + above[i]) / 2);
}

template <int kBytes> void difference_paeth(const uint8_t* from, const uint8_t* above, int64_t n, uint8_t* row) {
    Channels left = {}, above_left = {};
    for (int64_t x = 0; x < n; ++x) {
        const Channels up = widen(above + kBytes * x, kBytes);
        const Channels by_left = up - above_left, by_up = left - above_left;
        const Channels p_left = absolute(by_left), p_up = absolute(by_up), p_both = absolute(by_left + by_up);
        const Channels of_up = (p_up <= p_both) ? up : above_left;
        const Channels nearest = ((p_left <= p_up) & (p_left <= p_both)) ? left : of_up;
        left = (widen(from + kBytes * x, kBytes) + nearest) & 255;
        above_left = up;
        const Eight narrow = __builtin_convertvector(left, Eight);
        std::memcpy(row + kBytes * x, &narrow, kBytes);
    }
}

// Filtered rows, each after the number of its filter, to pixels; false where there is no such filter.
template <int kBytes> bool unfilter(const uint8_t* from, const PngSize& size, uint8_t* out) {
    const int64_t stride = kBytes * size.width;
    const std::vector<uint8_t> nothing(size_t(stride), 0);
    const uint8_t* above = nothing.data();
    for (int64_t y = 0; y < size.height; ++y, from += stride + 1, above = out, out += stride) {
        const uint8_t* row = from + 1;
        switch (from[0]) {
            case 0: std::memcpy(out, row, size_t(stride)); break;
            case 1: difference_left<kBytes>(row, size.width, out); break;
            case 2:
                for (int64_t i = 0; i < stride; ++i) out[i] = uint8_t(row[i] + above[i]);
                break;
            case 3: difference_mean<kBytes>(row, above, size.width, out); break;
            case 4: difference_paeth<kBytes>(row, above, size.width, out); break;
            default: return false;
        }
    }
    return true;
}

}  // namespace

PngSize png_size(const uint8_t* bytes, int64_t n) {
    if (n < 33 || std::memcmp(bytes, "\x89PNG\r\n\x1a\n\0\0\0\rIHDR", 16)) return {};
    const uint8_t* h = bytes + 16;
    const int64_t width = big_endian(h), height = big_endian(h + 4);
    const bool plain = h[8] == 8 && (h[9] == 2 || h[9] == 6) && !h[10] && !h[11] && !h[12];
    if (!plain || !width || !height || width >> 24 || height >> 24) return {};
    return {height, width, h[9] == 2 ? 3 : 4};
}

bool decode_png(const uint8_t* bytes, int64_t n, const PngSize& size, uint8_t* out) {
    const PngSize declared = png_size(bytes, n);
    if (!declared.channels || declared.channels != size.channels || declared.height != size.height || declared.width != size.width)
        return false;
    std::vector<uint8_t> packed;
    packed.reserve(size_t(n));
    const bool whole = each_chunk(bytes, n, [&](const uint8_t* name, const uint8_t* data, int64_t length) {
        if (!std::memcmp(name, "IDAT", 4)) packed.insert(packed.end(), data, data + length);
        return std::memcmp(name, "tRNS", 4) && std::memcmp(name, "acTL", 4);
    });
    if (!whole) return false;
    const int64_t unpacked = (size.channels * size.width + 1) * size.height;
    if (unpacked / kMostPacked > int64_t(packed.size())) return false;  // before memory is taken for what cannot be there
    std::vector<uint8_t> filtered(static_cast<size_t>(unpacked));
    if (!inflate(packed.data(), int64_t(packed.size()), filtered.data(), int64_t(filtered.size()))) return false;
    return (size.channels == 3 ? unfilter<3> : unfilter<4>)(filtered.data(), size, out);
}

}  // namespace nerfvol
