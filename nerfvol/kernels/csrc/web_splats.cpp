// Splats in a page: from their compact file's planes to what splat_render.h draws. One instance of the module holds one set.
#include <algorithm>
#include <cmath>

#include "splat_render.h"
#include "web.h"

using namespace NERFVOL_ISA;
using namespace nerfvol;

namespace {

struct {
    float* params = nullptr;
    Splats splats{};
    double origin[3], near, low[3], high[3];
    SplatView view{};
    std::vector<float> logits;             // as they were before a crop box
} gaussians;

SplatView splat_view() {
    SplatView v{};
    double eye[3], depth = 1e300;
    for (int k = 0; k < 3; ++k) eye[k] = view.position[k] - gaussians.origin[k];
    for (int i = 0; i < 3; ++i) {          // rows: the camera's axes, x right, y down, z forward
        double t = 0;
        for (int k = 0; k < 3; ++k) {
            const double r = view.rotation[3 * k + i] * (i == 0 ? 1 : -1);
            v.rotation[3 * i + k] = float(r);
            t -= r * eye[k];
        }
        v.translation[i] = float(t);
        v.eye[i] = float(eye[i]);
    }
    for (int corner = 0; corner < 8; ++corner) {
        double z = v.translation[2];
        for (int k = 0; k < 3; ++k) z += v.rotation[6 + k] * (corner >> k & 1 ? gaussians.high[k] : gaussians.low[k]);
        depth = std::min(depth, z);
    }
    v.fx = float(view.fx);
    v.fy = float(view.fy);
    v.cx = float(view.cx);
    v.cy = float(view.cy);
    v.near = float(std::max(gaussians.near, 0.99 * depth));
    v.width = int64_t(view.width);
    v.height = int64_t(view.height);
    return v;
}

// Of what was projected, keeps what reaches into rows [top, bottom) of pixels.
void keep_band(Frame& f, float top, float bottom) {
    f.visible = 0;
    for (size_t c = 0; c < f.chunk_counts.size(); ++c) {
        uint64_t* const from = f.keys.data() + 16 * size_t(kChunk) * c;
        uint64_t* to = from;
        for (int64_t i = 0; i < f.chunk_counts[c]; ++i) {
            const Record& g = f.projected[uint32_t(from[i])];
            if (g.y + g.half_height + 1 > top && g.y - g.half_height - 1 < bottom) *to++ = from[i];
        }
        f.chunk_counts[c] = to - from;
        f.visible += f.chunk_counts[c];
    }
}

bool with_extras() { return !picture.depth.empty() || !picture.median.empty() || !picture.normal.empty(); }

}  // namespace

NERFVOL_WEB(splats_open) void splats_open(int32_t n, int basis, int mip, double x, double y, double z, double near) {
    const int64_t blocks = (n + 15) / 16, rows = kSh + 3 * basis;
    gaussians.params = lines<float>(std::max<int64_t>(blocks * rows * 16, 1));
    std::fill_n(gaussians.params, blocks * rows * 16, 0.0f);
    gaussians.splats = {gaussians.params, blocks, n, basis, mip != 0};
    gaussians.origin[0] = x;
    gaussians.origin[1] = y;
    gaussians.origin[2] = z;
    gaussians.near = near;
}

// Adds factor * code, or offset times 2^shift codes, to row `to` of the parameters: see nerfvol/splats/codec.py.
NERFVOL_WEB(splats_channel)
void splats_channel(int to, const uint8_t* low, const uint8_t* high, int differences, float factor) {
    const int64_t rows = gaussians.splats.rows();
    float* const params = gaussians.params + 16 * to;
    unpack_codes(low, high, gaussians.splats.n, differences != 0,
                 [=](int64_t i, int32_t code) { params[i / 16 * rows * 16 + i % 16] += float(code) * factor; });
}

