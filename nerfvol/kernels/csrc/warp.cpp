#include "warp.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "clones.h"
#include "pool.h"

namespace nerfvol {
namespace {

typedef float Four __attribute__((vector_size(16)));
typedef int32_t FourInts __attribute__((vector_size(16)));
typedef uint32_t FourCounts __attribute__((vector_size(16)));
// Four pixels of four bytes: a row of the bicubic's taps.
typedef float Taps __attribute__((vector_size(64)));
typedef uint8_t TapBytes __attribute__((vector_size(16)));
typedef int32_t TapInts __attribute__((vector_size(64)));

// Weights of the pixels at -1, 0, 1, 2 for a position t in [0, 1] between 0 and 1.
NERFVOL_INLINE Four cubic_weights(float t) {
    const Four three = {-0.5f, 1.5f, -1.5f, 0.5f}, two = {1.0f, -2.5f, 2.0f, -0.5f}, one = {-0.5f, 0.0f, 0.5f, 0.0f};
    const Four none = {0.0f, 1.0f, 0.0f, 0.0f};
    return ((three * t + two) * t + one) * t + none;
}

#define NERFVOL_FOUR(a, b, c, d) {a, a, a, a, b, b, b, b, c, c, c, c, d, d, d, d}

// The same, each weight four times.
NERFVOL_INLINE Taps tap_weights(float t) {
    const Taps three = NERFVOL_FOUR(-0.5f, 1.5f, -1.5f, 0.5f), two = NERFVOL_FOUR(1.0f, -2.5f, 2.0f, -0.5f);
    const Taps one = NERFVOL_FOUR(-0.5f, 0.0f, 0.5f, 0.0f), none = NERFVOL_FOUR(0.0f, 1.0f, 0.0f, 0.0f);
    return ((three * t + two) * t + one) * t + none;
}
#undef NERFVOL_FOUR

NERFVOL_INLINE Taps widen(const uint8_t* p) {
    TapBytes b;
    std::memcpy(&b, p, sizeof b);
    return __builtin_convertvector(__builtin_convertvector(b, TapInts), Taps);
}

inline int64_t clamp(int64_t i, int64_t size) { return i < 0 ? 0 : i >= size ? size - 1 : i; }

// The source with four bytes a pixel and kPad pixels of its edge repeated around, so that no tap needs a check.
constexpr int64_t kPad = 3;
template <int kChannels> std::vector<uint8_t> padded(const Bytes& s) {
    const int64_t wide = s.width + 2 * kPad;
    std::vector<uint8_t> out(size_t(4 * wide * (s.height + 2 * kPad)));
    const auto copy = [](const uint8_t* from, uint8_t* to) {
        to[0] = from[0]; to[1] = from[1]; to[2] = from[2];
        to[3] = kChannels == 4 ? from[3] : 255;
    };
    for (int64_t y = -kPad; y < s.height + kPad; ++y) {
        const uint8_t* from = s.bytes + clamp(y, s.height) * s.width * kChannels;
        uint8_t* to = out.data() + 4 * wide * (y + kPad);
        for (int64_t x = 0; x < s.width; ++x) copy(from + kChannels * x, to + 4 * (x + kPad));
        for (int64_t x = 0; x < kPad; ++x) {
            copy(from, to + 4 * x);
            copy(from + kChannels * (s.width - 1), to + 4 * (s.width + kPad + x));
        }
    }
    return out;
}

// One row of the grid, between its rows: (columns, 2).
void grid_row(const PositionGrid& g, int64_t y, float* out) {
    const float at = float(y) / float(g.step);
    const int64_t i = std::min(int64_t(at), std::max<int64_t>(g.rows - 2, 0));
    const float t = g.rows > 1 ? at - float(i) : 0.0f;
    const float *a = g.positions + 2 * i * g.columns, *b = g.rows > 1 ? a + 2 * g.columns : a;
    for (int64_t k = 0; k < 2 * g.columns; ++k) out[k] = a[k] + t * (b[k] - a[k]);
}

// Where a row's pixels lie in the source: the first of the taps (x, y, in the padded source) and the parts of a pixel.
struct Places {
    std::vector<int32_t> x, y;
    std::vector<float> u, v;
    std::vector<uint8_t> inside;
    explicit Places(size_t n) : x(n), y(n), u(n), v(n), inside(n) {}
};

NERFVOL_INLINE void place_row(const Bytes& s, const PositionGrid& g, const float* nodes, int32_t width, Places& out) {
    const float right = float(s.width), bottom = float(s.height), per_node = 1.0f / float(g.step);
    const int32_t last = int32_t(std::max<int64_t>(g.columns - 2, 0)), next = g.columns > 1 ? 2 : 0;
    int32_t *to_x = out.x.data(), *to_y = out.y.data();
    float *to_u = out.u.data(), *to_v = out.v.data();
    uint8_t* inside = out.inside.data();
    NERFVOL_APART
    for (int32_t x = 0; x < width; ++x) {
        const float at = float(x) * per_node;
        const int32_t i = std::min(int32_t(at), last);
        const float t = at - float(i);
        const float a0 = nodes[2 * i], a1 = nodes[2 * i + 1];
        const float u = a0 + t * (nodes[2 * i + next] - a0), v = a1 + t * (nodes[2 * i + next + 1] - a1);
        inside[x] = (u >= 0.0f) & (u <= right) & (v >= 0.0f) & (v <= bottom);
        float su = u > 0.0f ? u : 0.0f, sv = v > 0.0f ? v : 0.0f;  // what is no number becomes 0
        su = (su < right ? su : right) + 0.5f;
        sv = (sv < bottom ? sv : bottom) + 0.5f;
        const int32_t iu = int32_t(su), iv = int32_t(sv);  // the pixel before, counted from one before the picture
        to_u[x] = su - float(iu);
        to_v[x] = sv - float(iv);
        to_x[x] = iu + int32_t(kPad) - 2;
        to_y[x] = iv + int32_t(kPad) - 2;
    }
}

NERFVOL_INLINE void remap_body(const uint8_t* source, const Bytes& s, const PositionGrid& g, const float* nodes, int64_t width,
                               Places& places, uint8_t* out) {
    place_row(s, g, nodes, int32_t(width), places);
    const int64_t wide = 4 * (s.width + 2 * kPad);
    const Four zero = {0.0f, 0.0f, 0.0f, 0.0f}, most = {255.0f, 255.0f, 255.0f, 255.0f};
    for (int64_t x = 0; x < width; ++x, out += 4) {
        const Four wy = cubic_weights(places.v[size_t(x)]);
        const uint8_t* p = source + places.y[size_t(x)] * wide + 4 * places.x[size_t(x)];
        const Taps row = wy[0] * widen(p) + wy[1] * widen(p + wide) + wy[2] * widen(p + 2 * wide) + wy[3] * widen(p + 3 * wide);
        const Taps weighted = row * tap_weights(places.u[size_t(x)]);
        Four part[4];
        std::memcpy(part, &weighted, sizeof part);
        Four sum = (part[0] + part[1]) + (part[2] + part[3]) + 0.5f;
        sum = sum > zero ? sum : zero;
        sum = sum < most ? sum : most;
        const FourInts whole = __builtin_convertvector(sum, FourInts);
        for (int c = 0; c < 4; ++c) out[c] = uint8_t(whole[c]);
        if (!places.inside[size_t(x)]) out[3] = 0;
    }
}

using RemapRow = void (*)(const uint8_t*, const Bytes&, const PositionGrid&, const float*, int64_t, Places&, uint8_t*);
void remap_row(const uint8_t* p, const Bytes& s, const PositionGrid& g, const float* nodes, int64_t width, Places& at, uint8_t* out) {
    remap_body(p, s, g, nodes, width, at, out);
}
#ifdef NERFVOL_CLONES
NERFVOL_AVX2 void remap_avx2(const uint8_t* p, const Bytes& s, const PositionGrid& g, const float* nodes, int64_t width, Places& at, uint8_t* out) {
    remap_body(p, s, g, nodes, width, at, out);
}
NERFVOL_AVX512 void remap_avx512(const uint8_t* p, const Bytes& s, const PositionGrid& g, const float* nodes, int64_t width, Places& at, uint8_t* out) {
    remap_body(p, s, g, nodes, width, at, out);
}
#endif

RemapRow chosen() {
#ifdef NERFVOL_CLONES
    return choose_clone<RemapRow>(remap_row, remap_avx2, remap_avx512);
#else
    return remap_row;
#endif
}

// One block: any weights, any size.
void mean_of_block(const Bytes& s, int64_t top, int64_t left, int64_t factor, uint8_t* out) {
    uint64_t sums[3] = {0, 0, 0}, plain[3] = {0, 0, 0}, weight = 0, n = 0;
    for (int64_t y = top; y < std::min(top + factor, s.height); ++y)
        for (int64_t x = left; x < std::min(left + factor, s.width); ++x, ++n) {
            const uint8_t* p = s.bytes + (y * s.width + x) * s.channels;
            const uint64_t a = s.channels == 4 ? p[3] : 255;
            weight += a;
            for (int c = 0; c < 3; ++c) {
                sums[c] += a * p[c];
                plain[c] += p[c];
            }
        }
    const uint64_t full = uint64_t(factor) * uint64_t(factor);
    for (int c = 0; c < 3; ++c)
        out[c] = uint8_t(weight ? (sums[c] + weight / 2) / weight : n ? (plain[c] + n / 2) / n : 0);
    out[3] = uint8_t((weight + full / 2) / full);
}

// The blocks of one row that are whole and of full or no weight, from the sums of their columns; the others one by one.
void reduce_row(const Bytes& s, int64_t factor, int64_t y, int64_t blocks, std::vector<uint32_t>& columns, uint8_t* out) {
    const int64_t top = y * factor, n = s.width * s.channels;
    const bool whole = top + factor <= s.height;
    std::fill(columns.begin(), columns.end(), 0u);
    for (int64_t row = top; whole && row < top + factor; ++row) {
        const uint8_t* p = s.bytes + row * n;
        for (int64_t k = 0; k < n; ++k) columns[size_t(k)] += p[k];
    }
    const uint32_t full = uint32_t(factor * factor), half = full / 2;
    const int shift = full & (full - 1) ? -1 : __builtin_ctz(full);  // a division costs more than all the rest
    for (int64_t x = 0; x < blocks; ++x, out += 4) {
        const int64_t left = x * factor;
        const bool inside = whole && left + factor <= s.width;
        FourCounts sums = {0, 0, 0, 0};
        const uint32_t* p = columns.data() + left * s.channels;
        for (int64_t k = 0; inside && k < factor; ++k, p += s.channels) {
            FourCounts pixel;
            std::memcpy(&pixel, p, sizeof pixel);
            sums += pixel;
        }
        if (s.channels == 3) sums[3] = 255 * full;
        if (!inside || (sums[3] != 255 * full && sums[3] != 0)) {
            mean_of_block(s, top, left, factor, out);
            continue;
        }
        const FourCounts mean = shift < 0 ? (sums + half) / full : (sums + half) >> shift;
        for (int c = 0; c < 4; ++c) out[c] = uint8_t(mean[c]);
        out[3] = sums[3] ? 255 : 0;
    }
}

void sample_cubic(const float* picture, int64_t height, int64_t width, int64_t channels, float x, float y, float* out) {
    const int64_t i = int64_t(std::floor(x)), j = int64_t(std::floor(y));
    const Four wx = cubic_weights(x - float(i)), wy = cubic_weights(y - float(j));
    std::fill(out, out + channels, 0.0f);
    for (int b = 0; b < 4; ++b) {
        const float* row = picture + clamp(j - 1 + b, height) * width * channels;
        for (int a = 0; a < 4; ++a) {
            const float w = wy[b] * wx[a];
            const float* p = row + clamp(i - 1 + a, width) * channels;
            for (int64_t c = 0; c < channels; ++c) out[c] += w * p[c];
        }
    }
}

void sample_linear(const float* picture, int64_t height, int64_t width, int64_t channels, float x, float y, float* out) {
    const int64_t i = int64_t(std::floor(x)), j = int64_t(std::floor(y));
    const float u = x - float(i), v = y - float(j);
    const float *top = picture + clamp(j, height) * width * channels, *low = picture + clamp(j + 1, height) * width * channels;
    const int64_t a = clamp(i, width) * channels, b = clamp(i + 1, width) * channels;
    for (int64_t c = 0; c < channels; ++c)
        out[c] = (1 - v) * ((1 - u) * top[a + c] + u * top[b + c]) + v * ((1 - u) * low[a + c] + u * low[b + c]);
}

}  // namespace

void remap(const Bytes& source, const PositionGrid& grid, int64_t used_height, int64_t used_width, int64_t height,
           int64_t width, uint8_t* out) {
    const std::vector<uint8_t> pixels = source.channels == 4 ? padded<4>(source) : padded<3>(source);
    std::vector<float> nodes(size_t(2 * grid.columns));
    Places places(static_cast<size_t>(used_width));
    const RemapRow remap_row = chosen();
    for (int64_t y = 0; y < height; ++y) {
        uint8_t* row = out + 4 * y * width;
        const int64_t used = y < used_height ? used_width : 0;
        if (used) {
            grid_row(grid, y, nodes.data());
            remap_row(pixels.data(), source, grid, nodes.data(), used, places, row);
        }
        std::memset(row + 4 * used, 0, size_t(4 * (width - used)));
    }
}

void reduce(const Bytes& source, int64_t factor, int64_t height, int64_t width, uint8_t* out) {
    const int64_t columns = std::min((source.width + factor - 1) / factor, width);
    const int64_t rows = std::min((source.height + factor - 1) / factor, height);
    std::vector<uint32_t> sums(size_t(source.width * source.channels + 1));  // the last pixel of three is read as four
    for (int64_t y = 0; y < height; ++y) {
        uint8_t* row = out + 4 * y * width;
        const int64_t used = y < rows ? columns : 0;
        if (used) reduce_row(source, factor, y, used, sums, row);
        std::memset(row + 4 * used, 0, size_t(4 * (width - used)));
    }
}

void sample(const float* picture, int64_t height, int64_t width, int64_t channels, const float* positions, int64_t n,
            bool cubic, float* out) {
    constexpr int64_t kRun = 4096;
    parallel_for(int((n + kRun - 1) / kRun), [&](int run, int) {
        for (int64_t i = run * kRun; i < std::min((run + 1) * kRun, n); ++i) {
            // Clamped so that no position, not even one that is no number, becomes an index far away.
            const float px = positions[2 * i] - 0.5f, py = positions[2 * i + 1] - 0.5f;
            const float x = std::min(px > 0.0f ? px : 0.0f, float(width - 1));
            const float y = std::min(py > 0.0f ? py : 0.0f, float(height - 1));
            (cubic ? sample_cubic : sample_linear)(picture, height, width, channels, x, y, out + i * channels);
        }
    });
}

}  // namespace nerfvol
