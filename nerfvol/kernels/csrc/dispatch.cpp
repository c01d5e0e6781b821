// Chooses among the builds of kernels.cpp, splat_kernels.cpp, field_kernels.cpp and path_kernels.cpp at run time.
#include <cstring>

#include "path_scene.h"
#include "tree.h"

namespace baseline {
extern const nerfvol::Kernels table;
extern const nerfvol::SplatKernels splat_table;
extern const nerfvol::FieldKernels field_table;
extern const nerfvol::PathKernels path_table;
}
#ifdef NERFVOL_HAVE_avx2
namespace avx2 {
extern const nerfvol::Kernels table;
extern const nerfvol::SplatKernels splat_table;
extern const nerfvol::FieldKernels field_table;
extern const nerfvol::PathKernels path_table;
}
#endif
#ifdef NERFVOL_HAVE_avx512
namespace avx512 {
extern const nerfvol::Kernels table;
extern const nerfvol::SplatKernels splat_table;
extern const nerfvol::FieldKernels field_table;
extern const nerfvol::PathKernels path_table;
}
#endif

namespace nerfvol {
namespace {
struct Choice { const char* name; const Kernels* table; const SplatKernels* splats; const FieldKernels* fields; const PathKernels* paths; };

int choices(Choice* out) {
    int n = 0;
#ifdef NERFVOL_HAVE_avx512
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512bw"))
        out[n++] = {"avx512", &avx512::table, &avx512::splat_table, &avx512::field_table, &avx512::path_table};
#endif
#ifdef NERFVOL_HAVE_avx2
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2"))
        out[n++] = {"avx2", &avx2::table, &avx2::splat_table, &avx2::field_table, &avx2::path_table};
#endif
    out[n++] = {"baseline", &baseline::table, &baseline::splat_table, &baseline::field_table, &baseline::path_table};
    return n;
}

Choice chosen = [] { Choice c[3]; choices(c); return c[0]; }();
}  // namespace

const Kernels& kernels() { return *chosen.table; }
const SplatKernels& splat_kernels() { return *chosen.splats; }
const FieldKernels& field_kernels() { return *chosen.fields; }
const PathKernels& path_kernels() { return *chosen.paths; }
const char* isa_name() { return chosen.name; }

bool set_isa(const char* name) {
    Choice c[3];
    const int n = choices(c);
    for (int i = 0; i < n; ++i)
        if (!std::strcmp(name, "auto") || !std::strcmp(name, c[i].name)) { chosen = c[i]; return true; }
    return false;
}

int available_isas(const char** names) {
    Choice c[3];
    const int n = choices(c);
    for (int i = 0; i < n; ++i) names[i] = c[i].name;
    return n;
}
}  // namespace nerfvol