// From what the channels hold to what the kernels take: means from their curve, rotations from rotation vectors (in the
// quaternion's last three rows), colours from grey and two differences.
NERFVOL_WEB(splats_finish) void splats_finish(float x, float y, float z, float scale) {
    const Splats& s = gaussians.splats;
    const int64_t rows = s.rows();
    const float middle[3] = {x, y, z};
    for (int k = 0; k < 3; ++k) { gaussians.low[k] = 1e300; gaussians.high[k] = -1e300; }
    for (int64_t i = 0; i < 16 * s.n_blocks; ++i) {
        float* p = gaussians.params + i / 16 * rows * 16 + i % 16;
        const auto at = [p](int row) -> float& { return p[16 * row]; };
        if (i >= s.n) {
            at(kQuat) = 1;
            at(kLogit) = -60;              // packing.UNSEEN
            continue;
        }
        for (int k = 0; k < 3; ++k) {
            at(kMean + k) = middle[k] + scale * std::sinh(at(kMean + k));
            gaussians.low[k] = std::min(gaussians.low[k], double(at(kMean + k)));
            gaussians.high[k] = std::max(gaussians.high[k], double(at(kMean + k)));
        }
        const float r[3] = {at(kQuat + 1), at(kQuat + 2), at(kQuat + 3)}, angle = std::sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2]);
        const float sine = angle > 1e-6f ? std::sin(angle / 2) / angle : 0.5f;
        at(kQuat) = std::cos(angle / 2);
        for (int k = 0; k < 3; ++k) at(kQuat + 1 + k) = r[k] * sine;
        for (int b = 0; b < s.basis; ++b) {
            float c[3];
            for (int k = 0; k < 3; ++k) c[k] = at(kSh + s.basis * k + b);
            for (int k = 0; k < 3; ++k) at(kSh + s.basis * k + b) = kFromGrey[0][k] * c[0] + kFromGrey[1][k] * c[1] + kFromGrey[2][k] * c[2];
        }
    }
}

// Draws only splats whose mean lies in the box of corners low and high, scene units.
NERFVOL_WEB(splats_crop) void splats_crop(float x0, float y0, float z0, float x1, float y1, float z1) {
    const Splats& s = gaussians.splats;
    const float low[3] = {x0, y0, z0}, high[3] = {x1, y1, z1};
    const bool first = gaussians.logits.empty();
    if (first) gaussians.logits.resize(size_t(s.n));
    for (int64_t i = 0; i < s.n; ++i) {
        float* const p = gaussians.params + i / 16 * s.rows() * 16 + i % 16;
        float& kept = gaussians.logits[size_t(i)];
        if (first) kept = p[16 * kLogit];
        bool inside = true;
        for (int k = 0; k < 3; ++k) {
            const float x = p[16 * (kMean + k)] + float(gaussians.origin[k]);
            inside &= x >= low[k] && x <= high[k];
        }
        p[16 * kLogit] = inside ? kept : -60.0f;
    }
}

// ------------------------------------------------------------------ drawing
bool nerfvol::splats_are_open() { return gaussians.params != nullptr; }

// Projects and sorts what rows [first, last) need.
void nerfvol::prepare_splats(int first, int last) {
    gaussians.view = splat_view();
    Frame& f = shared_frame();
    const bool extras = with_extras();
    switch (gaussians.splats.basis) {
        case 1: project_all<1>(gaussians.splats, gaussians.view, f, extras); break;
        case 4: project_all<4>(gaussians.splats, gaussians.view, f, extras); break;
        case 9: project_all<9>(gaussians.splats, gaussians.view, f, extras); break;
        default: project_all<16>(gaussians.splats, gaussians.view, f, extras); break;
    }
    keep_band(f, 16.0f * float(first), 16.0f * float(last));
    sort_by_depth(f);
    make_lists(f, TileGrid(gaussians.view), 16 * gaussians.splats.n_blocks);
}

void nerfvol::draw_splats(int row) {
    SplatRenderOptions options{{}, float(view.early_stop_eps)};
    for (int k = 0; k < 3; ++k) options.background[k] = float(view.background[k]);
    const SplatOutput out{data(picture.rgb), data(picture.trans), data(picture.depth), data(picture.median), data(picture.normal)};
    const TileGrid grid(gaussians.view);
    for (int64_t tile = int64_t(row) * grid.columns; tile < int64_t(row + 1) * grid.columns; ++tile) {
        if (with_extras()) render_tile<true>(shared_frame(), gaussians.view, tile, options, out);
        else render_tile<false>(shared_frame(), gaussians.view, tile, options, out);
    }
    const size_t from = size_t(16 * row) * size_t(view.width), to = std::min(from + 16 * size_t(view.width), picture.trans.size());
    for (size_t i = from; i < to; ++i) picture.trans[i] = 1 - picture.trans[i];
}
