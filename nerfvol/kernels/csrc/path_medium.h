// A medium as the walks see it, and the one walk: through bricks with local majorants, to tentative collisions.
#pragma once
#include <cmath>
#include <vector>

#include "path_random.h"
#include "path_scene.h"
#include "simd.h"

namespace NERFVOL_ISA::paths {
using namespace nerfvol;

inline float dot3(f4 a, f4 b) { const f4 c = a * b; return c[0] + c[1] + c[2]; }
inline float largest(f4 a) { const float x = a[0] > a[1] ? a[0] : a[1]; return x > a[2] ? x : a[2]; }
inline float sum3(f4 a) { return a[0] + a[1] + a[2]; }
inline float mean3(f4 a) { return sum3(a) * (1.0f / 3.0f); }
inline f4 vector3(const double* p) { return f4{float(p[0]), float(p[1]), float(p[2]), 0.0f}; }
inline f4 exp3(f4 a) { return f4{std::exp(a[0]), std::exp(a[1]), std::exp(a[2]), 0.0f}; }
inline float sqr(float x) { return x * x; }

// Positions are in bricks from the medium's lower corner, so that nothing depends on the size of the scene or where it lies.
// d: unit direction in the world; v: bricks per u along it; slow: u per brick along each axis; t: distance in u from w.
struct Path3 { f4 w, d, v, slow; };

struct Table {
    std::vector<f4> rows;
    explicit Table(const PathTable& t) { for (int k = 0; k < t.n; ++k) rows.push_back(vector3(t.rows + 3 * k)); }
    f4 at(float a) const {
        const int n = int(rows.size());
        if (n == 1) return rows[0];
        const float x = (a < 0.0f ? 0.0f : a > 1.0f ? 1.0f : a) * float(n - 1);
        const int i = int(x) < n - 2 ? int(x) : n - 2;
        return rows[size_t(i)] + (x - float(i)) * (rows[size_t(i) + 1] - rows[size_t(i)]);
    }
    bool zero() const { for (const f4& r : rows) if (largest(r) > 0.0f) return false; return true; }
};

// Largest extinction of a brick in 1/u, the inverses of that and of its largest density; which of the stored bricks it is.
struct Brick { float sigma, width, least; int32_t place; };

struct Medium {
    int kind, phase;
    f4 size, inverse_size, counts, last;                      // counts: edge of the box in bricks; last: the last brick
    int stride[3];
    std::vector<Brick> bricks;                                // with a border of empty ones, into which rounding may lead
    const float *samples, *attributes;
    float extinction;                                         // 1/u of the densest colour at density 1
    f4 sigma_t, relative;                                     // relative: sigma_t / extinction
    Table albedo, Le;
    bool glows, plain;                                        // plain: one grey albedo, and nothing glows
    float falloff, g1, g2, mix;

    explicit Medium(const PathMedium& m)
        : kind(m.kind), phase(m.phase), samples(m.samples), attributes(m.attributes), sigma_t(vector3(m.sigma_t)),
          albedo(m.albedo), Le(m.Le), falloff(float(m.falloff)), g1(float(m.g1)), g2(float(m.g2)), mix(float(m.mix)) {
        glows = !Le.zero();
        const f4 first = albedo.rows[0];
        plain = !glows && albedo.rows.size() == 1 && first[0] == first[1] && first[1] == first[2];
        extinction = largest(sigma_t);
        relative = sigma_t * (extinction > 0.0f ? 1.0f / extinction : 0.0f);
        size = vector3(m.brick_size);
        inverse_size = f4{1.0f / size[0], 1.0f / size[1], 1.0f / size[2], 0.0f};
        counts = last = f4{};
        for (int a = 0; a < 3; ++a) {
            counts[a] = float((m.hi[a] - m.lo[a]) / m.brick_size[a]);
            last[a] = float(m.bricks[a] - 1);
        }
        const int64_t *n = m.bricks, y = n[2] + 2, x = (n[1] + 2) * y;
        stride[0] = int(x), stride[1] = int(y), stride[2] = 1;
        bricks.assign(size_t((n[0] + 2) * x), Brick{0.0f, 0.0f, 0.0f, 0});
        for (int64_t i = 0, k = 0; i < n[0]; ++i)
            for (int64_t j = 0; j < n[1]; ++j)
                for (int64_t l = 0; l < n[2]; ++l, ++k) {
                    const int64_t offset = kind == kGrid ? m.offsets[k] : 0;
                    if (offset < 0 || !(m.brick_max[k] > 0.0) || !(extinction > 0.0f)) continue;
                    // Rounding up keeps it a bound in single precision.
                    const float most = std::nextafter(float(m.brick_max[k]), INFINITY), sigma = most * extinction;
                    bricks[size_t((i + 1) * x + (j + 1) * y + l + 1)] = {sigma, 1.0f / sigma, 1.0f / most, int32_t(offset / 729)};
                }
    }
    Path3 ray(f4 w, f4 d) const {
        const f4 v = d * inverse_size;
        return {w, d, v, 1.0f / vmax(v, -v)};
    }
    f4 world(f4 w) const { return w * size; }                 // u from the lower corner

