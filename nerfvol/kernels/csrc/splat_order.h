// From parameters to lists: every tile gets the Gaussians that touch it, front to back.
//
// Projection, in parallel; a stable radix sort by depth; the sorted Gaussians list their tiles, range by range of the order; counting
// gives each range its places in each tile's list, so the ranges write in parallel and no list needs sorting. The lists are the
// same for any number of threads or ranges.
#pragma once
#include <utility>
#include <vector>

#include "splat_lists.h"
#include "splat_memory.h"

namespace NERFVOL_ISA {

constexpr int kChunk = 32;                   // blocks of parameters that one task projects
constexpr int kDepthBits = 22, kDigitBits = 11, kDigits = 1 << kDigitBits;

// An entry of a tile's list: rank of the Gaussian by depth, the tile's number among the Gaussian's own, mask of blocks.
struct TileEntry {
    uint64_t bits;
    TileEntry(uint32_t rank, uint32_t offset, uint32_t mask) : bits(uint64_t(rank) << 38 | uint64_t(offset) << 16 | mask) {}
    uint32_t rank() const { return uint32_t(bits >> 38); }
    uint32_t offset() const { return uint32_t(bits >> 16) & 0x3fffff; }
    uint32_t mask() const { return uint32_t(bits) & 0xffff; }
};

struct Place { uint32_t first, count; };     // slots of a Gaussian; count 0: it is in no tile

struct RangeLists {
    Buffer<TileMask> tiles;
    std::vector<uint32_t> counts;            // of each tile; then where the range's part of its list begins
    size_t n = 0;                            // entries
};

// What the passes of one picture share. Kept between pictures for its memory.
struct Frame {
    Buffer<Record> projected, sorted;        // by Gaussian where it is seen; by depth
    Buffer<float> normals;                   // (n, 4) by Gaussian
    Buffer<uint64_t> keys, spare;            // depth << 32 | Gaussian
    std::vector<int64_t> chunk_counts;
    Buffer<Place> places;
    Buffer<TileEntry> entries;
    std::vector<uint64_t> first_entry;       // of each tile, and the end
    std::vector<RangeLists> ranges;
    std::vector<uint32_t> digits;
    int64_t visible = 0;
};

// The passes' memory, for one call at a time.
inline Frame& shared_frame() {
    static Frame frame;
    return frame;
}
inline nerfvol::Mutex& one_splat_call() {
    static nerfvol::Mutex mutex;
    return mutex;
}

// The float's own bits are a logarithm: 2^-18 relative over 16 octaves behind the near plane.
inline uint64_t depth_key(float z, float near) {
    int32_t bits, from;
    std::memcpy(&bits, &z, 4);
    std::memcpy(&from, &near, 4);
    return uint64_t(std::min((bits - from) >> 5, (1 << kDepthBits) - 1));
}

// Projects all blocks: project(block, its number, its records) returns the lanes that may be seen.
template <class Project> void project_chunks(const Splats& splats, const SplatView& view, Frame& f, Project&& project) {
    const int64_t chunks = (splats.n_blocks + kChunk - 1) / kChunk, n = 16 * splats.n_blocks;
    Record* out = f.projected.need(size_t(n));
    uint64_t* keys = f.keys.need(size_t(n));
    Place* places = f.places.need(size_t(n));
    f.chunk_counts.assign(size_t(chunks), 0);
    splat_for(chunks, [&](int chunk, int) {
        const int64_t first = int64_t(chunk) * kChunk, last = std::min(first + kChunk, splats.n_blocks);
        uint64_t* at = keys + 16 * first;
        for (int64_t b = first; b < last; ++b) {
            std::memset(static_cast<void*>(places + 16 * b), 0, 16 * sizeof(Place));
            uint32_t seen = project(splats.params + b * splats.rows() * 16, b, out + 16 * b);
            for (; seen; seen &= seen - 1) {
                const int64_t i = 16 * b + __builtin_ctz(seen);
                *at++ = depth_key(out[i].z, view.near) << 32 | uint64_t(i);
            }
        }
        f.chunk_counts[size_t(chunk)] = at - (keys + 16 * first);
    });
    f.visible = 0;
    for (int64_t c : f.chunk_counts) f.visible += c;
}

template <int K> void project_all(const Splats& splats, const SplatView& view, Frame& f, bool with_normals) {
    float* normals = with_normals ? f.normals.need(size_t(64 * splats.n_blocks)) : nullptr;
    project_chunks(splats, view, f, [&](const float* block, int64_t b, Record* out) {
        return project_block<K>(block, view, splats.mip, uint32_t(16 * b), out, normals ? normals + 64 * b : nullptr);
    });
}

// One stable pass over one digit: each(range, visit) calls visit(key) for a range's keys in order.
template <class Each> void radix_pass(int64_t ranges, int shift, std::vector<uint32_t>& digits, uint64_t* to, Each&& each) {
    digits.assign(size_t(ranges * kDigits), 0);
    const auto digit = [shift](uint64_t key) { return size_t(key >> shift) & (kDigits - 1); };
    splat_for(ranges, [&](int r, int) {
        uint32_t* counts = digits.data() + int64_t(r) * kDigits;
        each(r, [&](uint64_t key) { ++counts[digit(key)]; });
    });
    uint32_t sum = 0;
    for (size_t d = 0; d < kDigits; ++d)
        for (int64_t r = 0; r < ranges; ++r) sum += std::exchange(digits[size_t(r) * kDigits + d], sum);
    splat_for(ranges, [&](int r, int) {
        uint32_t* at = digits.data() + int64_t(r) * kDigits;
        each(r, [&](uint64_t key) { to[at[digit(key)]++] = key; });
    });
}

inline void sort_by_depth(Frame& f) {
    const int64_t ranges = std::clamp<int64_t>(f.visible / 16384, 1, 16), chunks = int64_t(f.chunk_counts.size());
    const auto by_chunk = [&](int r, auto&& visit) {
        for (int64_t c = part(chunks, ranges, r); c < part(chunks, ranges, r + 1); ++c)
            for (int64_t i = 0; i < f.chunk_counts[size_t(c)]; ++i) visit(f.keys[size_t(16 * kChunk * c + i)]);
    };
    f.spare.need(size_t(f.visible));
    radix_pass(ranges, 32, f.digits, f.spare.data(), by_chunk);
    radix_pass(ranges, 32 + kDigitBits, f.digits, f.keys.data(), [&](int r, auto&& visit) {
        for (int64_t i = part(f.visible, ranges, r); i < part(f.visible, ranges, r + 1); ++i) visit(f.spare[size_t(i)]);
    });
}

inline void list_range(Frame& f, const TileGrid& grid, int64_t first, int64_t last, RangeLists& range) {
    constexpr int64_t kAhead = 12;
    range.counts.assign(size_t(grid.size()), 0);
    range.n = 0;
    for (int64_t rank = first; rank < last; ++rank) {
        if (rank + kAhead < last) __builtin_prefetch(&f.projected[uint32_t(f.keys[size_t(rank + kAhead)])]);
        Record g = f.projected[uint32_t(f.keys[size_t(rank)])];
        TileMask* out = range.tiles.need_keeping(range.n + most_tiles(g, grid), range.n) + range.n;
        g.count = uint32_t(list_tiles(g, grid, out, [&](uint32_t tile) { ++range.counts[tile]; }));
        range.n += g.count;
        f.places[g.id].count = g.count;
        f.sorted[size_t(rank)] = g;
    }
}

// Each range's counts become the places of its entries in the tiles' lists.
inline void place_ranges(Frame& f, int64_t tiles) {
    f.first_entry.resize(size_t(tiles) + 1);
    uint64_t sum = 0;
    for (size_t t = 0; t < size_t(tiles); ++t) {
        f.first_entry[t] = sum;
        for (RangeLists& r : f.ranges) sum += std::exchange(r.counts[t], uint32_t(sum));
    }
    f.first_entry[size_t(tiles)] = sum;
}

// Slots lie in the order of the Gaussians, as neighbours in space do: a tile writes to, and a block reads from, few pages.
inline void place_slots(Frame& f, int64_t n) {
    uint32_t first = 0;
    for (int64_t i = 0; i < n; ++i) {
        f.places[size_t(i)].first = first;
        first += f.places[size_t(i)].count;
    }
}

inline void make_lists(Frame& f, const TileGrid& grid, int64_t n) {
    const int64_t ranges = std::clamp<int64_t>(f.visible / 2048, 1, 32);
    f.ranges.resize(size_t(ranges));
    f.sorted.need(size_t(f.visible));
    splat_for(ranges, [&](int r, int) {
        list_range(f, grid, part(f.visible, ranges, r), part(f.visible, ranges, r + 1), f.ranges[size_t(r)]);
    });
    place_ranges(f, grid.size());
    place_slots(f, n);
    TileEntry* entries = f.entries.need(size_t(f.first_entry.back()));
    splat_for(ranges, [&](int r, int) {
        RangeLists& range = f.ranges[size_t(r)];
        const TileMask* at = range.tiles.data();
        for (int64_t rank = part(f.visible, ranges, r); rank < part(f.visible, ranges, r + 1); ++rank) {
            Record& g = f.sorted[size_t(rank)];
            g.first = f.places[g.id].first;
            for (uint32_t k = 0; k < g.count; ++k, ++at) entries[range.counts[at->tile]++] = TileEntry(uint32_t(rank), k, at->mask);
        }
    });
}

// All of it.
template <int K> void prepare_frame(const Splats& splats, const SplatView& view, Frame& f, bool with_normals) {
    project_all<K>(splats, view, f, with_normals);
    sort_by_depth(f);
    make_lists(f, TileGrid(view), 16 * splats.n_blocks);
}

}  // namespace NERFVOL_ISA
