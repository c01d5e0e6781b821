// Points composited surface by surface: what nerfvol/kernels/point_reference.py says in numpy [Zwicker et al. 2001].
//
// Lists of tiles are those of the splats, but for the bound: every point is drawn to kReach deviations. A block of 4x4 pixels reads
// its list, which goes by the depth of the means, only as far as something may still be in front of what it has found.
#pragma once
#include "blend.h"

namespace NERFVOL_ISA {

constexpr float kReach = 3;                  // deviations of a footprint that are drawn
constexpr float kSlab = 3;                   // deviations in space that are one surface
constexpr float kDisc = 0.05f;               // a splat whose thinnest scale is a smaller share of its widest has a plane
constexpr int kMostSurfaces = 64;
constexpr float kFar = 3e38f;

// What a point has besides its Record, by its number: weight in the middle, slab, plane (1/z at a pixel is plane . (x, y, 1); zero for
// balls) and normal.
struct alignas(64) PointRecord {
    float log2_weight, slab, plane[3], normal[3];
};

// What the passes of one picture of points share besides the Frame.
struct PointFrame {
    Buffer<PointRecord> points;              // by number
    Buffer<float> floors;                    // by entry: nothing of this or a later one of the tile's list is nearer
};

// 1/z of the plane n . t = h at slopes (u, v) is n . (u, v, 1) / h; here as a function of pixels. Zero for balls and for discs edge on.
inline void point_planes(const Projection& p, const SplatView& v, f16 (&plane)[3]) {
    const f16 first = vmin(p.s[0], p.s[1]), thin = vmin(first, p.s[2]), wide = vmax(vmax(p.s[0], p.s[1]), p.s[2]), zero = splat16(0);
    f16 n[3];
    for (int i = 0; i < 3; ++i) {
        const f16 of_two = select_less(p.s[1], p.s[0], p.wr[3 * i + 1], p.wr[3 * i]);
        n[i] = select_less(p.s[2], first, p.wr[3 * i + 2], of_two);
    }
    const f16 h = n[0] * p.t[0] + n[1] * p.t[1] + n[2] * p.t[2];
    const f16 t2 = p.t[0] * p.t[0] + p.t[1] * p.t[1] + p.t[2] * p.t[2];
    f16 inverse = select_less(1e-12f * t2, h * h, 1.0f / h, zero);
    inverse = select_less(thin, kDisc * wide, inverse, zero);
    plane[0] = n[0] * inverse * (1 / v.fx);
    plane[1] = n[1] * inverse * (1 / v.fy);
    plane[2] = n[2] * inverse - plane[0] * v.cx - plane[1] * v.cy;
}

// As project_block, but with a bound of kReach deviations for every weight; the records' opacity is that bound's.
inline uint32_t project_points(const float* block, const SplatView& view, bool mip, uint32_t id, Record* out, PointRecord* points) {
    const Projection p(block, view, mip);
    const f16 half_width = vsqrt(p.xx) * kReach, half_height = vsqrt(p.yy) * kReach, weight = p.opacity * p.rho;
    uint32_t seen = greater_bits(p.t[2], splat16(view.near)) & greater_bits(weight, splat16(kAlphaMin)) & greater_bits(splat16(1e30f), p.det);
    seen &= greater_bits(p.x + half_width, splat16(0.5f)) & greater_bits(splat16(float(view.width) - 0.5f), p.x - half_width);
    seen &= greater_bits(p.y + half_height, splat16(0.5f)) & greater_bits(splat16(float(view.height) - 0.5f), p.y - half_height);
    if (!seen) return 0;
    const Directions d(block, view);
    f16 colour[3], plane[3];
    splat_colours<1>(block, d, colour);
    point_planes(p, view, plane);
    const f16 widest = vmax(vmax(p.s[0], p.s[1]), p.s[2]), pixel = p.t[2] * (1 / std::sqrt(view.fx * view.fy));
    const f16 slab = vsqrt(widest * widest + kLowPass * (pixel * pixel)) * kSlab, zero = splat16(0);
    const f16 bound = splat16(0.5f * kReach * kReach * kLog2e - kLog2Of255);
    const f16 fields[12] = {p.x, p.y, p.a * (0.5f * kLog2e), p.b_ * kLog2e, p.c * (0.5f * kLog2e), bound,
                            vmax(colour[0], zero), vmax(colour[1], zero), vmax(colour[2], zero), p.t[2], half_width, half_height};
    const f16 more[5] = {vlog2(weight), slab, plane[0], plane[1], plane[2]};
    alignas(64) float rows[12][16], more_rows[5][16], normals[64];
    for (int k = 0; k < 12; ++k) store(rows[k], fields[k]);
    for (int k = 0; k < 5; ++k) store(more_rows[k], more[k]);
    splat_normals(block, d, normals);
    for (uint32_t left = seen; left; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        float *fields_of = &out[lane].x, *more_of = &points[lane].log2_weight;
        for (int k = 0; k < 12; ++k) fields_of[k] = rows[k][lane];
        for (int k = 0; k < 5; ++k) more_of[k] = more_rows[k][lane];
        for (int i = 0; i < 3; ++i) points[lane].normal[i] = normals[4 * lane + i];
        out[lane].id = id + uint32_t(lane);
    }
    return seen;
}

// The least distance along the axis that this entry or a later one of the tile can have, a disc being no nearer than a slab
// before its mean.
inline void find_floors(const Frame& f, PointFrame& p, int64_t tile) {
    float least = kFar;
    for (uint64_t e = f.first_entry[size_t(tile) + 1]; e-- > f.first_entry[size_t(tile)];) {
        const Record& g = f.sorted[f.entries[e].rank()];
        const PointRecord& q = p.points[g.id];
        const bool flat = q.plane[0] != 0 || q.plane[1] != 0 || q.plane[2] != 0;
        least = std::min(least, flat ? g.z - q.slab : g.z);
        p.floors[e] = least;
    }
}

}  // namespace NERFVOL_ISA
