#include "inflate.h"

#include <algorithm>
#include <cstring>

#include "huffman.h"

namespace nerfvol {
namespace {

using Literals = Code<11>;
using Distances = Code<9>;

uint32_t literal(int symbol) {
    static constexpr uint16_t kBase[29] = {3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258};
    static constexpr uint8_t kExtra[29] = {0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0};
    if (symbol < 256) return meaning_of(kByte, uint32_t(symbol));
    if (symbol == 256) return meaning_of(kEnd, 0);
    return symbol > 285 ? meaning_of(kNothing, 0) : meaning_of(kMatch, kBase[symbol - 257], kExtra[symbol - 257]);
}

uint32_t distance(int symbol) {
    static constexpr uint16_t kBase[30] = {1, 2, 3, 4, 5, 7, 9, 13, 17, 25, 33, 49, 65, 97, 129, 193, 257, 385, 513, 769, 1025, 1537, 2049, 3073, 4097, 6145, 8193, 12289, 16385, 24577};
    return symbol > 29 ? meaning_of(kNothing, 0) : meaning_of(kMatch, kBase[symbol], uint32_t(symbol < 2 ? 0 : symbol / 2 - 1));
}

bool read_codes(Bits& bits, Literals& literals, Distances& distances) {
    static constexpr uint8_t kOrder[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
    const int n_literals = int(bits.take(5)) + 257, n_distances = int(bits.take(5)) + 1, n_lengths = int(bits.take(4)) + 4;
    if (n_literals > 286 || n_distances > 30) return false;
    uint8_t lengths[320] = {};
    for (int i = 0; i < n_lengths; ++i) lengths[kOrder[i]] = uint8_t(bits.take(3));
    Code<7> of_lengths;
    if (!of_lengths.build(lengths, 19, [](int s) { return meaning_of(kByte, uint32_t(s)); })) return false;
    std::memset(lengths, 0, sizeof(lengths));
    for (int i = 0; i < n_literals + n_distances;) {
        bits.fill();
        const uint32_t found = of_lengths.find(bits.buffer);
        bits.skip(word_bits(found));
        if (!found || bits.past_end()) return false;
        const uint32_t symbol = found >> 16;
        if (symbol < 16) {
            lengths[i++] = uint8_t(symbol);
            continue;
        }
        if (symbol == 16 && !i) return false;
        const uint8_t value = symbol == 16 ? lengths[i - 1] : 0;
        const int times = symbol == 16 ? 3 + int(bits.take(2)) : symbol == 17 ? 3 + int(bits.take(3)) : 11 + int(bits.take(7));
        if (i + times > n_literals + n_distances) return false;
        std::fill_n(lengths + i, times, value);
        i += times;
    }
    return lengths[256] && literals.build(lengths, n_literals, literal) && distances.build(lengths + n_literals, n_distances, distance);
}

// The `length` bytes that lie `back` before `to`, to there; `room`: so many may be written, what is beyond is written later.
inline void repeat(uint8_t* to, int back, int length, int64_t room) {
    const uint8_t* from = to - back;
    uint8_t* const end = to + length;
    if (room < length + 8 || (back < 8 && (8 % back))) {
        while (to < end) *to++ = *from++;
        return;
    }
    if (back >= 8) {
        for (; to < end; to += 8, from += 8) std::memcpy(to, from, 8);
        return;
    }
    uint8_t pattern[8];
    for (int i = 0; i < 8; ++i) pattern[i] = from[i % back];
    for (; to < end; to += 8) std::memcpy(to, pattern, 8);
}

// One block of compressed symbols; the new end of what was written, or null.
uint8_t* read_block(Bits& bits, const Literals& literals, const Distances& distances, const uint8_t* begin, uint8_t* to, const uint8_t* end) {
    for (;;) {
        bits.fill();
        uint32_t found = literals.find(bits.buffer);
        // Of 56 bits three words take at most 45, or two and a length with its extra bits 50.
        for (int i = 0; i < 2 && (found & kKinds) == kByte; ++i) {
            if (to == end) return nullptr;
            *to++ = uint8_t(found >> 16);
            bits.skip(word_bits(found));
            found = literals.find(bits.buffer);
        }
        bits.skip(word_bits(found));
        if (bits.over && bits.past_end()) return nullptr;
        if ((found & kKinds) == kByte) {
            if (to == end) return nullptr;
            *to++ = uint8_t(found >> 16);
            continue;
        }
        if ((found & kKinds) != kMatch) return (found & kKinds) == kEnd ? to : nullptr;
        const int length = int(found >> 16) + int(bits.taken(extra_bits(found)));
        bits.fill();
        const uint32_t where = distances.find(bits.buffer);
        if ((where & kKinds) != kMatch) return nullptr;
        bits.skip(word_bits(where));
        const int back = int(where >> 16) + int(bits.taken(extra_bits(where)));
        if (back > to - begin || length > end - to) return nullptr;
        repeat(to, back, length, end - to);
        to += length;
    }
}

uint32_t adler(const uint8_t* p, int64_t n) {
    uint32_t a = 1, b = 0;
    while (n > 0) {
        int64_t few = std::min<int64_t>(n, 5552);  // as many as do not overflow
        n -= few;
        for (; few >= 32; few -= 32, p += 32) {
            uint32_t sum = 0, weighted = 0;
            for (uint32_t i = 0; i < 32; ++i) {
                sum += p[i];
                weighted += (32 - i) * p[i];
            }
            b += 32 * a + weighted;
            a += sum;
        }
        for (; few > 0; --few) {
            a += *p++;
            b += a;
        }
        a %= 65521;
        b %= 65521;
    }
    return b << 16 | a;
}

}  // namespace

bool inflate(const uint8_t* from, int64_t n_from, uint8_t* to, int64_t n) {
    if (n_from < 6 || (from[0] & 15) != 8 || from[1] & 32 || (from[0] * 256 + from[1]) % 31) return false;
    Bits bits{from + 2, from + n_from - 4};
    uint8_t *at = to, *const end = to + n;
    Literals literals;
    Distances distances;
    for (bool last = false; !last;) {
        last = bits.take(1);
        const uint32_t kind = bits.take(2);
        if (kind == 3 || bits.past_end()) return false;
        if (kind == 0) {
            const uint8_t* p = bits.byte();
            if (bits.end - p < 4) return false;
            const int64_t length = p[0] | p[1] << 8;
            if (length != ((p[2] | p[3] << 8) ^ 0xffff) || length > bits.end - p - 4 || length > end - at) return false;
            std::memcpy(at, p + 4, size_t(length));
            at += length;
            bits.at = p + 4 + length;
            continue;
        }
        if (kind == 1) {
            uint8_t lengths[288], same[30];
            for (int s = 0; s < 288; ++s) lengths[s] = s < 144 ? 8 : s < 256 ? 9 : s < 280 ? 7 : 8;
            std::fill_n(same, 30, uint8_t(5));
            literals.build(lengths, 288, literal);
            distances.build(same, 30, distance);
        } else if (!read_codes(bits, literals, distances)) {
            return false;
        }
        if (!(at = read_block(bits, literals, distances, to, at, end))) return false;
    }
    const uint8_t* sum = from + n_from - 4;
    return at == end && adler(to, n) == (uint32_t(sum[0]) << 24 | uint32_t(sum[1]) << 16 | uint32_t(sum[2]) << 8 | sum[3]);
}

}  // namespace nerfvol
