// Numbers the octree's vertices in the order in which the leaves first name them, so that neighbours in space are
// neighbours in memory. keys (n) are positions of corners; ids (n) receives the number of each; first (n) receives, for
// each vertex, the index of the corner that named it first. Returns the number of vertices.
#include <cstdint>
#include <cstddef>
#include <vector>

#include "tree.h"

namespace nerfvol {

int64_t number_vertices(const int64_t* keys, int64_t n, int32_t* ids, int64_t* first) {
    int64_t capacity = 1024;
    while (capacity < n / 2) capacity *= 2;  // a corner is shared by up to 8 leaves: grow when this guess is too small
    std::vector<int32_t> table(std::size_t(capacity), -1);
    int64_t count = 0;
    auto slot_of = [&](int64_t key) {
        uint64_t h = uint64_t(key >> 6) * 0x9E3779B97F4A7C15ull;  // 4x4x4 neighbours share a cache line or two
        return int64_t(((h >> 20) * 64 + uint64_t(key & 63)) & uint64_t(capacity - 1));
    };
    for (int64_t i = 0; i < n; ++i) {
        if (2 * count >= capacity) {
            capacity *= 2;
            table.assign(std::size_t(capacity), -1);
            for (int64_t v = 0; v < count; ++v) {
                int64_t s = slot_of(keys[first[v]]);
                while (table[std::size_t(s)] >= 0) s = (s + 1) & (capacity - 1);
                table[std::size_t(s)] = int32_t(v);
            }
        }
        int64_t s = slot_of(keys[i]);
        while (table[std::size_t(s)] >= 0 && keys[first[table[std::size_t(s)]]] != keys[i]) s = (s + 1) & (capacity - 1);
        if (table[std::size_t(s)] < 0) {
            table[std::size_t(s)] = int32_t(count);
            first[count++] = i;
        }
        ids[i] = table[std::size_t(s)];
    }
    return count;
}

}  // namespace nerfvol
