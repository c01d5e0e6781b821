#include "arena.h"

#include <algorithm>
#include <deque>
#include <new>

namespace nerfvol {
namespace {

constexpr std::size_t kBlock = std::size_t(4) << 20;

std::mutex one_call, growing;
std::deque<Arena> arenas;                  // of the threads: those that are there stay in place when others come

}  // namespace

Arena::Block::Block(std::size_t n) : bytes(new (std::align_val_t{64}) char[n]), size(n) {}

void Arena::Block::Free::operator()(char* p) const { ::operator delete[](p, std::align_val_t{64}); }

void* Arena::take(std::size_t n) {
    const std::size_t bytes = (n + 63) & ~std::size_t(63);
    while (block_ < blocks_.size() && used_ + bytes > blocks_[block_].size) { ++block_; used_ = 0; }
    if (block_ == blocks_.size()) blocks_.emplace_back(std::max(bytes, kBlock));
    used_ += bytes;
    return blocks_[block_].bytes.get() + used_ - bytes;
}

std::size_t Arena::size() const {
    std::size_t sum = 0;
    for (const Block& b : blocks_) sum += b.size;
    return sum;
}

Arenas::Arenas() : call_(one_call) {
    for (Arena& arena : arenas) arena.clear();
}

Arena& Arenas::of_thread(int thread) {
    const std::lock_guard<std::mutex> lock(growing);
    while (arenas.size() <= std::size_t(thread)) arenas.emplace_back();
    return arenas[std::size_t(thread)];
}

std::size_t arena_bytes() {
    const std::lock_guard<std::mutex> lock(one_call);
    std::size_t sum = 0;
    for (const Arena& arena : arenas) sum += arena.size();
    return sum;
}

void release_arenas() {
    const std::lock_guard<std::mutex> lock(one_call);
    arenas.clear();
}

}  // namespace nerfvol
