// The operators, compiled once per instruction set (NERFVOL_ISA names the namespace).
#include "render.h"
#include "train.h"

namespace NERFVOL_ISA {
extern const nerfvol::Kernels table;
const nerfvol::Kernels table = {render, render_view, backward, train_step, leaf_statistics};
}  // namespace NERFVOL_ISA
