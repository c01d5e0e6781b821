// One path, and the pictures made of many: data_synth/path.py in single precision, from the box's edge on.
#pragma once
#include <algorithm>

#include "path_light.h"
#include "pool.h"

namespace NERFVOL_ISA::paths {

constexpr int kRouletteDepth = 6;             // scatterings before weak paths are ended
constexpr int64_t kLong = 1000;               // ... after which even a path that loses nothing is ended by chance
constexpr float kEventRoulette = 0.1f;        // throughput times f below which next events are drawn by chance
constexpr float kShadowRoulette = 0.2f;       // transmittance below which shadow rays go on by chance

struct Outcome { f4 L; double alpha, far; };  // far: distance where the straight part ends, premultiplied

template <int kKind, bool kGrey> struct Tracer {
    const Medium& m;
    const Lights& lights;
    const int64_t max_depth;
    const bool opaque_sky;

    // RGB transmittance of [0, t1] of a ray from inside, one sample of it.
    f4 transmittance(const Path3& r, float t1, Random& random) const {
        if (kKind == kHomogeneous) return exp3(-t1 * m.sigma_t);
        if (kKind == kExponential) {
            const float x = r.d[2] * m.falloff * t1, mean = x > 1e-3f || x < -1e-3f ? -std::expm1(-x) / x : 1.0f - 0.5f * x;
            return exp3((-t1 * mean * std::exp(-m.falloff * r.w[2] * m.size[2])) * m.sigma_t);
        }
        float T = 1.0f;
        f4 colour = splat4(1.0f);
        const float stop = walk<kKind>(m, r, t1, random, [&](float, float rho, const Place&, float u) {
            if (kGrey) {
                T *= 1.0f - rho;
            } else {
                colour *= 1.0f - rho * m.relative;
                T = largest(colour);
            }
            if (T <= 0.0f) return true;
            if (T >= kShadowRoulette) return false;
            if (u * kShadowRoulette >= T) return true;
            if (!kGrey) colour *= kShadowRoulette / T;
            T = kShadowRoulette;
            return false;
        });
        if (stop >= 0.0f) return splat4(0.0f);
        return kGrey ? splat4(T) : colour;
    }

    // Radiance at the ray's origin from one point light, scattered once in [0, t1].
    f4 in_segment(const Path3& r, float t1, f4 beta, Random& random) const {
        const int points = int(lights.points.size());
        const Light& l = lights.rows[size_t(lights.points[size_t(choose(points, random))])];
        const Equiangular e(m.world(r.w), r.d, t1, l.a);
        if (!(e.last > e.first)) return splat4(0.0f);
        const float t = e.sample(random.uniform(), t1), pdf = e.density(t);
        const f4 w = r.w + t * r.v;
        Place p;
        const float rho = density_at<kKind>(m, w, p);
        if (rho <= 0.0f) return splat4(0.0f);
        const f4 to = l.a - m.world(w);
        const float r2 = dot3(to, to), away = std::sqrt(r2);
        const f4 wi = to * (1.0f / away);
        const float share = 1.0f - own_share(rho * m.extinction, pdf, lights);
        const float value = share * float(points) * rho * phase_function(m, r.d, wi) / (pdf * r2);
        f4 L = value * m.sigma_t * m.albedo.at(attribute(m, p)) * l.colour;
        if (!(largest(beta * L) > 0.0f)) return splat4(0.0f);
        L *= transmittance(r, t, random);
        if (!(largest(L) > 0.0f)) return splat4(0.0f);
        const Path3 shadow = m.ray(w, wi);
        const float edge = m.leaves(shadow);
        return L * transmittance(shadow, away < edge ? away : edge, random);
    }

    // beta times the radiance along -before from one light, weighted against the other ways to find it. reached: the
    // segment on which w was placed, at distance t of t1.
    f4 next_event(const Path3& reached, float t, float t1, f4 w, f4 beta, Random& random) const {
        const int count = lights.count();
        const Light& l = lights.rows[size_t(choose(count, random))];
        f4 wi = l.a, radiance = l.colour;
        float distance = INFINITY, weight = float(count);
        if (l.kind == kSkyLight) {
            const uint64_t bits = random.bits();
            wi = about(f4{0.0f, 0.0f, 1.0f, 0.0f}, 1.0f - 2.0f * Random::unit(uint32_t(bits >> 32)), Random::unit(uint32_t(bits)));
            radiance = (1.0f / kQuarter) * sky_towards(l, wi);
        } else if (l.kind == kPointLight) {
            const f4 to = l.a - m.world(w);
            const float r2 = dot3(to, to);
            distance = std::sqrt(r2);
            wi = to * (1.0f / distance);
            radiance = l.colour * (1.0f / r2);
            Place p;
            const float sigma = density_at<kKind>(m, w, p) * m.extinction;
            weight *= own_share(sigma, Equiangular(m.world(reached.w), reached.d, t1, l.a).density(t), lights);
        }
        const float f = phase_function(m, reached.d, wi);
        if (l.kind == kSkyLight) weight *= kQuarter / (kQuarter + float(count) * f);
        const f4 contribution = (weight * f) * beta * radiance;
        if (!(largest(contribution) > 0.0f)) return splat4(0.0f);
        const float q = largest(beta) * f * (1.0f / kEventRoulette);
        float kept = 1.0f;
        if (q < 1.0f) {
            if (random.uniform() >= q) return splat4(0.0f);
            kept = 1.0f / q;
        }
        const Path3 shadow = m.ray(w, wi);
        const float edge = m.leaves(shadow);
        return kept * contribution * transmittance(shadow, distance < edge ? distance : edge, random);
    }

    // A path from w at the edge of the box, or in it, ``base`` from the camera.
    Outcome trace(f4 w, f4 d, double base, Random& random) const {
        f4 beta = splat4(1.0f), L = splat4(0.0f);
        double far = 0.0, alpha = 1.0;
        float pdf = 0.0f;
        bool straight = true;
        const f4 ones = splat4(1.0f);
        const float lost = 1.0f - m.albedo.rows[0][0];
        for (int64_t depth = 0;;) {
            const Path3 r = m.ray(w, d);
            const float edge = m.leaves(r);
            if (!lights.points.empty() && depth < max_depth && edge > 0.0f) L += beta * in_segment(r, edge, beta, random);
            const float t = walk<kKind>(m, r, edge, random, [&](float at, float rho, const Place& p, float u) {
                if (rho <= 0.0f) return false;
                if (kGrey && m.plain) {
                    const float kept = 1.0f - rho * lost;
                    if (straight) far += double(mean3(beta) * rho * lost) * (base + double(at));
                    beta *= kept;
                    return u * kept < rho - rho * lost;
                }
                const float a = m.albedo.rows.size() > 1 || m.glows ? attribute(m, p) : 0.0f;
                const f4 collide = rho * m.relative, albedo = m.albedo.at(a), absorbed = beta * collide * (ones - albedo);
                if (m.glows) L += absorbed * m.Le.at(a);
                if (straight) far += double(mean3(absorbed)) * (base + double(at));
                const f4 scatter = beta * collide * albedo, fly = beta * (ones - collide);
                const float s = sum3(scatter), n = sum3(fly), both = s + n;
                if (both <= 0.0f) {
                    beta = splat4(0.0f);
                    return true;
                }
                const bool real = u * both < s;
                beta = real ? (both / s) * scatter : (both / n) * fly;
                return real;
            });
            if (t < 0.0f) {
                if (straight && !opaque_sky) {
                    alpha = 1.0 - double(mean3(beta));
                } else {
                    const float n = float(lights.count()) * pdf;
                    L += (pdf > 0.0f ? n / (n + kQuarter) : 1.0f) * beta * all_sky(lights, d);
                }
                break;
            }
            base += double(t);
            if (straight) far += double(mean3(beta)) * base;
            straight = false;
            if (depth >= max_depth || !(largest(beta) > 0.0f)) break;
            w = r.w + t * r.v;
            if (lights.count()) L += next_event(r, t, edge, w, beta, random);
            const f4 wi = scattered(m, d, random);
            if (lights.sky) pdf = phase_function(m, d, wi);
            d = wi;
            if (++depth > kRouletteDepth) {
                const float most = largest(beta), limit = depth < kLong ? 1.0f : 0.99f, q = most < limit ? most : limit;
                if (q < 1.0f) {
                    if (random.uniform() >= q) break;
                    beta *= 1.0f / q;
                }
            }
        }
        return {L, alpha, far};
    }
};

// Where a ray o + t d is in the box lo..hi, t >= 0: first > last where it is not.
struct Interval { double first, last; };
inline Interval in_box(const PathMedium& m, const double* o, const double* d) {
    Interval s{0.0, INFINITY};
    for (int a = 0; a < 3; ++a) {
        if (d[a] == 0.0) {
            if (o[a] < m.lo[a] || o[a] > m.hi[a]) return {1.0, 0.0};
            continue;
        }
        const double p = (m.lo[a] - o[a]) / d[a], q = (m.hi[a] - o[a]) / d[a];
        s.first = std::fmax(s.first, std::fmin(p, q));
        s.last = std::fmin(s.last, std::fmax(p, q));
    }
    return s;
}

// Adds path k of pixel x, y to sums of rgb, alpha, distance and the squares of rgb.
template <class T> void add_path(const T& tracer, const PathScene& s, int width, int x, int y, int64_t k, double* sums) {
    const PathCamera& c = s.camera;
    const double *M = c.c2w, o[3] = {M[3], M[7], M[11]};
    Random random(s.settings.seed, uint64_t(y) * uint64_t(width) + uint64_t(x), uint64_t(k));
    const double i = s.settings.jitter ? random.uniform() : 0.5, j = s.settings.jitter ? random.uniform() : 0.5;
    const double u = (x + i - c.cx) / c.fx, v = -(y + j - c.cy) / c.fy, n = 1.0 / std::sqrt(u * u + v * v + 1.0);
    double d[3], w[3];
    for (int a = 0; a < 3; ++a) d[a] = (M[4 * a] * u + M[4 * a + 1] * v - M[4 * a + 2]) * n;
    const Interval t = in_box(s.medium, o, d);
    const f4 direction = vector3(d);
    Outcome r{splat4(0.0f), double(s.settings.opaque_sky), 0.0};
    if (t.last > t.first) {
        for (int a = 0; a < 3; ++a) w[a] = (o[a] + t.first * d[a] - s.medium.lo[a]) / s.medium.brick_size[a];
        r = tracer.trace(vector3(w), direction, t.first, random);
    } else if (s.settings.opaque_sky) {
        r.L = all_sky(tracer.lights, direction);
    }
    for (int a = 0; a < 3; ++a) sums[a] += r.L[a], sums[5 + a] += double(r.L[a]) * r.L[a];
    sums[3] += r.alpha;
    sums[4] += r.far;
}

// The last two nodes that wait become one: parts.tree_sum.
inline void join(double (*nodes)[8], int& waiting) {
    --waiting;
    for (int c = 0; c < 8; ++c) nodes[waiting - 1][c] += nodes[waiting][c];
}

template <int kKind, bool kGrey>
void trace_rows(const PathScene& s, const Medium& m, const Lights& lights, int width, int first, int last, double* out) {
    const Tracer<kKind, kGrey> tracer{m, lights, s.settings.max_depth, s.settings.opaque_sky};
    const int side = 8, columns = (width + side - 1) / side, rows = (last - first + side - 1) / side;
    parallel_for(columns * rows, [&](int tile, int) {
        const int x0 = tile % columns * side, y0 = first + tile / columns * side;
        for (int y = y0; y < y0 + side && y < last; ++y)
            for (int x = x0; x < x0 + side && x < width; ++x) {
                double nodes[64][8];
                int waiting = 0;
                for (int64_t block = s.settings.first; block < s.settings.last; ++block) {
                    double* sums = nodes[waiting++];
                    std::fill(sums, sums + 8, 0.0);
                    for (int64_t k = block * kBlock; k < std::min((block + 1) * kBlock, s.settings.spp); ++k)
                        add_path(tracer, s, width, x, y, k, sums);
                    for (int64_t done = block + 1 - s.settings.first; done % 2 == 0; done /= 2) join(nodes, waiting);
                }
                while (waiting > 1) join(nodes, waiting);
                std::copy(nodes[0], nodes[0] + 8, out + (int64_t(y - first) * width + x) * 8);
            }
    });
}

void trace_paths(const PathScene& s, int width, int first, int last, double* out) {
    const Medium m(s.medium);
    const Lights lights(s);
    const bool grey = m.sigma_t[0] == m.sigma_t[1] && m.sigma_t[1] == m.sigma_t[2];
    const auto run = [&](auto* rows) { rows(s, m, lights, width, first, last, out); };
    if (m.kind == kHomogeneous) run(grey ? &trace_rows<kHomogeneous, true> : &trace_rows<kHomogeneous, false>);
    else if (m.kind == kExponential) run(grey ? &trace_rows<kExponential, true> : &trace_rows<kExponential, false>);
    else run(grey ? &trace_rows<kGrid, true> : &trace_rows<kGrid, false>);
}

}  // namespace NERFVOL_ISA::paths
