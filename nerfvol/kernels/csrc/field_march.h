// Where a ray looks: the steps whose middles lie in occupied cells, as one bit a step.
//
// Groups of steps are tested at their middle against coarse cells that were dilated by one of their kind, sixteen groups at
// once; only windows of sixteen steps with such a group are tested step by step. A group is never longer than two coarse cells,
// so that the result does not depend on the coarse cells.
#pragma once
#include <cmath>

#include "field_encode.h"

namespace NERFVOL_ISA {
using nerfvol::FieldMarch;
constexpr int kCoarse = 4;  // cells along a coarse cell

struct Marcher {
    const FieldShape& f;
    const FieldMarch& m;
    Floats middle, group_middle, reach;   // of steps; of groups, and half their lengths in inner cubes
    std::vector<int32_t> least_cube;                  // whose coarse cells are long enough for a group
    float low[3], high[3];                // a box around all occupied cells, units of the inner cube

    Marcher(const FieldShape& shape, const FieldMarch& march) : f(shape), m(march) {
        const int n = m.n_steps, groups = n / m.group;
        middle.resize(std::size_t(padded(n, 16)));
        group_middle.resize(std::size_t(padded(groups, 16) + kLanes));  // sixteen are read from any on
        reach.resize(group_middle.size());
        least_cube.resize(group_middle.size());
        for (int k = 0; k < n; ++k) middle[std::size_t(k)] = (m.edges[k] + m.edges[k + 1]) / 2;
        for (int g = 0; g < groups; ++g) {
            const float lower = m.edges[g * m.group], upper = m.edges[(g + 1) * m.group];
            group_middle[std::size_t(g)] = (lower + upper) / 2;
            const float half_group = (upper - lower) / 2 / f.half;
            reach[std::size_t(g)] = half_group;
            least_cube[std::size_t(g)] = int32_t(std::ceil(std::log2(std::max(half_group * float(m.resolution / kCoarse) / 2, 1e-6f))));
        }
        find_box();
    }

    // Coarse cells reach a whole one beyond what is occupied: rounding cannot matter but at the faces, which bound nothing.
    void find_box() {
        for (int axis = 0; axis < 3; ++axis) low[axis] = -INFINITY, high[axis] = INFINITY;
        if (m.cubes > 1) return;
        const int c = m.resolution / kCoarse;
        int least[3] = {c, c, c}, most[3] = {-1, -1, -1};
        for (int w = 0; w < (c * c * c + 63) / 64; ++w)
            for (uint64_t bits = m.coarse[w]; bits; bits &= bits - 1) {
                const int i = 64 * w + __builtin_ctzll(bits), at[3] = {i / (c * c), i / c % c, i % c};
                for (int axis = 0; axis < 3; ++axis) least[axis] = std::min(least[axis], at[axis]), most[axis] = std::max(most[axis], at[axis]);
            }
        for (int axis = 0; axis < 3; ++axis) {
            if (least[axis] > 0) low[axis] = float(least[axis]) * 2 / float(c) - 1;
            if (most[axis] < c - 1) high[axis] = float(most[axis] + 1) * 2 / float(c) - 1;
        }
    }

    int words() const { return (m.n_steps + 63) / 64; }

    // Cells of sixteen points on a ray (units of the inner cube): numbers over all cubes.
    void cells(const float* o, const float* d, const float* t, const float* more, const int32_t* least, int r, uint32_t* out) const {
        const float half = float(r) / 2;
        const int last = m.cubes - 1;
        for (int k = 0; k < kLanes; ++k) {
            float x = o[0] + d[0] * t[k], y = o[1] + d[1] * t[k], z = o[2] + d[2] * t[k];
            int32_t cube = 0;
            if (last > 0) {
                const float size = std::max(std::max(std::fabs(x), std::fabs(y)), std::fabs(z)) + (more ? more[k] : 0.0f);
                int32_t bits;
                std::memcpy(&bits, &size, 4);
                cube = ((bits + 0x7fffff) >> 23) - 127;  // ceil(log2)
                if (least && cube < least[k]) cube = least[k];
                cube = cube < 0 ? 0 : cube > last ? last : cube;
                const int32_t scale_bits = (127 - cube) << 23;
                float scale;
                std::memcpy(&scale, &scale_bits, 4);
                x *= scale;
                y *= scale;
                z *= scale;
            }
            const auto cell = [&](float c) {
                float i = (c + 1.0f) * half;
                i = i > 0.0f ? i : 0.0f;
                const float top = float(r - 1);
                return uint32_t(int32_t(i < top ? i : top));
            };
            out[k] = ((uint32_t(cube) * uint32_t(r) + cell(x)) * uint32_t(r) + cell(y)) * uint32_t(r) + cell(z);
        }
    }

