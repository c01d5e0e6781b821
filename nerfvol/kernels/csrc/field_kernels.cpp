// The operators on neural fields, compiled once per instruction set (NERFVOL_ISA names the namespace).
#include "field_draw.h"

namespace NERFVOL_ISA {
extern const nerfvol::FieldKernels field_table;
const nerfvol::FieldKernels field_table = {step_field, render_field, evaluate_field, march_field};
}  // namespace NERFVOL_ISA
