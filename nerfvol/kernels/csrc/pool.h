// A pool of threads that lives as long as the module. Results never depend on who runs which task.
#pragma once
#include <functional>
#include <mutex>

namespace nerfvol {
#if defined(__wasm__)
struct Mutex {                     // one thread: web_pool.cpp
    void lock() {}
    void unlock() {}
};
#else
using Mutex = std::mutex;
#endif
void set_threads(int n);
int get_threads();
// Calls task(index, thread) for every index in [0, n), thread in [0, get_threads()).
void parallel_for(int n, const std::function<void(int, int)>& task);
}  // namespace nerfvol
