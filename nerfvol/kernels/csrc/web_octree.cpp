// An octree in a page: from its compact file's planes to what render.h draws. One instance of the module holds one.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "prefilter.h"
#include "render.h"
#include "topology.h"
#include "web.h"

using namespace NERFVOL_ISA;
using namespace nerfvol;

namespace {

struct {
    std::vector<int32_t> first_node, first_leaf, corners;
    std::vector<uint64_t> codes;           // of kGroup channels that were read last: kGroup int16 a vertex
    Prefiltered nodes;
    RowNumber* values = nullptr;           // one row more than there are vertices, an empty one; until octree_rows a vertex's codes
    Tree tree{};
    struct Hidden {
        int32_t* at;
        int32_t corners[8];
    };
    std::vector<Hidden> hidden;            // what a crop box hides, and the corners it had
} octree;

constexpr int kDensity = 12, kGroup = 4;
constexpr float kEmpty = -80;              // raw density that stops nothing

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

// Calls leaf(number, depth, place) and node(number, depth, place) for all below the root, breadth first; a place (3) counts cells of
// that depth. False where it is deeper than kMaxLevel.
template <class Leaf, class Node> bool walk(const Leaf& leaf, const Node& node) {
    const Tree& t = octree.tree;
    std::vector<int32_t> above = {0, 0, 0}, below;
    int32_t leaves = 0, nodes = 1;
    int depth = 0;
    for (int64_t start = 0, end = 1; start < t.n_nodes; start = end, end += int64_t(below.size()) / 3, above.swap(below)) {
        if (++depth > kMaxLevel) return false;
        below.clear();
        for (int64_t at = start; at < end; ++at)
            for (int o = 0; o < 8; ++o) {
                const int32_t* p = above.data() + 3 * (at - start);
                const int32_t child[3] = {2 * p[0] + (o >> 2 & 1), 2 * p[1] + (o >> 1 & 1), 2 * p[2] + (o & 1)};
                if (t.node_mask[at] >> o & 1) {
                    below.insert(below.end(), child, child + 3);
                    node(nodes++, depth, child);
                }
                if (t.leaf_mask[at] >> o & 1) leaf(leaves++, depth, child);
            }
    }
    return true;
}

// Places the leaves and numbers their corners; 0, or the number of what is wrong.
int number_leaves() {
    const int64_t leaves = octree.tree.n_leaves;
    std::vector<int8_t> level(static_cast<size_t>(leaves));
    std::vector<int32_t> ijk(size_t(3 * leaves));
    int deepest = 0;
    const bool fits = walk([&](int32_t leaf, int depth, const int32_t* place) {
        level[size_t(leaf)] = int8_t(deepest = depth);
        std::copy_n(place, 3, ijk.data() + 3 * int64_t(leaf));
    }, [](int32_t, int, const int32_t*) {});
    if (!fits) return 3;
    return number_corners(level.data(), ijk.data(), leaves, deepest, octree.corners.data()) == octree.tree.n_vertices ? 0 : 4;
}

// Where coefficient k of channel c lies in a vertex row: nerfvol/octree/rows.py.
int slot(int degree, int k, int c) { return degree == 2 && k == 8 ? 28 + c : 16 * (k / 4) + 4 * c + k % 4; }

// From the codes in their places, in calls of some rows, as number_corners.
__attribute__((noinline)) void fill_rows(int64_t from, int64_t to, float density_step, float softness, float sh_step) {
    const Tree& t = octree.tree;
    const int64_t row = 16 * t.blocks;
    const int basis = (t.sh_degree + 1) * (t.sh_degree + 1);
    int slots[16][3];
    for (int k = 0; k < basis; ++k)
        for (int c = 0; c < 3; ++c) slots[k][c] = slot(t.sh_degree, k, c);
    for (int64_t v = from; v < to; ++v) {
        RowNumber* at = octree.values + row * v;
        int16_t code[64];
        std::memcpy(code, at, size_t(2 * row));
        std::fill_n(at, row, RowNumber(0));
        at[kDensity] = softness * std::sinh(std::clamp(float(code[0]) * density_step, -80.0f, 80.0f));
        for (int k = 0; k < basis; ++k) {
            const float grey = float(code[1 + k]) * sh_step, red_blue = float(code[1 + basis + k]) * sh_step;
            const float green = float(code[1 + 2 * basis + k]) * sh_step;
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

constexpr float kSmall = 1.0f / 64;            // as nerfvol/views.py has it

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
        render_packet<B>(octree.tree, p, options, out, {row * 16 * width + column * 16, width, height - row * 16, width - column * 16},
                         kSmall);
    }
}

}  // namespace

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
    const int64_t numbers = 16 * t.blocks * t.n_vertices;
    t.values = octree.values = lines<RowNumber>(numbers + 16 * t.blocks);
    std::fill_n(octree.values, numbers + 16 * t.blocks, RowNumber(0));
    octree.values[numbers + kDensity] = kEmpty;
    return 0;
}

