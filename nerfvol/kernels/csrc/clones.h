// One body for several instruction sets within a file: it is inlined into one function a set, and the set is the kernels'
// own (dispatch.cpp). Everything such a body calls must be NERFVOL_INLINE.
#pragma once
#include <cstring>

#include "tree.h"

#if defined(__x86_64__) && defined(__GNUC__)
#define NERFVOL_CLONES 1
#define NERFVOL_AVX2 __attribute__((target("avx2,fma")))
#if defined(__clang__)
#define NERFVOL_AVX512 __attribute__((target("avx2,fma,avx512f,avx512vl,avx512dq,avx512bw")))
#else
#define NERFVOL_AVX512 __attribute__((target("avx2,fma,avx512f,avx512vl,avx512dq,avx512bw,prefer-vector-width=512")))
#endif
#endif
// The rows that a loop reads and writes do not overlap. (Clang finds out by itself at run time.)
#if defined(__GNUC__) && !defined(__clang__)
#define NERFVOL_APART _Pragma("GCC ivdep")
#else
#define NERFVOL_APART
#endif
#define NERFVOL_INLINE inline __attribute__((always_inline))

namespace nerfvol {
template <class Function> Function choose_clone(Function baseline, Function avx2, Function avx512) {
    if (!std::strcmp(isa_name(), "avx512")) return avx512;
    return !std::strcmp(isa_name(), "avx2") ? avx2 : baseline;
}
}  // namespace nerfvol
