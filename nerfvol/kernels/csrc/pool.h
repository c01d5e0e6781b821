// A pool of threads that lives as long as the module. Results never depend on who runs which task.
#pragma once
#include <functional>

namespace nerfvol {
void set_threads(int n);
int get_threads();
// Calls task(index, thread) for every index in [0, n), thread in [0, get_threads()).
void parallel_for(int n, const std::function<void(int, int)>& task);
}  // namespace nerfvol
