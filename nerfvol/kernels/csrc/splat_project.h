// Sixteen Gaussians seen by a pinhole camera: footprint, opacity and bound, with what the adjoint needs [EWA, Mip-Splatting].
//
// A = J W R diag(s) is 2x3, the footprint's covariance A A^T + eps I: positive by construction, and the determinant of A A^T is
// the squared length of a1 x a2, without cancellation.
#pragma once
#include "splat_colour.h"

namespace NERFVOL_ISA {

using nerfvol::Splats;
using nerfvol::SplatView;

constexpr float kLowPass = 0.3f;          // variance in px^2 that every footprint gets
constexpr float kLeastRho = 0.005f;
constexpr float kAlphaMin = 1.0f / 255, kAlphaMax = 0.99f;
constexpr float kLog2e = 1.44269504088896341f;
constexpr float kLog2Of255 = 7.99435343685885f;

// The range of slopes t_x / t_z in which the Jacobian follows the mean: the picture and 0.3 half-fields beside it.
struct SlopeRange {
    float low, high;
    SlopeRange(float f, float c, float size) : low(-c / f - 0.15f * size / f), high((size - c) / f + 0.15f * size / f) {}
};

struct Projection {
    f16 t[3], inv_z, u, v, free_u, free_v;   // mean in camera axes, clamped slopes, 1 where a slope is not clamped
    f16 q[4], inv_norm, s[3];                // unit quaternion, one over the length of the given one, scales
    f16 wr[9], b[9];                         // W R, W R diag(s), row by row
    f16 a1[3], a2[3], normal[3];             // rows of A, a1 x a2
    f16 flat_det, det;                       // determinants of A A^T and of the covariance
    f16 xx, xy, yy, a, b_, c;                // covariance, conic
    f16 opacity, rho, free_rho, x, y;

    Projection(const float* block, const SplatView& view, bool mip);

private:
    void place(const float* block, const SplatView& view);
    void orient(const float* block, const SplatView& view);
    void flatten(const SplatView& view);
};

inline Projection::Projection(const float* block, const SplatView& view, bool mip) {
    place(block, view);
    orient(block, view);
    flatten(view);
    opacity = 1.0f / (1.0f + vexp(-load<f16>(block + 16 * nerfvol::kLogit)));
    const f16 one = splat16(1);
    rho = free_rho = one;
    if (mip) {
        rho = vsqrt(flat_det / det);
        free_rho = select_less(rho, kLeastRho, splat16(0), one);
        rho = vmax(rho, splat16(kLeastRho));
    }
}

inline void Projection::place(const float* block, const SplatView& view) {
    const f16 m[3] = {load<f16>(block), load<f16>(block + 16), load<f16>(block + 32)};
    for (int i = 0; i < 3; ++i) {
        const float* w = view.rotation + 3 * i;
        t[i] = m[0] * w[0] + m[1] * w[1] + m[2] * w[2] + view.translation[i];
    }
    inv_z = 1.0f / t[2];
    const f16 su = t[0] * inv_z, sv = t[1] * inv_z, one = splat16(1), zero = splat16(0);
    x = su * view.fx + view.cx;
    y = sv * view.fy + view.cy;
    const SlopeRange ru(view.fx, view.cx, float(view.width)), rv(view.fy, view.cy, float(view.height));
    u = vmin(vmax(su, splat16(ru.low)), splat16(ru.high));
    v = vmin(vmax(sv, splat16(rv.low)), splat16(rv.high));
    free_u = select_less(su, ru.low, zero, select_less(splat16(ru.high), su, zero, one));
    free_v = select_less(sv, rv.low, zero, select_less(splat16(rv.high), sv, zero, one));
}

inline void rotation_matrix(const f16 (&q)[4], f16 (&r)[9]) {
    const f16 &w = q[0], &x = q[1], &y = q[2], &z = q[3];
    r[0] = 1.0f - 2.0f * (y * y + z * z);
    r[1] = 2.0f * (x * y - w * z);
    r[2] = 2.0f * (x * z + w * y);
    r[3] = 2.0f * (x * y + w * z);
    r[4] = 1.0f - 2.0f * (x * x + z * z);
    r[5] = 2.0f * (y * z - w * x);
    r[6] = 2.0f * (x * z - w * y);
    r[7] = 2.0f * (y * z + w * x);
    r[8] = 1.0f - 2.0f * (x * x + y * y);
}

inline void unit_quaternion(const float* block, f16 (&q)[4], f16& inv_norm) {
    for (int i = 0; i < 4; ++i) q[i] = load<f16>(block + 16 * (nerfvol::kQuat + i));
    inv_norm = 1.0f / vsqrt(vmax(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3], splat16(1e-30f)));
    for (int i = 0; i < 4; ++i) q[i] *= inv_norm;
}