// Channel 0 is density, 1 + axis * K + k a colour, the last is the one before `channels`; the planes hold one byte a vertex. Codes
// wait in the vertices' own rows, which are as short: there they go some channels at a time, since a row is a cache line.
NERFVOL_WEB(octree_channel)
void octree_channel(int channel, int channels, const uint8_t* low, const uint8_t* high, int differences) {
    static_assert(sizeof(RowNumber) == sizeof(int16_t), "a row of codes is a row of numbers");
    const int64_t n = octree.tree.n_vertices, row = 16 * octree.tree.blocks;
    octree.codes.resize(size_t(n));
    const int place = channel % kGroup;
    int16_t* const to = reinterpret_cast<int16_t*>(octree.codes.data()) + place;
    unpack_codes(low, high, n, differences != 0, [to](int64_t i, int32_t code) { to[kGroup * i] = int16_t(code); });
    if (place + 1 < kGroup && channel + 1 < channels) return;
    RowNumber* const at = octree.values + channel - place;
    for (int64_t v = 0; v < n; ++v) std::memcpy(at + row * v, &octree.codes[size_t(v)], kGroup * sizeof(int16_t));
}

// The vertices' rows from the codes.
NERFVOL_WEB(octree_rows) void octree_rows(float density_step, float softness, float sh_step) {
    constexpr int64_t kFew = 4096;
    for (int64_t v = 0; v < octree.tree.n_vertices; v += kFew)
        fill_rows(v, std::min(v + kFew, octree.tree.n_vertices), density_step, softness, sh_step);
    octree.codes = {};
}

// What takes long can be made by one instance and taken by others: corners here, values by octree_channel, nodes at last.
NERFVOL_WEB(octree_corners) int octree_corners() {
    return number_leaves();
}

NERFVOL_WEB(octree_nodes) void octree_nodes() {
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
    const size_t row = 16 * size_t(t.blocks) * sizeof(RowNumber);
    const size_t bytes[4] = {32 * size_t(t.n_leaves), row * size_t(t.n_vertices), 32 * size_t(t.n_nodes), sizeof(RowNumber) * octree.nodes.values.size()};
    return uint32_t(bytes[part]);
}

// From now on nodes are drawn in place of their leaves where they are small.
NERFVOL_WEB(octree_finish) void octree_finish() {
    const size_t numbers = octree.nodes.values.size();
    octree.nodes.values.resize(numbers + 16 * size_t(octree.tree.blocks));  // an empty row
    octree.nodes.values[numbers + kDensity] = kEmpty;
    octree.tree.node_corners = octree.nodes.corners.data();
    octree.tree.node_values = octree.nodes.values.data();
}

// Draws only leaves whose middle lies in the box of corners low and high, scene units, and nodes that reach into it: as
// nerfvol export --crop.
NERFVOL_WEB(octree_crop) void octree_crop(float x0, float y0, float z0, float x1, float y1, float z1) {
    const Tree& t = octree.tree;
    for (const auto& one : octree.hidden) std::copy_n(one.corners, 8, one.at);
    octree.hidden.clear();
    const float low[3] = {x0, y0, z0}, high[3] = {x1, y1, z1};
    const auto hide = [](int32_t* at, int64_t empty) {
        octree.hidden.push_back({at, {}});
        std::copy_n(at, 8, octree.hidden.back().corners);
        std::fill_n(at, 8, int32_t(empty));
    };
    // Whether a cell from `margin` inside its faces on is outside the box.
    const auto outside = [&](int depth, const int32_t* place, float margin) {
        const float side = t.size / float(1 << depth);
        bool out = false;
        for (int k = 0; k < 3; ++k) {
            const float from = t.origin[k] + side * (float(place[k]) + margin), to = t.origin[k] + side * (float(place[k]) + 1 - margin);
            out |= to < low[k] || from > high[k];
        }
        return out;
    };
    const int64_t empty_node = int64_t(octree.nodes.values.size()) / (16 * t.blocks) - 1;
    walk([&](int32_t leaf, int depth, const int32_t* place) {
        if (outside(depth, place, 0.5f)) hide(octree.corners.data() + 8 * int64_t(leaf), t.n_vertices);
    }, [&](int32_t node, int depth, const int32_t* place) {
        if (t.node_corners && outside(depth, place, 0.0f)) hide(octree.nodes.corners.data() + 8 * int64_t(node), empty_node);
    });
}

// ------------------------------------------------------------------ drawing
void nerfvol::draw_octree(int row) {
    octree.tree.coarse = octree.tree.node_values ? float(view.coarse) : 0.0f;
    RenderOptions options;
    for (int k = 0; k < 3; ++k) options.background[k] = float(view.background[k]);
    options.early_stop_eps = float(view.early_stop_eps);
    const RenderOutput out{data(picture.rgb), data(picture.trans), data(picture.depth), data(picture.median), data(picture.normal)};
    if (octree.tree.blocks == 1) draw_squares<1>(row, options, out);
    else if (octree.tree.blocks == 2) draw_squares<2>(row, options, out);
    else draw_squares<4>(row, options, out);
}
