// zlib streams (RFC 1950, 1951) for the page: a browser's own streams take several times as long for planes of megabytes.
#include <algorithm>
#include <cstring>

#include "web.h"

namespace nerfvol {
namespace {

constexpr int kFastBits = 10, kLongest = 15;

// The bits of a stream, lowest first. Beyond the end there are zeros, and `over` counts them.
struct Bits {
    const uint8_t *at, *end;
    uint64_t buffer = 0;
    int n = 0, over = 0;

    void fill() {
        while (n <= 56) {
            if (at < end) buffer |= uint64_t(*at++) << n;
            else ++over;
            n += 8;
        }
    }
    uint32_t take(int count) {
        fill();
        const uint32_t bits = uint32_t(buffer & ((uint64_t(1) << count) - 1));
        buffer >>= count;
        n -= count;
        return bits;
    }
    bool past_end() const { return 8 * over > n; }
    // To the next whole byte, whose place is returned.
    const uint8_t* byte() {
        const int whole = n / 8 - over;
        at -= std::max(whole, 0);
        buffer = 0;
        n = over = 0;
        return at;
    }
};

// A canonical Huffman code: short words by a table, long ones by counting.
class Code {
public:
    // lengths (n) of each symbol's word, 0: none. False where they make no code.
    bool build(const uint8_t* lengths, int n) {
        uint16_t offsets[kLongest + 2] = {}, next[kLongest + 1] = {};
        std::memset(count_, 0, sizeof(count_));
        for (int s = 0; s < n; ++s) ++count_[lengths[s]];
        count_[0] = 0;
        int left = 1;
        for (int l = 1; l <= kLongest; ++l) {
            left = 2 * left - count_[l];
            if (left < 0) return false;
            offsets[l + 1] = uint16_t(offsets[l] + count_[l]);
        }
        for (int l = 1, code = 0; l <= kLongest; ++l) {
            code = (code + count_[l - 1]) << 1;
            next[l] = uint16_t(code);
        }
        std::memset(fast_, 0, sizeof(fast_));
        for (int s = 0; s < n; ++s) {
            const int l = lengths[s];
            if (!l) continue;
            symbols_[offsets[l]++] = uint16_t(s);
            uint32_t word = next[l]++, reversed = 0;
            for (int b = 0; b < l; ++b) reversed |= (word >> b & 1) << (l - 1 - b);
            for (uint32_t i = reversed; l <= kFastBits && i < 1u << kFastBits; i += 1u << l) fast_[i] = uint16_t(s << 4 | l);
        }
        return true;
    }

    // The next symbol; -1: there is none.
    int next(Bits& bits) const {
        if (bits.n < 48) bits.fill();
        if (const uint16_t entry = fast_[bits.buffer & ((1u << kFastBits) - 1)]) {
            bits.buffer >>= entry & 15;
            bits.n -= entry & 15;
            return entry >> 4;
        }
        int code = 0, first = 0, index = 0;
        for (int l = 1; l <= kLongest; ++l) {
            code |= int(bits.buffer >> (l - 1) & 1);
            if (code - first < count_[l]) {
                bits.buffer >>= l;
                bits.n -= l;
                return symbols_[index + code - first];
            }
            index += count_[l];
            first = (first + count_[l]) << 1;
            code <<= 1;
        }
        return -1;
    }

private:
    uint16_t count_[kLongest + 1], symbols_[288], fast_[1 << kFastBits];
};

constexpr uint16_t kLengthBase[29] = {3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258};
constexpr uint8_t kLengthBits[29] = {0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0};
constexpr uint16_t kDistanceBase[30] = {1, 2, 3, 4, 5, 7, 9, 13, 17, 25, 33, 49, 65, 97, 129, 193, 257, 385, 513, 769, 1025, 1537, 2049, 3073, 4097, 6145, 8193, 12289, 16385, 24577};

bool read_codes(Bits& bits, Code& literals, Code& distances) {
    static constexpr uint8_t kOrder[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
    const int n_literals = int(bits.take(5)) + 257, n_distances = int(bits.take(5)) + 1, n_lengths = int(bits.take(4)) + 4;
    if (n_literals > 286 || n_distances > 30) return false;
    uint8_t lengths[320] = {};
    for (int i = 0; i < n_lengths; ++i) lengths[kOrder[i]] = uint8_t(bits.take(3));
    Code of_lengths;
    if (!of_lengths.build(lengths, 19)) return false;
    std::memset(lengths, 0, sizeof(lengths));
    for (int i = 0; i < n_literals + n_distances;) {
        const int symbol = of_lengths.next(bits);
        if (symbol < 0 || bits.past_end()) return false;
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
    return lengths[256] && literals.build(lengths, n_literals) && distances.build(lengths + n_literals, n_distances);
}

// One block of compressed symbols; the new end of what was written, or null.
uint8_t* read_block(Bits& bits, const Code& literals, const Code& distances, const uint8_t* begin, uint8_t* to, const uint8_t* end) {
    for (;;) {
        const int symbol = literals.next(bits);
        if (symbol < 0 || bits.past_end()) return nullptr;
        if (symbol < 256) {
            if (to == end) return nullptr;
            *to++ = uint8_t(symbol);
            continue;
        }
        if (symbol == 256) return to;
        if (symbol > 285) return nullptr;
        const int length = kLengthBase[symbol - 257] + int(bits.take(kLengthBits[symbol - 257]));
        const int which = distances.next(bits);
        if (which < 0 || which > 29) return nullptr;
        const int distance = kDistanceBase[which] + int(bits.take(which < 2 ? 0 : which / 2 - 1));
        if (distance > to - begin || length > end - to) return nullptr;
        for (int i = 0; i < length; ++i, ++to) *to = to[-distance];
    }
}

uint32_t adler(const uint8_t* p, int64_t n) {
    uint32_t a = 1, b = 0;
    while (n > 0) {
        const int64_t few = std::min<int64_t>(n, 5552);  // as many as do not overflow
        for (int64_t i = 0; i < few; ++i) { a += *p++; b += a; }
        a %= 65521;
        b %= 65521;
        n -= few;
    }
    return b << 16 | a;
}

}  // namespace

bool inflate(const uint8_t* from, int64_t n_from, uint8_t* to, int64_t n) {
    if (n_from < 6 || (from[0] & 15) != 8 || from[1] & 32 || (from[0] * 256 + from[1]) % 31) return false;
    Bits bits{from + 2, from + n_from - 4};
    uint8_t *at = to, *const end = to + n;
    Code literals, distances;
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
            literals.build(lengths, 288);
            distances.build(same, 30);
        } else if (!read_codes(bits, literals, distances)) {
            return false;
        }
        if (!(at = read_block(bits, literals, distances, to, at, end))) return false;
    }
    const uint8_t* sum = from + n_from - 4;
    return at == end && adler(to, n) == (uint32_t(sum[0]) << 24 | uint32_t(sum[1]) << 16 | uint32_t(sum[2]) << 8 | sum[3]);
}

}  // namespace nerfvol
