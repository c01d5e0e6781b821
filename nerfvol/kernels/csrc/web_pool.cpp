// The pool of a WebAssembly instance: the calling thread. A page has several instances, each in a worker of its own.
#include "pool.h"

namespace nerfvol {
void set_threads(int) {}
int get_threads() { return 1; }
void parallel_for(int n, const std::function<void(int, int)>& task) {
    for (int i = 0; i < n; ++i) task(i, 0);
}
}  // namespace nerfvol
