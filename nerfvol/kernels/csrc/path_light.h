// Phase functions and lights of the path tracer; d and wi are directions of unit length, wi towards the light.
#pragma once
#include "path_medium.h"

namespace NERFVOL_ISA::paths {

constexpr float kPi = 3.14159265f, kQuarter = 0.25f / kPi;    // 1 / 4 pi

inline f4 cross3(f4 a, f4 b) {
    return f4{a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0], 0.0f};
}

// The direction at an angle of this cosine from n, turned about it (Duff et al. 2017); of unit length again.
inline f4 about(f4 n, float cosine, float azimuth) {
    const float s = n[2] >= 0.0f ? 1.0f : -1.0f, a = -1.0f / (s + n[2]), b = n[0] * n[1] * a;
    const f4 x{1.0f + s * n[0] * n[0] * a, s * b, -s * n[0], 0.0f}, y{b, s + n[1] * n[1] * a, -n[1], 0.0f};
    const float sine = std::sqrt(cosine * cosine < 1.0f ? 1.0f - cosine * cosine : 0.0f);
    const Turn r = turn(azimuth);
    const f4 d = (sine * r.cosine) * x + (sine * r.sine) * y + cosine * n;
    return d * (1.5f - 0.5f * dot3(d, d));  // one step of Newton's towards 1 / |d|
}

// (1 - g^2) / 4 pi (1 + g^2 - 2 g cos)^(3/2); before and after: propagation. The bracket is (1 - g)^2 + g |before - after|^2,
// which keeps its digits where light goes straight on.
inline float lobe(float g, f4 before, f4 after) {
    const f4 apart = g < 0.0f ? before + after : before - after;
    const float a = g < 0.0f ? -g : g, q = sqr(1.0f - a) + a * dot3(apart, apart);
    return kQuarter * (1.0f - a) * (1.0f + a) / (q * std::sqrt(q));
}

inline float phase_function(const Medium& m, f4 before, f4 after) {
    if (m.phase == kHenyeyGreenstein) {
        const float f = lobe(m.g1, before, after);
        return m.mix < 1.0f ? m.mix * f + (1.0f - m.mix) * lobe(m.g2, before, after) : f;
    }
    if (m.phase == kRayleigh) return 0.75f * kQuarter * (1.0f + sqr(dot3(before, after)));
    return kQuarter;
}

// A direction after scattering, with the phase function's density. phase.hg_cosine and phase.sample have the formulas.
inline f4 scattered(const Medium& m, f4 before, Random& random) {
    const uint64_t bits = random.bits();
    const float u = Random::unit(uint32_t(bits >> 32)), azimuth = Random::unit(uint32_t(bits));
    float cosine = 2.0f * u - 1.0f;
    if (m.phase == kHenyeyGreenstein) {
        const float g = m.mix >= 1.0f || random.uniform() < m.mix ? m.g1 : m.g2, v = cosine, q = 1.0f + g * v;
        cosine = (2.0f * v * (1.0f + g * g) + g * (3.0f - g * g) + g * (1.0f + g * g) * v * v) / (2.0f * q * q);
    } else if (m.phase == kRayleigh) {
        const float a = 4.0f * u - 2.0f, root = std::cbrt(a + std::sqrt(a * a + 1.0f));
        cosine = root - 1.0f / root;
    }
    return about(before, cosine > 1.0f ? 1.0f : cosine < -1.0f ? -1.0f : cosine, azimuth);
}

struct Light {
    int kind;
    f4 colour, a, b;  // point: position in u from the medium's lower corner; directional: towards it; sky: horizon, ground
};

struct Lights {
    std::vector<Light> rows;
    std::vector<int> points;                                  // which of them are points
    bool sky = false;
    Lights(const PathScene& s) {
        for (int k = 0; k < s.n_lights; ++k) {
            const double* row = s.lights + k * kLightColumns;
            Light l{int(row[0]), vector3(row + 4), vector3(row + 7), vector3(row + 10)};
            if (l.kind == kPointLight) {
                for (int c = 0; c < 3; ++c) l.a[c] = float(row[7 + c] - s.medium.lo[c]);
                points.push_back(k);
            }
            sky = sky || l.kind == kSkyLight;
            rows.push_back(l);
        }
    }
    int count() const { return int(rows.size()); }
};

inline int choose(int n, Random& random) {
    const int k = int(random.uniform() * float(n));
    return k < n ? k : n - 1;
}

// lights.sky_blend
inline f4 sky_towards(const Light& l, f4 d) {
    if (d[2] >= 0.0f) return l.a + std::sqrt(d[2]) * (l.colour - l.a);
    const float t = -8.0f * d[2];
    return l.a + (t < 1.0f ? t : 1.0f) * (l.b - l.a);
}

inline f4 all_sky(const Lights& lights, f4 d) {
    f4 total = splat4(0.0f);
    for (const Light& l : lights.rows)
        if (l.kind == kSkyLight) total += sky_towards(l, d);
    return total;
}

// Kulla & Fajardo 2012, equiangular.py: along a segment [0, t1] past a point light.
struct Equiangular {
    float near, D, first, last;
    Equiangular(f4 from, f4 d, float t1, f4 light) {
        const f4 to = light - from;
        near = dot3(to, d);
        const f4 off = to - near * d;
        const float least = 1e-6f * (std::sqrt(dot3(to, to)) + t1), away = std::sqrt(dot3(off, off));
        D = away > least ? away : least;
        first = std::atan(-near / D);
        last = std::atan((t1 - near) / D);
    }
    float density(float t) const { return D / ((last - first) * (D * D + sqr(t - near))); }
    float sample(float u, float t1) const {
        const float t = near + D * std::tan(first + u * (last - first));
        return t < 0.0f ? 0.0f : t > t1 ? t1 : t;
    }
};

// The part of a point light that a path's own vertices see: they choose among all lights, the others among the points.
inline float own_share(float sigma, float placed, const Lights& l) {
    const float own = sigma / float(l.count());
    return own / (own + placed / float(l.points.size()));
}

}  // namespace NERFVOL_ISA::paths
