// Huffman words of a zlib stream (RFC 1951): the bits of the stream, and a table of what the next ones mean.
#pragma once
#include <algorithm>
#include <cstdint>
#include <cstring>

namespace nerfvol {

constexpr int kLongest = 15;

// The bits of a stream, lowest first: n of them are in the buffer. Beyond the end there are zeros, and `over` counts their bytes.
struct Bits {
    const uint8_t *at, *end;
    uint64_t buffer = 0;
    int n = 0, over = 0;

    // 56 bits at least.
    void fill() {
#if __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__
        if (end - at >= 8) {  // what is read beyond the n bits now is read again later, the same
            uint64_t next;
            std::memcpy(&next, at, 8);
            buffer |= next << n;
            at += (63 - n) >> 3;
            n |= 56;
            return;
        }
#endif
        while (n < 56) {
            if (at < end) buffer |= uint64_t(*at++) << n;
            else ++over;
            n += 8;
        }
    }
    void skip(int count) {
        buffer >>= count;
        n -= count;
    }
    uint32_t take(int count) {
        fill();
        return taken(count);
    }
    // The same where it is known that so many are there.
    uint32_t taken(int count) {
        const uint32_t bits = uint32_t(buffer) & ((1u << count) - 1);
        skip(count);
        return bits;
    }
    bool past_end() const { return 8 * over > n; }
    // To the next whole byte, whose place is returned.
    const uint8_t* byte() {
        at -= std::max(n / 8 - over, 0);
        buffer = 0;
        n = over = 0;
        return at;
    }
};

// What a word means: its bits, extra bits that follow, a kind, and a byte, length, distance or symbol they are added to.
enum Kind : uint32_t { kNothing = 0, kByte = 1 << 13, kMatch = 2 << 13, kEnd = 3 << 13, kKinds = 3 << 13 };
inline int word_bits(uint32_t meaning) { return int(meaning & 31); }
inline int extra_bits(uint32_t meaning) { return int(meaning >> 8 & 31); }
inline uint32_t meaning_of(Kind kind, uint32_t base, uint32_t extra = 0) { return base << 16 | kind | extra << 8; }

// A canonical Huffman code: words of at most kFast bits by a table, longer ones by counting.
template <int kFast> class Code {
public:
    // lengths (n) of each symbol's word, 0: none. False where they make no code.
    template <class Meaning> bool build(const uint8_t* lengths, int n, const Meaning& meaning) {
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
            meanings_[offsets[l]++] = meaning(s) | uint32_t(l);
            uint32_t word = next[l]++, reversed = 0;
            for (int b = 0; b < l; ++b) reversed |= (word >> b & 1) << (l - 1 - b);
            for (uint32_t i = reversed; l <= kFast && i < 1u << kFast; i += 1u << l) fast_[i] = meaning(s) | uint32_t(l);
        }
        return true;
    }

    // What the next word of the buffer means, without taking it; 0: there is no such word.
    uint32_t find(uint64_t buffer) const {
        const uint32_t found = fast_[buffer & ((1u << kFast) - 1)];
        return found ? found : find_long(buffer);
    }

private:
    uint32_t find_long(uint64_t buffer) const {
        int code = 0, first = 0, index = 0;
        for (int l = 1; l <= kLongest; ++l) {
            code |= int(buffer >> (l - 1) & 1);
            if (code - first < count_[l]) return meanings_[index + code - first];
            index += count_[l];
            first = (first + count_[l]) << 1;
            code <<= 1;
        }
        return 0;
    }

    uint16_t count_[kLongest + 1];
    uint32_t meanings_[288], fast_[1 << kFast];
};

}  // namespace nerfvol
