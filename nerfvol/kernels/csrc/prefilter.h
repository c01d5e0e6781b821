// Prefiltered values of an octree's interior nodes: what nerfvol/octree/lod.py says, in one pass and with little memory.
#pragma once
#include <cstddef>
#include <cstdint>
#include <new>
#include <vector>

#include "tree.h"

namespace nerfvol {

// Of cache lines, as rows of values are read.
template <class T> struct Lines {
    using value_type = T;
    static constexpr std::align_val_t kLine{64};
    Lines() = default;
    template <class U> Lines(const Lines<U>&) {}
    T* allocate(std::size_t n) { return static_cast<T*>(::operator new(n * sizeof(T), kLine)); }
    void deallocate(T* at, std::size_t) { ::operator delete(at, kLine); }
    template <class U> bool operator==(const Lines<U>&) const { return true; }
    template <class U> bool operator!=(const Lines<U>&) const { return false; }
};

struct Prefiltered {
    std::vector<int32_t> corners;                    // (n_nodes, 8) rows of values
    std::vector<RowNumber, Lines<RowNumber>> values; // (rows, 16 * blocks)
};

// Of an octree whose masks, first children, corners and values are there; the same for any number of threads.
Prefiltered prefilter(const Tree& tree);

}  // namespace nerfvol
