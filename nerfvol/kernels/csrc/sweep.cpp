#include "sweep.h"

#include <algorithm>
#include <cmath>

#include "clones.h"
#include "pool.h"

namespace nerfvol {
namespace {

constexpr int kRadius = 3;      // windows of 7x7 pixels
constexpr int kBand = 32;       // rows after which running sums begin anew, so that rounding does not add up
constexpr float kFloor = 4e-5f; // of a window's variance sum: what is flatter than this has no texture
constexpr float kMiddle = 0.5f; // taken off all greys: sums of squares of small numbers lose less

// A picture with its mask as numbers, which vectors can gather; null where it is one everywhere.
struct Picture {
    const float *grey, *solid;
    int height, width;
};

// What a thread needs for one reference; rows have kRadius zeros on both sides where windows reach over the edge.
struct Workspace {
    std::vector<float> ref, mean, deviation, other, valid, first, second, previous, best, before, after, rival, count;
    std::vector<int> at;
    std::vector<float> columns, rows;
};

// Greys of `to` seen from row y of the reference through plane w, and 1 where they are on the picture.
template <bool kMasked>
NERFVOL_INLINE void warp_row(const Picture& to, const float* map, float w, int y, int width, float* out, float* valid) {
    const float fy = float(y) + 0.5f;
    const float x0 = map[1] * fy + map[2] + w * map[9], y0 = map[4] * fy + map[5] + w * map[10],
                z0 = map[7] * fy + map[8] + w * map[11];
    const float right = float(to.width), bottom = float(to.height);
    const float last_x = float(to.width - 1), last_y = float(to.height - 1);
    const int stride = to.width, most_x = std::max(to.width - 2, 0), most_y = std::max(to.height - 2, 0);
    const int dx = to.width > 1 ? 1 : 0, dy = to.height > 1 ? stride : 0;
    const float *grey = to.grey, *solid = to.solid;
    NERFVOL_APART
    for (int x = 0; x < width; ++x) {
        const float fx = float(x) + 0.5f;
        const float z = map[6] * fx + z0;
        const float inverse = 1.0f / z;
        const float u = (map[0] * fx + x0) * inverse, v = (map[3] * fx + y0) * inverse;
        const bool inside = (z > 1e-6f) & (u >= 0.0f) & (u <= right) & (v >= 0.0f) & (v <= bottom);
        float su = u - 0.5f, sv = v - 0.5f;
        su = su > 0.0f ? su : 0.0f;  // NaN becomes 0 as well
        sv = sv > 0.0f ? sv : 0.0f;
        su = su < last_x ? su : last_x;
        sv = sv < last_y ? sv : last_y;
        int iu = int(su), iv = int(sv);
        iu = iu < most_x ? iu : most_x;
        iv = iv < most_y ? iv : most_y;
        const float au = su - float(iu), av = sv - float(iv);
        const int at = iv * stride + iu;
        const float top = grey[at] + au * (grey[at + dx] - grey[at]);
        const float low = grey[at + dy] + au * (grey[at + dy + dx] - grey[at + dy]);
        out[x] = top + av * (low - top) - kMiddle;
        float there = inside ? 1.0f : 0.0f;
        if (kMasked) there *= solid[int(sv + 0.5f) * stride + int(su + 0.5f)];
        valid[x] = there;
    }
}

// out[x] = the sum of in[x] ... in[x + 6], where in begins kRadius before the row.
NERFVOL_INLINE void sum_of_seven(const float* in, int width, float* out) {
    NERFVOL_APART
    for (int x = 0; x < width; ++x)
        out[x] = ((in[x] + in[x + 1]) + (in[x + 2] + in[x + 3])) + ((in[x + 4] + in[x + 5]) + in[x + 6]);
}

// Adds (sign 1) or takes off (-1) a row from the column sums of b, b^2 and a b.
NERFVOL_INLINE void add_row(const float* a, const float* b, int width, float sign, float* s1, float* s2, float* s3) {
    NERFVOL_APART
    for (int x = 0; x < width; ++x) {
        const float sb = sign * b[x];
        s1[x] += sb;
        s2[x] += sb * b[x];
        s3[x] += sb * a[x];
    }
}

NERFVOL_INLINE float window(int at, int size) {
    return float(std::min(at + kRadius, size - 1) - std::max(at - kRadius, 0) + 1);
}

// Calls use(y, sums of b, of b^2, of a b) with the 7x7 windows' sums of every row.
template <class Use>
NERFVOL_INLINE void windows(const float* a, const float* b, int height, int width, Workspace& s, const Use& use) {
    const int padded = width + 2 * kRadius;
    s.columns.assign(size_t(3 * padded), 0.0f);
    float* columns[3];
    float* rows[3];
    for (int k = 0; k < 3; ++k) {
        columns[k] = s.columns.data() + k * padded;
        rows[k] = s.rows.data() + k * width;
    }
    const auto add = [&](int y, float sign) __attribute__((always_inline)) {
        add_row(a + size_t(y) * width, b + size_t(y) * width, width, sign, columns[0] + kRadius, columns[1] + kRadius,
                columns[2] + kRadius);
    };
    for (int y = 0; y < height; ++y) {
        if (y % kBand == 0) {
            std::fill(s.columns.begin(), s.columns.end(), 0.0f);
            for (int row = std::max(y - kRadius, 0); row < std::min(y + kRadius, height); ++row) add(row, 1.0f);
        } else if (y - kRadius - 1 >= 0) {
            add(y - kRadius - 1, -1.0f);
        }
        if (y + kRadius < height) add(y + kRadius, 1.0f);
        for (int k = 0; k < 3; ++k) sum_of_seven(columns[k], width, rows[k]);
        use(y, rows[0], rows[1], rows[2]);
    }
}

// Zero-mean normalised cross-correlation of the reference with `b`; keeps the two best scores so far of every pixel.
NERFVOL_INLINE void correlate(const float* b, int height, int width, Workspace& s) {
    windows(s.ref.data(), b, height, width, s, [&](int y, const float* sb, const float* sbb, const float* sab) __attribute__((always_inline)) {
        const size_t row = size_t(y) * width;
        const float *mean = s.mean.data() + row, *deviation = s.deviation.data() + row, *valid = s.valid.data() + row;
        float *first = s.first.data() + row, *second = s.second.data() + row;
        const float* across = s.count.data();
        const float down = window(y, height);
    NERFVOL_APART
        for (int x = 0; x < width; ++x) {
            const float n = across[x] * down;
            const float variance = std::max(sbb[x] - sb[x] * sb[x] / n, 0.0f) + kFloor;
            const float zncc = (sab[x] - mean[x] * sb[x]) / (deviation[x] * std::sqrt(variance));
            const float score = valid[x] > 0.0f ? zncc : -1.0f;
            second[x] = std::max(second[x], std::min(first[x], score));
            first[x] = std::max(first[x], score);
        }
    });
}

// The reference's own window means (times 1, not n) and square roots of its variance sums.
NERFVOL_INLINE void prepare(const Picture& picture, Workspace& s) {
    const int height = picture.height, width = picture.width;
    const size_t n = size_t(height) * width;
    for (auto* v : {&s.ref, &s.mean, &s.deviation, &s.other, &s.valid, &s.first, &s.second, &s.previous, &s.before, &s.after})
        v->assign(n, 0.0f);
    s.best.assign(n, -1.0f);
    s.rival.assign(n, -1.0f);
    s.at.assign(n, -1);
    s.rows.assign(size_t(3 * width), 0.0f);
    s.count.resize(size_t(width));
    for (int x = 0; x < width; ++x) s.count[size_t(x)] = window(x, width);
    for (size_t i = 0; i < n; ++i) s.ref[i] = picture.grey[i] - kMiddle;
    windows(s.ref.data(), s.ref.data(), height, width, s, [&](int y, const float* sa, const float* saa, const float*) {
        const float down = window(y, height);
        for (int x = 0; x < width; ++x) {
            const size_t i = size_t(y) * width + x;
            s.mean[i] = sa[x] / (s.count[size_t(x)] * down);
            s.deviation[i] = std::sqrt(std::max(saa[x] - sa[x] * s.mean[i], 0.0f) + kFloor);
        }
    });
}

// Takes the scores of plane number `plane` into the best one's record.
NERFVOL_INLINE void record(int plane, int others, int apart, size_t n, Workspace& s) {
    const bool alone = others < 2;
    NERFVOL_APART
    for (size_t i = 0; i < n; ++i) {
        const float two = s.second[i] > -1.0f ? 0.5f * (s.first[i] + s.second[i]) : -1.0f;  // both must see the pixel
        const float score = alone ? s.first[i] : two;
        const bool better = score > s.best[i], next = s.at[i] == plane - 1 && plane > 0, far = plane - s.at[i] >= apart;
        const float lesser = better ? s.best[i] : score;  // the best so far is a rival of what beats it from afar
        s.rival[i] = (far & (lesser > s.rival[i])) ? lesser : s.rival[i];
        s.after[i] = better ? -1.0f : next ? score : s.after[i];
        s.before[i] = better ? s.previous[i] : s.before[i];
        s.at[i] = better ? plane : s.at[i];
        s.best[i] = better ? score : s.best[i];
        s.previous[i] = score;
    }
}

NERFVOL_INLINE void sweep_body(const std::vector<Picture>& pictures, const Reference& r, int planes, float first, float step, Workspace& s) {
    const Picture& picture = pictures[size_t(r.picture)];
    const int height = picture.height, width = picture.width;
    const size_t n = size_t(height) * width;
    prepare(picture, s);
    std::fill(s.previous.begin(), s.previous.end(), -1.0f);
    for (int plane = 0; plane < planes; ++plane) {
        std::fill(s.first.begin(), s.first.end(), -1.0f);
        std::fill(s.second.begin(), s.second.end(), -1.0f);
        for (const Comparison& c : r.others) {
            const Picture& to = pictures[size_t(c.picture)];
            const float w = first + step * float(plane);
            for (int y = 0; y < height; ++y) {
                float *other = s.other.data() + size_t(y) * width, *valid = s.valid.data() + size_t(y) * width;
                if (to.solid) warp_row<true>(to, c.map, w, y, width, other, valid);
                else warp_row<false>(to, c.map, w, y, width, other, valid);
            }
            correlate(s.other.data(), height, width, s);
        }
        record(plane, int(r.others.size()), r.apart, n, s);
    }
    for (size_t i = 0; i < n; ++i) {
        // The top of the parabola through the best plane's score and its two neighbours'.
        const float bend = s.before[i] - 2.0f * s.best[i] + s.after[i];
        const bool between = s.at[i] > 0 && s.at[i] < planes - 1 && s.before[i] > -1.0f && s.after[i] > -1.0f && bend < 0.0f;
        const float shift = between ? std::min(std::max(0.5f * (s.before[i] - s.after[i]) / bend, -0.5f), 0.5f) : 0.0f;
        r.inverse_depth[i] = first + step * (float(s.at[i]) + shift);
        r.score[i] = s.at[i] < 0 || (picture.solid && picture.solid[i] == 0.0f) ? -1.0f : s.best[i];
        r.rival[i] = s.rival[i];
    }
}

using Sweep = void (*)(const std::vector<Picture>&, const Reference&, int, float, float, Workspace&);

void sweep_baseline(const std::vector<Picture>& p, const Reference& r, int n, float first, float step, Workspace& s) {
    sweep_body(p, r, n, first, step, s);
}
#ifdef NERFVOL_CLONES
NERFVOL_AVX2 void sweep_avx2(const std::vector<Picture>& p, const Reference& r, int n, float first, float step, Workspace& s) {
    sweep_body(p, r, n, first, step, s);
}
NERFVOL_AVX512 void sweep_avx512(const std::vector<Picture>& p, const Reference& r, int n, float first, float step, Workspace& s) {
    sweep_body(p, r, n, first, step, s);
}
#endif

Sweep chosen() {
#ifdef NERFVOL_CLONES
    return choose_clone<Sweep>(sweep_baseline, sweep_avx2, sweep_avx512);
#else
    return sweep_baseline;
#endif
}

}  // namespace

void plane_sweep(const std::vector<Grey>& pictures, const std::vector<Reference>& references, int n, float first, float step) {
    const int threads = get_threads();
    std::vector<Workspace> spaces(static_cast<size_t>(threads));
    const Sweep sweep = chosen();
    std::vector<std::vector<float>> masks(pictures.size());
    std::vector<Picture> solid;
    for (size_t i = 0; i < pictures.size(); ++i) {
        const Grey& p = pictures[i];
        if (p.mask) masks[i].assign(p.mask, p.mask + size_t(p.height) * p.width);
        solid.push_back({p.grey, p.mask ? masks[i].data() : nullptr, p.height, p.width});
    }
    parallel_for(int(references.size()), [&](int i, int thread) {
        sweep(solid, references[size_t(i)], n, first, step, spaces[size_t(thread)]);
    });
}

}  // namespace nerfvol
