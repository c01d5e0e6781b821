// What a vertex row's numbers are stored as: float; in a page, where every worker holds a copy of the octree, bfloat16.
#pragma once
#include <cstdint>
#include <cstring>

namespace nerfvol {

// The upper half of a float: eight bits of precision, nearest number, ties to even.
struct Bfloat16 {
    uint16_t bits;

    Bfloat16() = default;
    Bfloat16(float x) {
        uint32_t all;
        std::memcpy(&all, &x, sizeof all);
        bits = uint16_t((all + 0x7fff + (all >> 16 & 1)) >> 16);
    }
    operator float() const {
        const uint32_t all = uint32_t(bits) << 16;
        float x;
        std::memcpy(&x, &all, sizeof x);
        return x;
    }
};

#ifdef NERFVOL_SHORT_ROWS
using RowNumber = Bfloat16;
#else
using RowNumber = float;
#endif

}  // namespace nerfvol
