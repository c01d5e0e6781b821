// The operators on Gaussian splats, compiled once per instruction set (NERFVOL_ISA names the namespace).
#include "point_render.h"
#include "splat_train.h"

namespace NERFVOL_ISA {
extern const nerfvol::SplatKernels splat_table;
const nerfvol::SplatKernels splat_table = {render_splats, render_points, step_splats};
}  // namespace NERFVOL_ISA
