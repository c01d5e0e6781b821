// What follows from a set of leaves: the numbering of their corners, and where the values of new vertices come from.
// nerfvol/octree/topology.py has the same in numpy, used where nothing is compiled.
#include "topology.h"

#include <algorithm>
#include <cstddef>
#include <vector>

#include "pool.h"

namespace nerfvol {
namespace {

constexpr int kLatticeStride[3] = {9, 3, 1};

bool is_lattice_corner(int place) { return (place / 9) % 2 == 0 && (place / 3) % 3 % 2 == 0 && place % 3 % 2 == 0; }

}  // namespace

int lattice_place(int octant, int corner) {
    int place = 0;
    for (int axis = 0; axis < 3; ++axis) {
        const int c = corner >> (2 - axis) & 1;
        place += kLatticeStride[axis] * (octant < 0 ? 2 * c : (octant >> (2 - axis) & 1) + c);
    }
    return place;
}

void lattice_weights(float weights[27][8]) {
    for (int p = 0; p < 27; ++p)
        for (int o = 0; o < 8; ++o) {
            const int at[3] = {p / 9, p / 3 % 3, p % 3};
            weights[p][o] = 1;
            for (int axis = 0; axis < 3; ++axis)
                weights[p][o] *= 0.5f * float((o >> (2 - axis) & 1) ? at[axis] : 2 - at[axis]);
        }
}

int64_t number_corners(const int8_t* level, const int32_t* ijk, int64_t n, int max_level, int32_t* ids) {
    int64_t capacity = 1024;
    while (capacity < 4 * n) capacity *= 2;  // a thin shell has about 1.3 vertices per leaf
    std::vector<int32_t> table(std::size_t(capacity), -1);
    std::vector<uint64_t> keys;  // of the vertices so far
    keys.reserve(std::size_t(2 * n));
    // Neighbours in space stay neighbours in the table: 4x4x4 corners of leaves of the commonest level, and of finer
    // leaves those that lie alike between them.
    int64_t of_level[64] = {};
    for (int64_t leaf = 0; leaf < n; ++leaf) ++of_level[level[leaf] & 63];
    const int between = 3 * int(max_level - (std::max_element(of_level, of_level + 64) - of_level));
    const uint64_t finer = (uint64_t(1) << between) - 1;
    const auto slot_of = [&](uint64_t key) {
        const uint64_t h = ((key >> between >> 6) * 0x9E3779B97F4A7C15ull) ^ ((key & finer) * 0xC2B2AE3D27D4EB4Full);
        return ((h >> 20) * 64 + (key >> between & 63)) & uint64_t(capacity - 1);
    };
    const auto grow = [&] {
        capacity *= 2;
        table.assign(std::size_t(capacity), -1);
        for (std::size_t v = 0; v < keys.size(); ++v) {
            uint64_t s = slot_of(keys[v]);
            while (table[s] >= 0) s = (s + 1) & uint64_t(capacity - 1);
            table[s] = int32_t(v);
        }
    };
    struct Named { uint64_t key, slot; };
    constexpr int64_t kFew = 128;      // leaves at a time: what they ask of the table comes from memory meanwhile
    Named named[8 * kFew];
    int32_t number[8 * kFew];
    // In calls of some leaves: WebAssembly's engines put faster code in place only from one call to the next.
    const auto number_few = [&](int64_t from, int64_t to) __attribute__((noinline)) {
        int32_t of_siblings[27];  // of the lattice that siblings share: they follow each other, and one look-up does for all
        int32_t n_named = 0;
        while (2 * int64_t(keys.size() + 8 * kFew) > capacity) grow();
        for (int64_t leaf = from; leaf < to; ++leaf) {
            const int shift = max_level - level[leaf];
            const int32_t* const at = ijk + 3 * leaf;
            const bool sibling = leaf > from && level[leaf] == level[leaf - 1] && !((at[0] ^ at[-3]) >> 1 | (at[1] ^ at[-2]) >> 1 | (at[2] ^ at[-1]) >> 1);
            if (!sibling) std::fill_n(of_siblings, 27, -1);
            const int octant = (at[0] & 1) << 2 | (at[1] & 1) << 1 | (at[2] & 1);
            for (int o = 0; o < 8; ++o) {
                int32_t& known = of_siblings[lattice_place(octant, o)];
                if (known < 0) {
                    uint64_t p[3];
                    for (int axis = 0; axis < 3; ++axis) p[axis] = uint64_t(at[axis] + (o >> (2 - axis) & 1)) << shift;
                    const uint64_t key = spread_bits(p[0]) << 2 | spread_bits(p[1]) << 1 | spread_bits(p[2]);
                    const uint64_t slot = slot_of(key);
                    __builtin_prefetch(&table[slot]);
                    named[n_named] = {key, slot};
                    known = n_named++;
                }
                ids[8 * leaf + o] = known;
            }
        }
        for (int32_t i = 0; i < n_named; ++i)
            if (const int32_t there = table[named[i].slot]; there >= 0) __builtin_prefetch(&keys[std::size_t(there)]);
        for (int32_t i = 0; i < n_named; ++i) {
            uint64_t s = named[i].slot;
            while (table[s] >= 0 && keys[std::size_t(table[s])] != named[i].key) s = (s + 1) & uint64_t(capacity - 1);
            if (table[s] < 0) {
                table[s] = int32_t(keys.size());
                keys.push_back(named[i].key);
            }
            number[i] = table[s];
        }
        for (int64_t i = 8 * from; i < 8 * to; ++i) ids[i] = number[ids[i]];
    };
    for (int64_t leaf = 0; leaf < n; leaf += kFew) number_few(leaf, std::min(n, leaf + kFew));
    return int64_t(keys.size());
}

int64_t renumber_corners(const int32_t* corners, const int32_t* kept, int64_t n, int64_t n_vertices, int32_t* ids) {
    std::vector<int32_t> number(std::size_t(n_vertices), -1);
    int32_t next = 0;
    for (int64_t leaf = 0; leaf < n; ++leaf)
        for (int o = 0; o < 8; ++o) {
            int32_t& id = number[std::size_t(corners[8 * int64_t(kept[leaf]) + o])];
            if (id < 0) id = next++;
            ids[8 * leaf + o] = id;
        }
    return next;
}

void find_sources(const int32_t* corners, const int32_t* parent, const int8_t* octant, int64_t n, int64_t n_vertices,
                  int32_t* source, int8_t* place) {
    for (int64_t v = 0; v < n_vertices; ++v) place[v] = -1;
    for (int64_t leaf = 0; leaf < n; ++leaf)
        for (int o = 0; o < 8; ++o) {
            const int32_t v = corners[8 * leaf + o];
            const int p = lattice_place(octant[leaf], o);
            if (place[v] < 0 || (is_lattice_corner(p) && !is_lattice_corner(place[v]))) {
                place[v] = int8_t(p);
                source[v] = parent[leaf];
            }
        }
}

void interpolate(const float* rows, int64_t width, const int32_t* old_corners, const int32_t* source, const int8_t* place,
                 int64_t n_vertices, float* out) {
    float weights[27][8];
    lattice_weights(weights);
    constexpr int64_t kChunk = 16384;
    parallel_for(int((n_vertices + kChunk - 1) / kChunk), [&](int chunk, int) {
        for (int64_t v = chunk * kChunk; v < n_vertices && v < (chunk + 1) * kChunk; ++v) {
            float* row = out + v * width;
            for (int64_t k = 0; k < width; ++k) row[k] = 0;
            for (int o = 0; o < 8; ++o) {
                const float w = weights[place[v]][o];
                if (w == 0) continue;
                const float* from = rows + width * old_corners[8 * int64_t(source[v]) + o];
                for (int64_t k = 0; k < width; ++k) row[k] += w * from[k];
            }
        }
    });
}

template <class Number>
void restrict_cells(const uint8_t* mask, const int32_t* first, int64_t n, const int32_t* corners, const Number* rows, int64_t width,
                    const float* weight, int64_t density, float* sums) {
    float weights[27][8];
    lattice_weights(weights);
    std::vector<float> row(std::size_t(width), 0.0f);
    for (int64_t node = 0; node < n; ++node) {
        const int32_t* child = corners + 8 * int64_t(first[node]);
        for (int octant = 0; octant < 8; ++octant) {
            if (!(mask[node] >> octant & 1)) continue;
            for (int c = 0; c < 8; ++c) {
                const int64_t v = child[c];
                for (int64_t k = 0; k < width; ++k) row[std::size_t(k)] = weight[v] * rows[width * v + k];
                row[std::size_t(density)] = weight[v];
                for (int o = 0; o < 8; ++o) {
                    const float w = 0.125f * weights[lattice_place(octant, c)][o];
                    float* to = sums + width * (8 * node + o);
                    if (w == 0) continue;
                    for (int64_t k = 0; k < width; ++k) to[k] += w * row[std::size_t(k)];
                }
            }
            child += 8;
        }
    }
}

template void restrict_cells(const uint8_t*, const int32_t*, int64_t, const int32_t*, const float*, int64_t, const float*, int64_t, float*);
#ifdef NERFVOL_SHORT_ROWS
template void restrict_cells(const uint8_t*, const int32_t*, int64_t, const int32_t*, const RowNumber*, int64_t, const float*, int64_t, float*);
#endif

}  // namespace nerfvol
