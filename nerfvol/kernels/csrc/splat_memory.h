// Memory that splat passes keep between calls, and the floating-point mode they run in.
#pragma once
#include <algorithm>
#include <cstddef>
#include <functional>
#include <memory>
#include <new>
#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "pool.h"
#include "simd.h"

namespace NERFVOL_ISA {

// An uninitialised array that only grows; what it held is lost then, unless kept. Large ones ask for large pages: the passes jump
// about in them, and half of a jump's time is finding the page.
template <class T> class Buffer {
public:
    T* need(size_t n) {
        if (n > size_) grow(n, 0);
        return data_.get();
    }
    T* need_keeping(size_t n, size_t kept) {
        if (n > size_) grow(std::max(n, 2 * size_), kept);
        return data_.get();
    }
    T* data() { return data_.get(); }
    T& operator[](size_t i) { return data_.get()[i]; }
    const T& operator[](size_t i) const { return data_.get()[i]; }

private:
    static constexpr size_t kLargePage = size_t(2) << 20;
    struct Free {
        size_t alignment = 64;
        void operator()(T* p) const { ::operator delete[](static_cast<void*>(p), std::align_val_t{alignment}); }
    };
    void grow(size_t n, size_t kept) {
        n += n / 8 + 64;
        const size_t bytes = n * sizeof(T), alignment = bytes >= 2 * kLargePage ? kLargePage : 64;
        void* memory = ::operator new[](bytes, std::align_val_t{alignment});
#if defined(__linux__) && defined(MADV_HUGEPAGE)
        if (alignment == kLargePage) madvise(memory, bytes, MADV_HUGEPAGE);
#endif
        std::unique_ptr<T[], Free> next(static_cast<T*>(memory), Free{alignment});
        std::copy_n(data_.get(), kept, next.get());
        data_ = std::move(next);
        size_ = n;
    }
    std::unique_ptr<T[], Free> data_;
    size_t size_ = 0;
};

// Numbers below 1e-38 count as zero for as long as this lives: they cost a hundred cycles each and weigh nothing.
class FlushDenormals {
public:
#if defined(__SSE2__)
    FlushDenormals() : before_(_mm_getcsr()) { _mm_setcsr(before_ | 0x8040); }
    ~FlushDenormals() { _mm_setcsr(before_); }

private:
    unsigned before_;
#endif
};

// parallel_for in that mode, whoever runs the task.
template <class Task> void splat_for(int64_t n, Task&& task) {
    nerfvol::parallel_for(int(n), [&](int i, int thread) {
        [[maybe_unused]] const FlushDenormals mode;
        task(i, thread);
    });
}

// Where part i of n things in `parts` begins.
inline int64_t part(int64_t n, int64_t parts, int64_t i) { return n * i / parts; }

}  // namespace NERFVOL_ISA