    static uint32_t bits_at(const uint64_t* bits, const uint32_t* cell) {
        uint32_t out = 0;
        for (int k = 0; k < kLanes; ++k) out |= uint32_t(bits[cell[k] >> 6] >> (cell[k] & 63) & 1) << k;
        return out;
    }

    // Whether a point (scene units) lies in an occupied cell; outside of the region it is in the nearest one's.
    bool occupied(const float* p) const {
        float o[3];
        for (int axis = 0; axis < 3; ++axis) o[axis] = (p[axis] - f.center[axis]) / f.half;
        int32_t cube = 0;
        const float size = std::max(std::max(std::fabs(o[0]), std::fabs(o[1])), std::fabs(o[2]));
        while (cube < m.cubes - 1 && size > float(1 << cube)) ++cube;
        uint32_t cell = uint32_t(cube);
        for (float x : o) {
            const float i = (x / float(1 << cube) + 1.0f) * (float(m.resolution) / 2);
            cell = cell * uint32_t(m.resolution) + uint32_t(std::min(std::max(i, 0.0f), float(m.resolution - 1)));
        }
        return m.occupied[cell >> 6] >> (cell & 63) & 1;
    }

    // One bit a step into `bits` (words()); `start` is where step 0 begins, also returned. o, d: units of the inner cube.
    float march(const float* o, const float* d, float jitter, uint64_t* bits) const {
        std::fill(bits, bits + words(), 0);
        float near = 0.0f, far = INFINITY, enter = 0.0f, leave = INFINITY;
        for (int axis = 0; axis < 3; ++axis) {
            const float tiny = 1.2e-32f, dir = std::fabs(d[axis]) < tiny ? tiny : d[axis], inverse = 1 / dir;
            const float a = (-f.outer - o[axis]) / dir, b = (f.outer - o[axis]) / dir;
            near = std::max(near, std::min(a, b));
            far = std::min(far, std::max(a, b));
            const float c = (low[axis] - o[axis]) * inverse, e = (high[axis] - o[axis]) * inverse;
            enter = std::max(enter, std::min(c, e));
            leave = std::min(leave, std::max(c, e));
        }
        near = std::max(near, m.near_plane);
        const float start = near + (jitter - 0.5f) * m.step;
        if (!(near < far && enter < leave)) return start;
        const int windows = (m.n_steps + 15) / 16, per_window = 16 / m.group, groups = m.n_steps / m.group;
        alignas(64) float t[kLanes];
        alignas(64) uint32_t cell[kLanes];
        const float until = std::min(far, leave);
        int first = 0;
        while (first + per_window < groups && start + m.edges[(first + per_window) * m.group] < enter) first += per_window;
        for (; first < groups; first += kLanes) {
            if (start + m.edges[first * m.group] >= until) break;
            for (int k = 0; k < kLanes; ++k) t[k] = start + group_middle[std::size_t(first + k)];
            cells(o, d, t, reach.data() + first, least_cube.data() + first, m.resolution / kCoarse, cell);
            const uint32_t hits = bits_at(m.coarse, cell);
            for (int w = first / per_window, g = 0; g < kLanes && w < windows; ++w, g += per_window) {
                if (!(hits >> g & ((1u << per_window) - 1u))) continue;
                const int step = 16 * w, count = std::min(16, m.n_steps - step);
                for (int k = 0; k < kLanes; ++k) t[k] = start + middle[std::size_t(step + k)];
                cells(o, d, t, nullptr, nullptr, m.resolution, cell);
                uint32_t inside = 0;
                for (int k = 0; k < count; ++k) inside |= uint32_t(t[k] >= near && t[k] < far) << k;
                bits[step / 64] |= uint64_t(bits_at(m.occupied, cell) & inside) << (step % 64);
            }
        }
        return start;
    }
};

}  // namespace NERFVOL_ISA
