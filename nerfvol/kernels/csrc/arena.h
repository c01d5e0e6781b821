// Scratch memory of the kernels that outlives a call: one arena for each thread of the pool, whatever the degree of the octree
// and the instruction set. Compiled once (arena.cpp), so that no build of the kernels brings its own copy.
#pragma once
#include <cstddef>
#include <memory>
#include <mutex>
#include <vector>

namespace nerfvol {

// Memory that is taken piece by piece and given back all at once: what one thread's packets leave to the second phase of a
// step. Kept between steps, it is as large as the largest step was; had each packet memory of its own, that would be as
// large as its largest.
class Arena {
public:
    void* take(std::size_t bytes);         // begins on a cache line
    void clear() { block_ = used_ = 0; }
    std::size_t size() const;              // bytes, taken or free

private:
    struct Block {
        explicit Block(std::size_t n);
        struct Free {
            void operator()(char* p) const;
        };
        std::unique_ptr<char[], Free> bytes;
        std::size_t size;
    };
    std::vector<Block> blocks_;
    std::size_t block_ = 0, used_ = 0;     // where the next piece begins
};

// The arenas for the length of a call, all cleared; another call waits until it is over.
class Arenas {
public:
    Arenas();
    Arena& of_thread(int thread);          // a thread of the pool, see parallel_for

private:
    std::lock_guard<std::mutex> call_;
};

std::size_t arena_bytes();                 // of all arenas together
void release_arenas();                     // gives all of it back

}  // namespace nerfvol