    f4 corner_of(f4 w) const {
        return vmax(splat4(0.0f), vmin(f4{float(int(w[0])), float(int(w[1])), float(int(w[2])), 0.0f}, last));
    }
    int64_t index_of(f4 corner) const {
        return int64_t(corner[0] + 1.0f) * stride[0] + int64_t(corner[1] + 1.0f) * stride[1] + int64_t(corner[2] + 1.0f);
    }

    // Distance at which a ray from inside leaves the box.
    float leaves(const Path3& r) const {
        const f4 room = r.v > splat4(0.0f) ? counts - r.w : r.w;
        float t = INFINITY;
        for (int a = 0; a < 3; ++a) {
            const float s = r.v[a] == 0.0f ? INFINITY : room[a] * r.slow[a];
            t = s < t ? s : t;
        }
        return t > 0.0f ? t : 0.0f;
    }
};

// A point in a brick. local: in cells of it, [0, 8), of an exponential medium in the last lane the height in u.
struct Place { int32_t brick; f4 local; };

template <int kKind> inline Place place_in(const Medium& m, const Brick& b, f4 w, f4 corner) {
    Place p{b.place, vmin(vmax((w - corner) * 8.0f, splat4(0.0f)), splat4(7.9999995f))};
    if (kKind == kExponential) p.local[3] = w[2] * m.size[2];
    return p;
}

template <class T> inline float trilinear(const T* s, f4 u) {
    const int i = int(u[0]), j = int(u[1]), k = int(u[2]);
    const float fx = u[0] - float(i), fy = u[1] - float(j), fz = u[2] - float(k);
    s += (i * 9 + j) * 9 + k;
    const f4 a{s[0], s[9], s[81], s[90]}, b{s[1], s[10], s[82], s[91]}, c = a + fz * (b - a);
    const float low = c[0] + fy * (c[1] - c[0]), high = c[2] + fy * (c[3] - c[2]);
    return low + fx * (high - low);
}

template <int kKind> inline float density(const Medium& m, const Place& p) {
    if (kKind == kGrid) return trilinear(m.samples + int64_t(p.brick) * 729, p.local);
    if (kKind == kExponential) return std::exp(-m.falloff * p.local[3]);
    return 1.0f;
}
// Density anywhere in the box, and its place.
template <int kKind> inline float density_at(const Medium& m, f4 w, Place& p) {
    const f4 corner = m.corner_of(w);
    const Brick& b = m.bricks[size_t(m.index_of(corner))];
    p = place_in<kKind>(m, b, w, corner);
    return b.sigma > 0.0f ? density<kKind>(m, p) : 0.0f;
}
inline float attribute(const Medium& m, const Place& p) {
    return m.attributes ? trilinear(m.attributes + int64_t(p.brick) * 729, p.local) : 0.0f;
}

// Visits tentative collisions of the ray up to t1 until event(t, rho / majorant, place, u) says stop; where it did, else -1.
// One exponential serves all bricks up to a collision. The steps from brick to brick branch: guessed rightly, which is most of
// the time, the next brick is under way before it is known to be the next.
template <int kKind, class Event> inline float walk(const Medium& m, const Path3& r, float t1, Random& random, Event&& event) {
    const f4 start = m.corner_of(r.w);
    float corner[3], step[3], next[3], slow[3];
    int64_t jump[3], at = m.index_of(start);
    for (int a = 0; a < 3; ++a) {
        const float v = r.v[a], c = start[a];
        corner[a] = c;
        step[a] = v >= 0.0f ? 1.0f : -1.0f;
        jump[a] = v >= 0.0f ? m.stride[a] : -m.stride[a];
        slow[a] = r.slow[a];
        next[a] = v == 0.0f ? INFINITY : (v > 0.0f ? c + 1.0f - r.w[a] : r.w[a] - c) * slow[a];
    }
    float t = 0.0f, carry = exponential(random.uniform());
    const Brick* bricks = m.bricks.data();
    for (;;) {
        const Brick& b = bricks[at];
        const int axis = next[0] <= next[1] ? (next[0] <= next[2] ? 0 : 2) : (next[1] <= next[2] ? 1 : 2);
        const float leave = axis == 0 ? next[0] : axis == 1 ? next[1] : next[2], end = leave < t1 ? leave : t1;
        if (b.sigma > 0.0f) {
            for (;;) {
                const float room = (end - t) * b.sigma;
                if (carry >= room) {
                    carry -= room > 0.0f ? room : 0.0f;
                    break;
                }
                t += carry * b.width;
                const Place p = place_in<kKind>(m, b, r.w + t * r.v, f4{corner[0], corner[1], corner[2], 0.0f});
                const uint64_t bits = random.bits();
                if (event(t, density<kKind>(m, p) * b.least, p, Random::unit(uint32_t(bits >> 32)))) return t;
                carry = exponential(Random::unit(uint32_t(bits)));
            }
        }
        if (leave >= t1) return -1.0f;
        t = end > t ? end : t;
        if (axis == 0) {
            next[0] += slow[0], corner[0] += step[0], at += jump[0];
        } else if (axis == 1) {
            next[1] += slow[1], corner[1] += step[1], at += jump[1];
        } else {
            next[2] += slow[2], corner[2] += step[2], at += jump[2];
        }
    }
}

}  // namespace NERFVOL_ISA::paths
