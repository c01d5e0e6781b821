// From a Gaussian's ten sums to the gradient of its parameters, sixteen Gaussians at a time: the adjoint of splat_project.h.
#pragma once
#include "splat_project.h"

namespace NERFVOL_ISA {

inline f16 dot3(const f16* a, const f16* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline void cross3(const f16* a, const f16* b, f16* out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

// Sums over pixels of one Gaussian (see splat_tile.h), one vector each.
struct GaussianSums { f16 h, hx, hy, hxx, hxy, hyy, colour[3], error; };

// Gradient in the rows of A: through the conic, and through rho where it is not clamped.
inline void chain_footprint(const Projection& p, const GaussianSums& s, bool mip, f16 (&d1)[3], f16 (&d2)[3]) {
    const f16 &a = p.a, &b = p.b_, &c = p.c;
    const f16 da = s.hxx * -0.5f, half = s.hxy * -0.5f, dc = s.hyy * -0.5f;  // of a, of b halved, of c
    const f16 x00 = da * a + half * b, x01 = da * b + half * c, x10 = half * a + dc * b, x11 = half * b + dc * c;
    f16 g00 = -(a * x00 + b * x10), g01 = -(a * x01 + b * x11), g11 = -(b * x01 + c * x11);
    const f16 mu = s.h * p.free_rho;
    if (mip) {
        g00 -= 0.5f * mu * a;
        g01 -= 0.5f * mu * b;
        g11 -= 0.5f * mu * c;
    }
    for (int j = 0; j < 3; ++j) {
        d1[j] = 2.0f * (g00 * p.a1[j] + g01 * p.a2[j]);
        d2[j] = 2.0f * (g01 * p.a1[j] + g11 * p.a2[j]);
    }
    if (!mip) return;
    const f16 share = mu / vmax(p.flat_det, splat16(1e-30f));
    f16 n1[3], n2[3];
    cross3(p.a2, p.normal, n1);
    cross3(p.normal, p.a1, n2);
    for (int j = 0; j < 3; ++j) {
        d1[j] += share * n1[j];
        d2[j] += share * n2[j];
    }
}

// Gradient in the given quaternion from that in the rotation matrix: on the tangent of the unit sphere.
inline void chain_rotation(const Projection& p, const f16 (&r)[9], f16* out) {
    const f16 &w = p.q[0], &x = p.q[1], &y = p.q[2], &z = p.q[3];
    f16 d[4];
    d[0] = 2.0f * (x * (r[7] - r[5]) + y * (r[2] - r[6]) + z * (r[3] - r[1]));
    d[1] = 2.0f * (y * (r[1] + r[3]) + z * (r[2] + r[6]) + w * (r[7] - r[5]) - 2.0f * x * (r[4] + r[8]));
    d[2] = 2.0f * (x * (r[1] + r[3]) + z * (r[5] + r[7]) + w * (r[2] - r[6]) - 2.0f * y * (r[0] + r[8]));
    d[3] = 2.0f * (x * (r[2] + r[6]) + y * (r[5] + r[7]) + w * (r[3] - r[1]) - 2.0f * z * (r[0] + r[4]));
    const f16 radial = p.q[0] * d[0] + p.q[1] * d[1] + p.q[2] * d[2] + p.q[3] * d[3];
    for (int i = 0; i < 4; ++i) out[i] = (d[i] - p.q[i] * radial) * p.inv_norm;
}

// Gradient in a motion of the camera (see SplatReport) through means and axes: those of t, and of W R by columns.
inline void chain_motion(const Projection& p, const f16 (&dt)[3], const f16 (&dwr)[9], f16* motion) {
    cross3(p.t, dt, motion);
    for (int j = 0; j < 3; ++j) {
        const f16 axis[3] = {p.wr[j], p.wr[3 + j], p.wr[6 + j]}, d[3] = {dwr[j], dwr[3 + j], dwr[6 + j]};
        f16 turn[3];
        cross3(axis, d, turn);
        for (int i = 0; i < 3; ++i) motion[i] += turn[i];
        motion[3 + j] = dt[j];
    }
}

// Gradients in means (world), log-scales and quaternions, written to their rows; motion (6 vectors): null = not wanted.
inline void chain_geometry(const Projection& p, const GaussianSums& s, const SplatView& view, bool mip, f16* out, f16* motion) {
    f16 d1[3], d2[3], db[9], dwr[9], dr[9];
    chain_footprint(p, s, mip, d1, d2);
    const f16 jx = p.inv_z * view.fx, jy = p.inv_z * view.fy;
    for (int j = 0; j < 3; ++j) {
        db[j] = jx * d1[j];
        db[3 + j] = jy * d2[j];
        db[6 + j] = -(p.u * db[j] + p.v * db[3 + j]);
    }
    const f16 du = -(jx * dot3(d1, p.b + 6)) * p.free_u, dv = -(jy * dot3(d2, p.b + 6)) * p.free_v;
    const f16 dx = p.a * s.hx + p.b_ * s.hy, dy = p.b_ * s.hx + p.c * s.hy;
    const f16 along_x = dx * view.fx + du, along_y = dy * view.fy + dv;
    const f16 dt[3] = {along_x * p.inv_z, along_y * p.inv_z,
                       -p.inv_z * (dot3(d1, p.a1) + dot3(d2, p.a2) + (along_x * p.t[0] + along_y * p.t[1]) * p.inv_z)};
    for (int j = 0; j < 3; ++j) {
        out[nerfvol::kMean + j] = dt[0] * view.rotation[j] + dt[1] * view.rotation[3 + j] + dt[2] * view.rotation[6 + j];
        out[nerfvol::kLogScale + j] = db[j] * p.b[j] + db[3 + j] * p.b[3 + j] + db[6 + j] * p.b[6 + j];
        for (int i = 0; i < 3; ++i) dwr[3 * i + j] = db[3 * i + j] * p.s[j];
    }
    if (motion) chain_motion(p, dt, dwr, motion);
    for (int k = 0; k < 3; ++k)
        for (int j = 0; j < 3; ++j)
            dr[3 * k + j] = dwr[j] * view.rotation[k] + dwr[3 + j] * view.rotation[3 + k] + dwr[6 + j] * view.rotation[6 + k];
    chain_rotation(p, dr, out + nerfvol::kQuat);
}

// Gradient in the coefficients; that in the direction is added to the means', and to the motion's: it moves the eye.
template <int K> void chain_colour(const float* block, const SplatView& view, const GaussianSums& s, f16* out, f16* motion) {
    const Directions d(block, view);
    f16 basis[K], colour[3], g[3], w[K];
    splat_basis<K>(d.x, d.y, d.z, basis);
    splat_colours<K>(block, d, colour);
    const f16 zero = splat16(0);
    for (int c = 0; c < 3; ++c) g[c] = select_less(zero, colour[c], s.colour[c], zero);
    for (int k = 0; k < K; ++k) {
        w[k] = zero;
        for (int c = 0; c < 3; ++c) {
            out[nerfvol::kSh + K * c + k] = g[c] * basis[k];
            w[k] += g[c] * load<f16>(block + 16 * (nerfvol::kSh + K * c + k));
        }
    }
    if (K == 1) return;
    f16 x, y, z;
    splat_basis_slope<K>(d.x, d.y, d.z, w, x, y, z);
    const f16 radial = x * d.x + y * d.y + z * d.z;
    const f16 moved[3] = {(x - d.x * radial) * d.inverse, (y - d.y * radial) * d.inverse, (z - d.z * radial) * d.inverse};
    for (int i = 0; i < 3; ++i) {
        out[nerfvol::kMean + i] += moved[i];
        const float* w = view.rotation + 3 * i;
        if (motion) motion[3 + i] += moved[0] * w[0] + moved[1] * w[1] + moved[2] * w[2];
    }
}

// The gradient of all parameters of a block, (11 + 3 K) vectors.
template <int K>
void chain_block(const float* block, const SplatView& view, bool mip, const GaussianSums& s, f16* out, f16* motion) {
    const Projection p(block, view, mip);
    chain_geometry(p, s, view, mip, out, motion);
    out[nerfvol::kLogit] = (1.0f - p.opacity) * s.h;
    chain_colour<K>(block, view, s, out, motion);
}

}  // namespace NERFVOL_ISA
