// Spherical harmonics of one direction (nerfvol/sh.py has the same in torch).
#pragma once

namespace NERFVOL_ISA {

// Real spherical harmonics, the sign convention of PlenOctrees and 3DGS. y has (degree + 1)^2 entries.
inline void sh_basis(int degree, float x, float y, float z, float* b) {
    b[0] = 0.28209479177387814f;
    if (degree < 1) return;
    b[1] = -0.4886025119029199f * y;
    b[2] = 0.4886025119029199f * z;
    b[3] = -0.4886025119029199f * x;
    if (degree < 2) return;
    b[4] = 1.0925484305920792f * x * y;
    b[5] = -1.0925484305920792f * y * z;
    b[6] = 0.31539156525252005f * (2 * z * z - x * x - y * y);
    b[7] = -1.0925484305920792f * x * z;
    b[8] = 0.5462742152960396f * (x * x - y * y);
    if (degree < 3) return;
    b[9] = -0.5900435899266435f * y * (3 * x * x - y * y);
    b[10] = 2.890611442640554f * x * y * z;
    b[11] = -0.4570457994644658f * y * (4 * z * z - x * x - y * y);
    b[12] = 0.3731763325901154f * z * (2 * z * z - 3 * x * x - 3 * y * y);
    b[13] = -0.4570457994644658f * x * (4 * z * z - x * x - y * y);
    b[14] = 1.445305721320277f * z * (x * x - y * y);
    b[15] = -0.5900435899266435f * x * (x * x - 3 * y * y);
}

}  // namespace NERFVOL_ISA
