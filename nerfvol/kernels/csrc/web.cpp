// The kernels in a page: the operators of kernels.cpp and splat_kernels.cpp behind C functions, for WebAssembly. Made by
// tools/web_kernels.py. Only functions marked NERFVOL_WEB leave the module; memory is what the page asks of `reserve`.
#include "web.h"

#include <algorithm>
#include <cmath>
#include <new>

#include "prefilter.h"
#include "render.h"
#include "splat_render.h"
#include "topology.h"

#define NERFVOL_WEB(name) extern "C" __attribute__((export_name(#name)))

using namespace NERFVOL_ISA;
using namespace nerfvol;

namespace nerfvol {
const float kFromGrey[3][3] = {{0.57735027f, 0.57735027f, 0.57735027f},
                               {0.70710678f, 0.0f, -0.70710678f},
                               {0.40824829f, -0.81649658f, 0.40824829f}};

void unpack_codes(const uint8_t* low, const uint8_t* high, int64_t n, bool differences, int32_t* codes) {
    int32_t sum = 0;
    for (int64_t i = 0; i < n; ++i) {
        const uint32_t zigzag = low[i] | uint32_t(high[i]) << 8;
        const int32_t code = int32_t(zigzag >> 1) ^ -int32_t(zigzag & 1);
        sum = differences ? int32_t(uint32_t(sum) + uint32_t(code)) : code;
        codes[i] = sum;
    }
}
}  // namespace nerfvol

