// How fast the processor runs now: a name does not say it, and two machines of one name differ twofold where they are shared.
#include <chrono>
#include <cstdint>

#include "tree.h"

namespace nerfvol {
// Cycles per second, in units of 1e9, from a chain of xorshift64 [Marsaglia 2003]: each of its six operations waits for the
// one before and takes one cycle on today's processors. The quickest of five tries of about a millisecond.
double clock_ghz() {
    constexpr int steps = 500000;
    static volatile std::uint64_t seed = 88172645463325252ull;  // volatile: the chain cannot be worked out beforehand
    double best = 0;
    for (int attempt = 0; attempt < 5; ++attempt) {
        std::uint64_t x = seed;
        const auto began = std::chrono::steady_clock::now();
        for (int i = 0; i < steps; ++i) {
            x ^= x << 13;
            x ^= x >> 7;
            x ^= x << 17;
        }
        seed = x;
        const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - began).count();
        if (seconds > 0 && 6e-9 * steps / seconds > best) best = 6e-9 * steps / seconds;
    }
    return best;
}
}  // namespace nerfvol
