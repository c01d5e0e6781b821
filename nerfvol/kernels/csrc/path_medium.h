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
inline float smallest(f4 a) { const float x = a[0] < a[1] ? a[0] : a[1]; return x < a[2] ? x : a[2]; }
inline float sum3(f4 a) { return a[0] + a[1] + a[2]; }
inline float mean3(f4 a) { return sum3(a) * (1.0f / 3.0f); }
inline f4 vector3(const double* p) { return f4{float(p[0]), float(p[1]), float(p[2]), 0.0f}; }
inline f4 exp3(f4 a) { return f4{std::exp(a[0]), std::exp(a[1]), std::exp(a[2]), 0.0f}; }
inline float sqr(float x) { return x * x; }

// Positions are in bricks from the medium's lower corner, so that nothing depends on the size of the scene or where it lies.
// d: unit direction in the world; v: bricks per u along it; t: distance in u from w.
struct Path3 { f4 w, d, v; };

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

struct Brick { float most; int32_t place; };                  // largest density; which of the stored bricks

struct Medium {
    int kind, phase;
    f4 size, inverse_size, counts, last;                      // counts: edge of the box in bricks; last: the last brick
    int stride[3];
    std::vector<Brick> bricks;                                // with a border of empty ones, into which rounding may lead
    const float *samples, *attributes;
    float extinction;                                         // 1/u of the densest colour at density 1
    f4 sigma_t, relative;                                     // relative: sigma_t / extinction
    Table albedo, Le;
    bool glows;
    float falloff, g1, g2, mix;

    explicit Medium(const PathMedium& m)
        : kind(m.kind), phase(m.phase), samples(m.samples), attributes(m.attributes), sigma_t(vector3(m.sigma_t)),
          albedo(m.albedo), Le(m.Le), falloff(float(m.falloff)), g1(float(m.g1)), g2(float(m.g2)), mix(float(m.mix)) {
        glows = !Le.zero();
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
        bricks.assign(size_t((n[0] + 2) * x), Brick{0.0f, 0});
        for (int64_t i = 0, k = 0; i < n[0]; ++i)
            for (int64_t j = 0; j < n[1]; ++j)
                for (int64_t l = 0; l < n[2]; ++l, ++k) {
                    const int64_t offset = kind == kGrid ? m.offsets[k] : 0;
                    if (offset < 0) continue;
                    // Rounding up keeps it a bound in single precision.
                    const float most = std::nextafter(float(m.brick_max[k]), INFINITY);
                    bricks[size_t((i + 1) * x + (j + 1) * y + l + 1)] = {m.brick_max[k] > 0.0 ? most : 0.0f, int32_t(offset / 729)};
                }
    }
    Path3 ray(f4 w, f4 d) const { return {w, d, d * inverse_size}; }
    f4 world(f4 w) const { return w * size; }                 // u from the lower corner

    f4 corner_of(f4 w) const {
        return vmax(splat4(0.0f), vmin(f4{float(int(w[0])), float(int(w[1])), float(int(w[2])), 0.0f}, last));
    }
    int64_t index_of(f4 corner) const {
        return int64_t(corner[0] + 1.0f) * stride[0] + int64_t(corner[1] + 1.0f) * stride[1] + int64_t(corner[2] + 1.0f);
    }

    // Distance at which a ray from inside leaves the box.
    float leaves(const Path3& r) const {
        float t = INFINITY;
        for (int a = 0; a < 3; ++a) {
            if (r.v[a] == 0.0f) continue;
            const float s = ((r.v[a] > 0.0f ? counts[a] : 0.0f) - r.w[a]) / r.v[a];
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
    return b.most > 0.0f ? density<kKind>(m, p) : 0.0f;
}
inline float attribute(const Medium& m, const Place& p) {
    return m.attributes ? trilinear(m.attributes + int64_t(p.brick) * 729, p.local) : 0.0f;
}

// Visits tentative collisions of the ray up to t1 until event(t, rho / majorant, place) says stop; where it did, else -1.
// One exponential serves all bricks up to a collision.
template <int kKind, class Event> inline float walk(const Medium& m, const Path3& r, float t1, Random& random, Event&& event) {
    const f4 none = splat4(0.0f), ones = splat4(1.0f), tiny = splat4(1e-30f);
    const auto forward = r.v > none;
    const f4 speed = vmax(r.v > none ? r.v : -r.v, tiny), inverse = ones / speed;
    f4 corner = m.corner_of(r.w);
    f4 next = r.v == none ? splat4(INFINITY) : (forward ? corner + 1.0f - r.w : r.w - corner) * inverse;
    const f4 step = forward ? ones : -ones;
    const int jump[3] = {r.v[0] > 0.0f ? m.stride[0] : -m.stride[0], r.v[1] > 0.0f ? m.stride[1] : -m.stride[1], r.v[2] > 0.0f ? 1 : -1};
    int64_t at = m.index_of(corner);
    float t = 0.0f, carry = exponential(random.uniform());
    const Brick* bricks = m.bricks.data();
    for (;;) {
        const Brick b = bricks[at];
        const float leave = smallest(next), end = leave < t1 ? leave : t1;
        if (b.most > 0.0f) {
            const float sigma = b.most * m.extinction, width = 1.0f / sigma, least = 1.0f / b.most;
            for (;;) {
                const float room = (end - t) * sigma;
                if (carry >= room) {
                    carry -= room > 0.0f ? room : 0.0f;
                    break;
                }
                t += carry * width;
                const f4 w = r.w + t * r.v;
                const Place p = place_in<kKind>(m, b, w, corner);
                const uint64_t bits = random.bits();
                if (event(t, density<kKind>(m, p) * least, p, Random::unit(uint32_t(bits >> 32)))) return t;
                carry = exponential(Random::unit(uint32_t(bits)));
            }
        }
        if (leave >= t1) return -1.0f;
        t = end > t ? end : t;
        const auto crossed = next <= splat4(leave);
        const f4 whole = crossed ? ones : none;
        next += whole * inverse;
        corner += whole * step;
        at += (crossed[0] ? jump[0] : 0) + (crossed[1] ? jump[1] : 0) + (crossed[2] ? jump[2] : 0);
    }
}

}  // namespace NERFVOL_ISA::paths