namespace {

template <class T> T* lines(int64_t n) { return static_cast<T*>(::operator new[](size_t(n) * sizeof(T) + 64, std::align_val_t{64})); }

WebView view;
WebPicture picture;
std::vector<uint8_t> pixels;
std::vector<int32_t> codes;

// ------------------------------------------------------------------ the octree
struct {
    std::vector<int32_t> first_node, first_leaf, corners;
    std::vector<int16_t> codes;            // of the channels, one after the other
    Prefiltered nodes;
    float* values = nullptr;
    Tree tree{};
} octree;

constexpr int kDensity = 12;

// Masks to first children; 0, or the number of what is wrong (engine.js has the sentences).
int find_children(const uint8_t* node_mask, const uint8_t* leaf_mask, int64_t n) {
    octree.first_node.resize(size_t(n));
    octree.first_leaf.resize(size_t(n));
    int64_t nodes = 1, leaves = 0;
    for (int64_t i = 0; i < n; ++i) {
        if (node_mask[i] & leaf_mask[i]) return 1;
        octree.first_node[size_t(i)] = int32_t(nodes);
        octree.first_leaf[size_t(i)] = int32_t(leaves);
        nodes += __builtin_popcount(node_mask[i]);
        leaves += __builtin_popcount(leaf_mask[i]);
        if (nodes > n || (nodes == i + 1 && i + 1 < n)) return 2;  // more links than nodes, or nodes that hang on nothing
    }
    if (nodes != n || !leaves) return 2;
    octree.tree.n_leaves = leaves;
    return 0;
}

// Places the leaves and numbers their corners; 0, or the number of what is wrong.
int number_leaves(const uint8_t* node_mask, const uint8_t* leaf_mask, int64_t n) {
    const int64_t leaves = octree.tree.n_leaves;
    std::vector<int8_t> level(static_cast<size_t>(leaves));
    std::vector<int32_t> ijk(size_t(3 * leaves)), above = {0, 0, 0}, below;
    int64_t leaf = 0;
    int depth = 0;
    for (int64_t start = 0, end = 1; start < n; start = end, end += int64_t(below.size()) / 3, above.swap(below)) {
        if (++depth > kMaxLevel) return 3;
        below.clear();
        for (int64_t node = start; node < end; ++node)
            for (int o = 0; o < 8; ++o) {
                const int32_t* p = above.data() + 3 * (node - start);
                const int32_t child[3] = {2 * p[0] + (o >> 2 & 1), 2 * p[1] + (o >> 1 & 1), 2 * p[2] + (o & 1)};
                if (node_mask[node] >> o & 1) below.insert(below.end(), child, child + 3);
                if (!(leaf_mask[node] >> o & 1)) continue;
                level[size_t(leaf)] = int8_t(depth);
                std::copy_n(child, 3, ijk.data() + 3 * leaf++);
            }
    }
    return number_corners(level.data(), ijk.data(), leaves, depth, octree.corners.data()) == octree.tree.n_vertices ? 0 : 4;
}

// Where coefficient k of channel c lies in a vertex row: nerfvol/octree/rows.py.
int slot(int degree, int k, int c) { return degree == 2 && k == 8 ? 28 + c : 16 * (k / 4) + 4 * c + k % 4; }

// In calls of some rows, as number_corners.
__attribute__((noinline)) void fill_rows(int64_t from, int64_t to, float density_step, float softness, float sh_step) {
    const Tree& t = octree.tree;
    const int64_t row = 16 * t.blocks, n = t.n_vertices;
    const int basis = (t.sh_degree + 1) * (t.sh_degree + 1);
    int slots[16][3];
    for (int k = 0; k < basis; ++k)
        for (int c = 0; c < 3; ++c) slots[k][c] = slot(t.sh_degree, k, c);
    for (int64_t v = from; v < to; ++v) {
        float* at = octree.values + row * v;
        const int16_t* code = octree.codes.data() + v;
        at[kDensity] = softness * std::sinh(std::clamp(float(*code) * density_step, -80.0f, 80.0f));
        for (int k = 0; k < basis; ++k) {
            const float grey = float(code[n * (1 + k)]) * sh_step, red_blue = float(code[n * (1 + basis + k)]) * sh_step;
            const float green = float(code[n * (1 + 2 * basis + k)]) * sh_step;
            for (int c = 0; c < 3; ++c) at[slots[k][c]] = kFromGrey[0][c] * grey + kFromGrey[1][c] * red_blue + kFromGrey[2][c] * green;
        }
    }
}

// Unit directions of a square's pixels, as View has them; beyond the picture the last row and column are repeated.
void square_directions(int64_t row, int64_t column, float* out) {
    for (int s = 0; s < 4; ++s)
        for (int l = 0; l < kTile; ++l) {
            const double i = std::min<double>(double(16 * column + column_of<4>(l)), view.width - 1) + 0.5;
            const double j = std::min<double>(double(16 * row + row_of<4>(s, l)), view.height - 1) + 0.5;
            const double x = (i - view.cx) / view.fx, y = -(j - view.cy) / view.fy, length = std::sqrt(x * x + y * y + 1);
            float* at = out + s * 3 * kTile + l;
            at[0] = float(x / length);
            at[kTile] = float(y / length);
            at[2 * kTile] = float(-1 / length);
        }
}

template <int B> void draw_squares(int64_t row, const RenderOptions& options, const RenderOutput& out) {
    alignas(64) float directions[4 * 3 * kTile];
    View square{directions, 1, 1, 0, 0, {}, {}};
    for (int k = 0; k < 9; ++k) square.rotation[k] = float(view.rotation[k]);
    for (int k = 0; k < 3; ++k) square.origin[k] = float(view.position[k]);
    const int64_t width = int64_t(view.width), height = int64_t(view.height);
    Packet<4> p;
    for (int64_t column = 0; column < (width + 15) / 16; ++column) {
        square_directions(row, column, directions);
        load_square(octree.tree, square, 0, 0, p);
        render_packet<B>(octree.tree, p, options, out, {row * 16 * width + column * 16, width, height - row * 16, width - column * 16});
    }
}

// ------------------------------------------------------------------ the splats
struct {
    float* params = nullptr;
    Splats splats{};
    double origin[3], near, low[3], high[3];
    SplatView view{};
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

float* data(std::vector<float>& v) { return v.empty() ? nullptr : v.data(); }

}  // namespace

NERFVOL_WEB(reserve) void* web_reserve(uint32_t bytes) { return ::operator new[](bytes, std::align_val_t{64}); }
NERFVOL_WEB(release) void web_release(void* p) { ::operator delete[](p, std::align_val_t{64}); }

NERFVOL_WEB(inflate) int web_inflate(const uint8_t* from, int32_t n_from, uint8_t* to, int32_t n) { return nerfvol::inflate(from, n_from, to, n); }

// ------------------------------------------------------------------ opening an octree
NERFVOL_WEB(octree_open)
int octree_open(const uint8_t* node_mask, const uint8_t* leaf_mask, int32_t n_nodes, int32_t n_vertices, int degree, float x,
                float y, float z, float size, float density_scale) {
    if (const int fault = find_children(node_mask, leaf_mask, n_nodes)) return fault;
    Tree& t = octree.tree;
    if (n_vertices <= t.n_leaves || n_vertices > 8 * t.n_leaves) return 4;
    t.n_vertices = n_vertices;
    octree.corners.resize(size_t(8 * t.n_leaves));
    t.node_mask = node_mask;
    t.leaf_mask = leaf_mask;
    t.n_nodes = n_nodes;
    t.first_node = octree.first_node.data();
    t.first_leaf = octree.first_leaf.data();
    t.corners = octree.corners.data();
    t.sh_degree = degree;
    t.blocks = degree == 3 ? 4 : degree == 2 ? 2 : 1;
    t.origin[0] = x;
    t.origin[1] = y;
    t.origin[2] = z;
    t.size = size;
    t.density_scale = density_scale;
    t.values = octree.values = lines<float>(16 * t.blocks * t.n_vertices);
    std::fill_n(octree.values, 16 * t.blocks * t.n_vertices, 0.0f);
    codes.resize(size_t(n_vertices));
    return 0;
}

// Channel 0 is density, 1 + axis * K + k a colour; the planes hold one byte a vertex.
NERFVOL_WEB(octree_channel)
void octree_channel(int channel, const uint8_t* low, const uint8_t* high, int differences) {
    const int64_t n = octree.tree.n_vertices;
    unpack_codes(low, high, n, differences != 0, codes.data());
    octree.codes.resize(size_t(channel + 1) * size_t(n));
    std::copy_n(codes.data(), n, octree.codes.data() + channel * n);
}

// The vertices' rows from the channels, a row at a time: each is a cache line or some.
NERFVOL_WEB(octree_rows) void octree_rows(float density_step, float softness, float sh_step) {
    constexpr int64_t kFew = 4096;
    for (int64_t v = 0; v < octree.tree.n_vertices; v += kFew)
        fill_rows(v, std::min(v + kFew, octree.tree.n_vertices), density_step, softness, sh_step);
    octree.codes = {};
}

// What takes long can be made by one instance and taken by others: corners here, values by octree_channel, nodes at last.
NERFVOL_WEB(octree_corners) int octree_corners() {
    return number_leaves(octree.tree.node_mask, octree.tree.leaf_mask, octree.tree.n_nodes);
}

NERFVOL_WEB(octree_nodes) void octree_nodes() {
    codes = {};
    octree.nodes = prefilter(octree.tree);
}

// The parts: 0 corners, 1 values, 2 and 3 the nodes' corners and values. `rows`: makes room for so many of part 3 first.
NERFVOL_WEB(octree_part) void* octree_part(int part, int rows) {
    if (rows > 0) octree.nodes.values.resize(size_t(rows) * 16 * size_t(octree.tree.blocks));
    if (part == 0) return octree.corners.data();
    if (part == 1) return octree.values;
    if (octree.nodes.corners.empty()) octree.nodes.corners.resize(size_t(8 * octree.tree.n_nodes));
    return part == 2 ? static_cast<void*>(octree.nodes.corners.data()) : octree.nodes.values.data();
}

NERFVOL_WEB(octree_part_bytes) uint32_t octree_part_bytes(int part) {
    const Tree& t = octree.tree;
    const size_t bytes[4] = {32 * size_t(t.n_leaves), 64 * size_t(t.blocks) * size_t(t.n_vertices), 32 * size_t(t.n_nodes), 4 * octree.nodes.values.size()};
    return uint32_t(bytes[part]);
}

// From now on nodes are drawn in place of their leaves where they are small.
NERFVOL_WEB(octree_finish) void octree_finish() {
    codes = {};
    octree.tree.node_corners = octree.nodes.corners.data();
    octree.tree.node_values = octree.nodes.values.data();
}

// ------------------------------------------------------------------ opening splats
NERFVOL_WEB(splats_open) void splats_open(int32_t n, int basis, int mip, double x, double y, double z, double near) {
    const int64_t blocks = (n + 15) / 16, rows = kSh + 3 * basis;
    gaussians.params = lines<float>(std::max<int64_t>(blocks * rows * 16, 1));
    std::fill_n(gaussians.params, blocks * rows * 16, 0.0f);
    gaussians.splats = {gaussians.params, blocks, n, basis, mip != 0};
    gaussians.origin[0] = x;
    gaussians.origin[1] = y;
    gaussians.origin[2] = z;
    gaussians.near = near;
    codes.resize(size_t(n));
}

// Adds factor * code, or offset times 2^shift codes, to row `to` of the parameters: see nerfvol/splats/codec.py.
NERFVOL_WEB(splats_channel)
void splats_channel(int to, const uint8_t* low, const uint8_t* high, int differences, float factor) {
    const int64_t rows = gaussians.splats.rows();
    unpack_codes(low, high, gaussians.splats.n, differences != 0, codes.data());
    for (int64_t i = 0; i < gaussians.splats.n; ++i)
        gaussians.params[(i / 16 * rows + to) * 16 + i % 16] += float(codes[size_t(i)]) * factor;
}

// From what the channels hold to what the kernels take: means from their curve, rotations from rotation vectors (in the
// quaternion's last three rows), colours from grey and two differences.
NERFVOL_WEB(splats_finish) void splats_finish(float x, float y, float z, float scale) {
    const Splats& s = gaussians.splats;
    const int64_t rows = s.rows();
    const float middle[3] = {x, y, z};
    codes = {};
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
        const float r[3] = {at(kQuat + 1), at(kQuat + 2), at(kQuat + 3)}, angle = std::sqrt(dot3(r, r));
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

// ------------------------------------------------------------------ drawing
NERFVOL_WEB(view) WebView* web_view() { return &view; }

// Begins the view that was written to `view`.
NERFVOL_WEB(begin) void web_begin() {
    const size_t n = size_t(view.width) * size_t(view.height);
    const int wanted = int(view.wanted);
    picture.rgb.resize(3 * n);
    picture.trans.resize(n);
    picture.depth.resize(wanted & kWantDepth ? n : 0);
    picture.median.resize(wanted & kWantMedian ? n : 0);
    picture.normal.resize(wanted & kWantNormal ? 3 * n : 0);
    pixels.resize(4 * n);
    octree.tree.coarse = octree.tree.node_values ? float(view.coarse) : 0.0f;
}

// Of splats: projects and sorts what rows [first, last) of 16 pixels need. To be called before `draw` draws them.
NERFVOL_WEB(prepare) void web_prepare(int first, int last) {
    if (!gaussians.params) return;
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
    make_lists(f, TileGrid(gaussians.view));
}

// Draws one row of 16 pixels' height.
NERFVOL_WEB(draw) void web_draw(int row) {
    const float background[3] = {float(view.background[0]), float(view.background[1]), float(view.background[2])};
    const float eps = float(view.early_stop_eps);
    if (gaussians.params) {
        const SplatRenderOptions options{{background[0], background[1], background[2]}, eps};
        const SplatOutput out{data(picture.rgb), data(picture.trans), data(picture.depth), data(picture.median), data(picture.normal)};
        const TileGrid grid(gaussians.view);
        for (int64_t tile = int64_t(row) * grid.columns; tile < int64_t(row + 1) * grid.columns; ++tile) {
            if (with_extras()) render_tile<true>(shared_frame(), gaussians.view, tile, options, out);
            else render_tile<false>(shared_frame(), gaussians.view, tile, options, out);
        }
        const size_t from = size_t(16 * row) * size_t(view.width), to = std::min(from + 16 * size_t(view.width), picture.trans.size());
        for (size_t i = from; i < to; ++i) picture.trans[i] = 1 - picture.trans[i];
        return;
    }
    RenderOptions options;
    std::copy_n(background, 3, options.background);
    options.early_stop_eps = eps;
    const RenderOutput out{data(picture.rgb), data(picture.trans), data(picture.depth), data(picture.median), data(picture.normal)};
    if (octree.tree.blocks == 1) draw_squares<1>(row, options, out);
    else if (octree.tree.blocks == 2) draw_squares<2>(row, options, out);
    else draw_squares<4>(row, options, out);
}

// The float picture of one output: 0 colour, 1 transmittance, 2 depth, 3 median depth, 4 normal.
NERFVOL_WEB(floats) float* web_floats(int output) {
    std::vector<float>* const all[5] = {&picture.rgb, &picture.trans, &picture.depth, &picture.median, &picture.normal};
    return all[output]->data();
}

// RGBA bytes of the whole picture, of which `count` pixels from `first` on are made; output: 0 colour, 1 opacity, 2 depth as light
// between near and far (files/pictures.py, depth_to_grey), 3 normals.
NERFVOL_WEB(shade) uint8_t* web_shade(int output, int first, int count, float near, float far) {
    const auto byte = [](float x) { return uint8_t(std::clamp(x, 0.0f, 1.0f) * 255 + 0.5f); };
    const float span = std::max(far - near, 1e-12f);
    for (int i = first; i < first + count; ++i) {
        const float opacity = 1 - picture.trans[size_t(i)];
        const bool hit = opacity >= 0.5f;
        float c[3] = {opacity, opacity, opacity};
        if (output == 0) {
            std::copy_n(picture.rgb.data() + 3 * i, 3, c);
        } else if (output == 2) {
            const float depth = picture.depth[size_t(i)] / std::max(opacity, 1e-3f);
            c[0] = c[1] = c[2] = hit ? 1 - 0.9f * std::clamp((depth - near) / span, 0.0f, 1.0f) : 0.0f;
        } else if (output == 3) {
            const float* n = picture.normal.data() + 3 * i;
            const float length = std::max(std::sqrt(dot3(n, n)), 1e-6f);
            for (int k = 0; k < 3; ++k) c[k] = hit ? 0.5f * n[k] / length + 0.5f : 0.5f;
        }
        uint8_t* to = pixels.data() + 4 * i;
        for (int k = 0; k < 3; ++k) to[k] = byte(c[k]);
        to[3] = 255;
    }
    return pixels.data();
}
