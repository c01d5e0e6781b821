// The path tracer, compiled once per instruction set (NERFVOL_ISA names the namespace).
#include "path_trace.h"

namespace NERFVOL_ISA {
extern const nerfvol::PathKernels path_table;
const nerfvol::PathKernels path_table = {paths::trace_paths};
}  // namespace NERFVOL_ISA