inline void Projection::orient(const float* block, const SplatView& view) {
    f16 r[9];
    unit_quaternion(block, q, inv_norm);
    rotation_matrix(q, r);
    for (int j = 0; j < 3; ++j) s[j] = vexp(load<f16>(block + 16 * (nerfvol::kLogScale + j)));
    for (int i = 0; i < 3; ++i) {
        const float* w = view.rotation + 3 * i;
        for (int j = 0; j < 3; ++j) {
            wr[3 * i + j] = r[j] * w[0] + r[3 + j] * w[1] + r[6 + j] * w[2];
            b[3 * i + j] = wr[3 * i + j] * s[j];
        }
    }
}

inline void Projection::flatten(const SplatView& view) {
    const f16 jx = inv_z * view.fx, jy = inv_z * view.fy;
    for (int j = 0; j < 3; ++j) {
        a1[j] = jx * (b[j] - u * b[6 + j]);
        a2[j] = jy * (b[3 + j] - v * b[6 + j]);
    }
    normal[0] = a1[1] * a2[2] - a1[2] * a2[1];
    normal[1] = a1[2] * a2[0] - a1[0] * a2[2];
    normal[2] = a1[0] * a2[1] - a1[1] * a2[0];
    flat_det = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2];
    const f16 sxx = a1[0] * a1[0] + a1[1] * a1[1] + a1[2] * a1[2], syy = a2[0] * a2[0] + a2[1] * a2[1] + a2[2] * a2[2];
    xy = a1[0] * a2[0] + a1[1] * a2[1] + a1[2] * a2[2];
    xx = sxx + kLowPass;
    yy = syy + kLowPass;
    det = flat_det + kLowPass * (sxx + syy) + kLowPass * kLowPass;
    const f16 inverse = 1.0f / det;
    a = yy * inverse;
    b_ = -(xy * inverse);
    c = xx * inverse;
}

// Shortest axes in the world, turned to the viewer: (16, 4), the last number unused.
inline void splat_normals(const float* block, const Directions& d, float* out) {
    f16 q[4], r[9], inv_norm;
    unit_quaternion(block, q, inv_norm);
    rotation_matrix(q, r);
    const float* ls = block + 16 * nerfvol::kLogScale;
    const f16 s0 = load<f16>(ls), s1 = load<f16>(ls + 16), s2 = load<f16>(ls + 32);
    f16 n[3];
    for (int i = 0; i < 3; ++i) {
        const f16 first = select_less(s1, s0, r[3 * i + 1], r[3 * i]);
        n[i] = select_less(s2, vmin(s0, s1), r[3 * i + 2], first);
    }
    const f16 towards = n[0] * d.x + n[1] * d.y + n[2] * d.z;
    alignas(64) float rows[3][16];
    for (int i = 0; i < 3; ++i) store(rows[i], select_less(towards, 0.0f, n[i], -n[i]));
    for (int lane = 0; lane < 16; ++lane)
        for (int i = 0; i < 3; ++i) out[4 * lane + i] = rows[i][lane];
}

// What drawing one Gaussian takes: a cache line. alpha = 2^(log2_opacity - dx (a dx + b dy) - c dy dy), d from the mean to the
// pixel's centre; opacity here with rho.
struct alignas(64) Record {
    float x, y, a, b, c, log2_opacity;
    float colour[3], z;
    float half_width, half_height;           // of the box around alpha >= 1/255, pixels
    uint32_t id, first, count, unused;       // Gaussian; its tiles' slots
};

// Lanes of Gaussians that may be seen; out and normals (may be null, (16, 4)) are written for these.
template <int K>
inline uint32_t project_block(const float* block, const SplatView& view, bool mip, uint32_t id, Record* out, float* normals) {
    const Projection p(block, view, mip);
    const f16 log2_opacity = vlog2(p.opacity * p.rho), bound = log2_opacity + kLog2Of255;
    const f16 reach = bound * (2.0f / kLog2e), half_width = vsqrt(reach * p.xx), half_height = vsqrt(reach * p.yy);
    uint32_t seen = greater_bits(p.t[2], splat16(view.near)) & greater_bits(bound, splat16(0)) & greater_bits(splat16(1e30f), p.det);
    seen &= greater_bits(p.x + half_width, splat16(0.5f)) & greater_bits(splat16(float(view.width) - 0.5f), p.x - half_width);
    seen &= greater_bits(p.y + half_height, splat16(0.5f)) & greater_bits(splat16(float(view.height) - 0.5f), p.y - half_height);
    if (!seen) return 0;
    const Directions d(block, view);
    f16 colour[3];
    splat_colours<K>(block, d, colour);
    const f16 zero = splat16(0);
    const f16 fields[12] = {p.x, p.y, p.a * (0.5f * kLog2e), p.b_ * kLog2e, p.c * (0.5f * kLog2e), log2_opacity,
                            vmax(colour[0], zero), vmax(colour[1], zero), vmax(colour[2], zero), p.t[2], half_width, half_height};
    alignas(64) float rows[12][16];
    for (int k = 0; k < 12; ++k) store(rows[k], fields[k]);
    for (uint32_t left = seen; left; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        float* fields_of = &out[lane].x;
        for (int k = 0; k < 12; ++k) fields_of[k] = rows[k][lane];
        out[lane].id = id + uint32_t(lane);
    }
    if (normals) splat_normals(block, d, normals);
    return seen;
}

}  // namespace NERFVOL_ISA
