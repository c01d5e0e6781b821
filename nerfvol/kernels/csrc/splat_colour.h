// The colours of sixteen Gaussians seen from the camera, and the adjoint: spherical harmonics of the direction to the mean.
// Convention and constants as in nerfvol/sh.py; the colour is 1/2 + sum k Y, clamped at 0 from below.
#pragma once
#include "simd_math.h"
#include "splats.h"

namespace NERFVOL_ISA {

constexpr float kY0 = 0.28209479177387814f, kY1 = 0.4886025119029199f;
constexpr float kY2[3] = {1.0925484305920792f, 0.31539156525252005f, 0.5462742152960396f};
constexpr float kY3[5] = {0.5900435899266435f, 2.890611442640554f, 0.4570457994644658f, 0.3731763325901154f, 1.445305721320277f};

// The K basis functions of unit directions.
template <int K> inline void splat_basis(const f16& x, const f16& y, const f16& z, f16 (&out)[K]) {
    out[0] = splat16(kY0);
    if constexpr (K > 1) {
        out[1] = y * -kY1;
        out[2] = z * kY1;
        out[3] = x * -kY1;
    }
    if constexpr (K > 4) {
        const f16 xx = x * x, yy = y * y, zz = z * z;
        out[4] = x * y * kY2[0];
        out[5] = y * z * -kY2[0];
        out[6] = (2.0f * zz - xx - yy) * kY2[1];
        out[7] = x * z * -kY2[0];
        out[8] = (xx - yy) * kY2[2];
        if constexpr (K > 9) {
            out[9] = y * (3.0f * xx - yy) * -kY3[0];
            out[10] = x * y * z * kY3[1];
            out[11] = y * (4.0f * zz - xx - yy) * -kY3[2];
            out[12] = z * (2.0f * zz - 3.0f * xx - 3.0f * yy) * kY3[3];
            out[13] = x * (4.0f * zz - xx - yy) * -kY3[2];
            out[14] = z * (xx - yy) * kY3[4];
            out[15] = x * (xx - 3.0f * yy) * -kY3[0];
        }
    }
}

// The gradient in the direction of sum_k w_k Y_k, as polynomials off the sphere: to be projected on its tangent plane.
template <int K>
inline void splat_basis_slope(const f16& x, const f16& y, const f16& z, const f16 (&w)[K], f16& gx, f16& gy, f16& gz) {
    gx = gy = gz = splat16(0);
    if constexpr (K > 1) {
        gx = w[3] * -kY1;
        gy = w[1] * -kY1;
        gz = w[2] * kY1;
    }
    if constexpr (K > 4) {
        const f16 a4 = w[4] * kY2[0], a5 = w[5] * kY2[0], a6 = w[6] * (2 * kY2[1]), a7 = w[7] * kY2[0], a8 = w[8] * (2 * kY2[2]);
        gx += a4 * y - a6 * x - a7 * z + a8 * x;
        gy += a4 * x - a5 * z - a6 * y - a8 * y;
        gz += a6 * z * 2.0f - a5 * y - a7 * x;
    }
    if constexpr (K > 9) {
        const f16 xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
        const f16 a9 = w[9] * kY3[0], a10 = w[10] * kY3[1], a11 = w[11] * kY3[2], a12 = w[12] * kY3[3];
        const f16 a13 = w[13] * kY3[2], a14 = w[14] * kY3[4], a15 = w[15] * kY3[0];
        const f16 d = 3.0f * (yy - xx);
        gx += a9 * xy * -6.0f + a10 * yz + a11 * xy * 2.0f - a12 * xz * 6.0f - a13 * (4.0f * zz - 3.0f * xx - yy) + a14 * xz * 2.0f + a15 * d;
        gy += a9 * d + a10 * xz - a11 * (4.0f * zz - xx - 3.0f * yy) - a12 * yz * 6.0f + a13 * xy * 2.0f - a14 * yz * 2.0f + a15 * xy * 6.0f;
        gz += a10 * xy - a11 * yz * 8.0f + a12 * (6.0f * zz - 3.0f * xx - 3.0f * yy) - a13 * xz * 8.0f + a14 * (xx - yy);
    }
}

// Unit directions from the camera to sixteen means, and one over the distances.
struct Directions {
    f16 x, y, z, inverse;
    Directions(const float* block, const nerfvol::SplatView& view) {
        x = load<f16>(block) - view.eye[0];
        y = load<f16>(block + 16) - view.eye[1];
        z = load<f16>(block + 32) - view.eye[2];
        inverse = 1.0f / vsqrt(vmax(x * x + y * y + z * z, splat16(1e-30f)));
        x *= inverse;
        y *= inverse;
        z *= inverse;
    }
};

// Colours before the clamp.
template <int K> inline void splat_colours(const float* block, const Directions& d, f16 (&colour)[3]) {
    f16 basis[K];
    splat_basis<K>(d.x, d.y, d.z, basis);
    for (int c = 0; c < 3; ++c) {
        f16 sum = splat16(0.5f);
        for (int k = 0; k < K; ++k) sum += load<f16>(block + 16 * (nerfvol::kSh + K * c + k)) * basis[k];
        colour[c] = sum;
    }
}

}  // namespace NERFVOL_ISA
