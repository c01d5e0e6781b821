// Python bindings. Shapes and ranges were checked by nerfvol/kernels/ops.py; types and layouts are checked here.
#include <nanobind/stl/array.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "arena.h"
#include "arrays.h"
#include "batch.h"
#include "pool.h"
#include "prefilter.h"
#include "field_bindings.h"
#include "splat_bindings.h"
#include "topology.h"
#include "tree.h"

void bind_photographs(nanobind::module_& m);  // sweep_bindings.cpp
void bind_distilling(nanobind::module_& m);   // distil_bindings.cpp
void bind_around(nanobind::module_& m);       // around_bindings.cpp
void bind_paths(nanobind::module_& m);        // path_bindings.cpp

namespace nb = nanobind;
using namespace nb::literals;
using namespace nerfvol;

using Rows = In<float, nb::ndim<2>>;
template <class T> using Maybe = std::optional<T>;

namespace {

// Holds the arrays of an octree for as long as the views of them are used.
struct TreeArrays {
    In<uint8_t, nb::ndim<1>> node_mask, leaf_mask;
    In<int32_t, nb::ndim<1>> first_node, first_leaf;
    In<int32_t, nb::shape<-1, 8>> corners;
    Rows values;
    Maybe<In<int32_t, nb::shape<-1, 8>>> node_corners;
    Maybe<Rows> node_values;
    Tree tree;
};

void init_tree(TreeArrays* self, In<uint8_t, nb::ndim<1>> node_mask, In<uint8_t, nb::ndim<1>> leaf_mask,
               In<int32_t, nb::ndim<1>> first_node, In<int32_t, nb::ndim<1>> first_leaf, In<int32_t, nb::shape<-1, 8>> corners,
               Rows values, int sh_degree, std::vector<float> origin, float size, float density_scale,
               Maybe<In<int32_t, nb::shape<-1, 8>>> node_corners, Maybe<Rows> node_values, float coarse) {
    if (coarse > 0 && (!node_corners || !node_values || node_corners->shape(0) != node_mask.shape(0) ||
                       node_values->shape(1) != values.shape(1)))
        throw std::invalid_argument("a level of detail needs prefiltered values for every node");
    auto* t = new (self)
        TreeArrays{node_mask, leaf_mask, first_node, first_leaf, corners, values, node_corners, node_values, {}};
    Tree& v = t->tree;
    v.node_mask = node_mask.data();
    v.leaf_mask = leaf_mask.data();
    v.first_node = first_node.data();
    v.first_leaf = first_leaf.data();
    v.corners = corners.data();
    v.values = values.data();
    v.n_nodes = int64_t(node_mask.shape(0));
    v.n_leaves = int64_t(corners.shape(0));
    v.n_vertices = int64_t(values.shape(0));
    v.blocks = int(values.shape(1) / 16);
    v.sh_degree = sh_degree;
    for (int k = 0; k < 3; ++k) v.origin[k] = origin.at(size_t(k));
    v.size = size;
    v.density_scale = density_scale;
    v.node_corners = pointer(node_corners);
    v.node_values = pointer(node_values);
    v.coarse = coarse;
}

Rays make_rays(const Rows& origins, const Rows& directions) {
    Rays r{origins.data(), directions.data(), int64_t(directions.shape(0)), false};
    r.origin_per_tile = origins.shape(0) != directions.shape(0);
    if (r.origin_per_tile && int64_t(origins.shape(0)) != (r.n + kTile - 1) / kTile)
        throw std::invalid_argument("rays_o must have one row per ray or one per 64 rays");
    return r;
}

RenderOptions make_options(const std::vector<float>& background, float eps) {
    return {{background.at(0), background.at(1), background.at(2)}, eps};
}

using Floats = Out<float, nb::ndim<1>>;
using FloatRows = Out<float, nb::ndim<2>>;

void py_render(const TreeArrays& t, Rows origins, Rows directions, std::vector<float> background, float eps, Maybe<FloatRows> rgb,
               Maybe<Floats> trans, Maybe<Floats> depth, Maybe<Floats> median, Maybe<FloatRows> normal) {
    const Rays rays = make_rays(origins, directions);
    const RenderOptions options = make_options(background, eps);
    const RenderOutput out{pointer(rgb), pointer(trans), pointer(depth), pointer(median), pointer(normal)};
    nb::gil_scoped_release release;
    kernels().render(t.tree, rays, options, out);
}

// Directions of a camera's rays (square rows, square columns, 4, 3, 64); outputs are pictures (height, width[, 3]).
void py_render_view(const TreeArrays& t, In<float, nb::shape<-1, -1, 4, 3, 64>> directions, std::vector<float> rotation,
                    std::vector<float> origin, int64_t height, int64_t width, float small, std::vector<float> background, float eps,
                    Maybe<Out<float, nb::ndim<3>>> rgb, Maybe<FloatRows> trans, Maybe<FloatRows> depth, Maybe<FloatRows> median,
                    Maybe<Out<float, nb::ndim<3>>> normal) {
    View view{directions.data(), int64_t(directions.shape(0)), int64_t(directions.shape(1)), height, width, {}, {}, small};
    const auto covers = [](int64_t squares, int64_t pixels) { return squares * kSquare >= pixels && (squares - 1) * kSquare < pixels; };
    if (!covers(view.square_rows, height) || !covers(view.square_columns, width))
        throw std::invalid_argument("the directions do not cover the picture in squares of 16x16 pixels");
    for (int k = 0; k < 9; ++k) view.rotation[k] = rotation.at(size_t(k));
    for (int k = 0; k < 3; ++k) view.origin[k] = origin.at(size_t(k));
    const auto check = [&](const auto& a) {
        if (a && (int64_t(a->shape(0)) != height || int64_t(a->shape(1)) != width))
            throw std::invalid_argument("an output does not have the picture's size");
    };
    check(rgb); check(trans); check(depth); check(median); check(normal);
    const RenderOptions options = make_options(background, eps);
    const RenderOutput out{pointer(rgb), pointer(trans), pointer(depth), pointer(median), pointer(normal)};
    nb::gil_scoped_release release;
    kernels().render_view(t.tree, view, options, out);
}

void py_render_backward(const TreeArrays& t, Rows origins, Rows directions, std::vector<float> background, float eps,
                        Maybe<Rows> rgb, Maybe<In<float, nb::ndim<1>>> trans, Maybe<In<float, nb::ndim<1>>> depth,
                        FloatRows gradient, Out<int32_t, nb::ndim<1>> slots) {
    const Rays rays = make_rays(origins, directions);
    const RenderOptions options = make_options(background, eps);
    const Cotangents cotangents{pointer(rgb), pointer(trans), pointer(depth)};
    const GradientSink sink{gradient.data(), nullptr, slots.data()};
    nb::gil_scoped_release release;
    kernels().backward(t.tree, rays, options, cotangents, sink);
}

// Holds the arrays of a batch for as long as the views of them are used.
struct BatchArrays {
    Rows origins, directions, target;
    In<float, nb::ndim<1>> weight;

    Rays rays() const { return make_rays(origins, directions); }
    Loss loss(const LossOptions& options) const {
        if (target.shape(0) != directions.shape(0) || weight.shape(0) != directions.shape(0))
            throw std::invalid_argument("target and weight must have one row per ray");
        return {target.data(), weight.data(), options};
    }
};

struct StatisticsArrays {
    Floats max_weight, error, footprint;
    float pixel_angle;

    LeafStatistics of(const TreeArrays& t) const {
        for (const Floats* a : {&max_weight, &error, &footprint})
            if (int64_t(a->shape(0)) != t.tree.n_leaves) throw std::invalid_argument("the statistics do not fit the leaves");
        return {max_weight.data(), error.data(), footprint.data(), pixel_angle};
    }
};

nb::tuple report_of(const StepReport& r) { return nb::make_tuple(r.squared_error, r.weight, r.samples, r.tested); }

// One step of the optimiser, which updates the octree's own values and the moments.
nb::tuple py_train_step(const TreeArrays& t, const BatchArrays& batch, const LossOptions& options, const Rates& rates,
                        FloatRows values, FloatRows moments, Out<int32_t, nb::ndim<1>> slots, const StatisticsArrays& statistics) {
    if (values.data() != t.tree.values) throw std::invalid_argument("the optimiser needs the octree's own values");
    const Rays rays = batch.rays();
    const Loss loss = batch.loss(options);
    const Optimizer optimizer{values.data(), moments.data(), rates};
    const GradientSink sink{nullptr, &optimizer, slots.data()};
    const LeafStatistics out = statistics.of(t);
    StepReport r;
    {
        nb::gil_scoped_release release;
        r = kernels().train_step(t.tree, rays, loss, sink, out);
    }
    return report_of(r);
}

// Adds the loss's gradient to `gradient`; nothing else changes.
nb::tuple py_loss_gradient(const TreeArrays& t, const BatchArrays& batch, const LossOptions& options, FloatRows gradient,
                           Out<int32_t, nb::ndim<1>> slots) {
    const Rays rays = batch.rays();
    const Loss loss = batch.loss(options);
    const GradientSink sink{gradient.data(), nullptr, slots.data()};
    StepReport r;
    {
        nb::gil_scoped_release release;
        r = kernels().train_step(t.tree, rays, loss, sink, LeafStatistics{});
    }
    return report_of(r);
}

// A step that moves nothing: what the rays say of the leaves.
nb::tuple py_leaf_statistics(const TreeArrays& t, const BatchArrays& batch, const LossOptions& options,
                             const StatisticsArrays& statistics) {
    const Rays rays = batch.rays();
    const Loss loss = batch.loss(options);
    const LeafStatistics out = statistics.of(t);
    StepReport r;
    {
        nb::gil_scoped_release release;
        r = kernels().leaf_statistics(t.tree, rays, loss, out);
    }
    return report_of(r);
}

int64_t py_number_corners(In<int8_t, nb::ndim<1>> level, In<int32_t, nb::shape<-1, 3>> ijk, int max_level,
                          Out<int32_t, nb::shape<-1, 8>> ids) {
    nb::gil_scoped_release release;
    return number_corners(level.data(), ijk.data(), int64_t(level.shape(0)), max_level, ids.data());
}

int64_t py_renumber_corners(In<int32_t, nb::shape<-1, 8>> corners, In<int32_t, nb::ndim<1>> kept, int64_t n_vertices,
                            Out<int32_t, nb::shape<-1, 8>> ids) {
    nb::gil_scoped_release release;
    return renumber_corners(corners.data(), kept.data(), int64_t(kept.shape(0)), n_vertices, ids.data());
}

void py_find_sources(In<int32_t, nb::shape<-1, 8>> corners, In<int32_t, nb::ndim<1>> parent, In<int8_t, nb::ndim<1>> octant,
                     Out<int32_t, nb::ndim<1>> source, Out<int8_t, nb::ndim<1>> place) {
    nb::gil_scoped_release release;
    find_sources(corners.data(), parent.data(), octant.data(), int64_t(corners.shape(0)), int64_t(source.shape(0)),
                 source.data(), place.data());
}

void py_interpolate(Rows rows, In<int32_t, nb::shape<-1, 8>> corners, In<int32_t, nb::ndim<1>> source,
                    In<int8_t, nb::ndim<1>> place, FloatRows out) {
    nb::gil_scoped_release release;
    interpolate(rows.data(), int64_t(rows.shape(1)), corners.data(), source.data(), place.data(), int64_t(source.shape(0)),
                out.data());
}

// Corners (n_nodes, 8) and values (rows, row) of prefiltered nodes, arrays that own what they show.
nb::tuple py_prefilter(const TreeArrays& t) {
    auto* const made = new Prefiltered;
    const nb::capsule owner(made, [](void* p) noexcept { delete static_cast<Prefiltered*>(p); });
    {
        nb::gil_scoped_release release;
        *made = prefilter(t.tree);
    }
    const size_t row = 16 * size_t(t.tree.blocks);
    return nb::make_tuple(nb::ndarray<nb::numpy, int32_t>(made->corners.data(), {size_t(t.tree.n_nodes), 8}, owner),
                          nb::ndarray<nb::numpy, float>(made->values.data(), {made->values.size() / row, row}, owner));
}

void py_gather_tiles(const std::vector<In<float, nb::shape<-1, 64, 3>>>& directions,
                     const std::vector<In<uint8_t, nb::shape<-1, 64, 3>>>& pixels, In<float, nb::shape<-1, 3, 3>> rotations,
                     In<int64_t, nb::ndim<1>> image, In<int64_t, nb::ndim<1>> tile, In<int64_t, nb::ndim<1>> row,
                     Out<float, nb::shape<-1, 64, 3>> out, Out<float, nb::shape<-1, 64, 3>> target) {
    TileSources from{{}, {}, rotations.data()};
    for (const auto& a : directions) from.directions.push_back(a.data());
    for (const auto& a : pixels) from.pixels.push_back(a.data());
    const int64_t n = int64_t(image.shape(0)), pictures = int64_t(pixels.size());
    if (int64_t(tile.shape(0)) != n || int64_t(row.shape(0)) != n || int64_t(out.shape(0)) != n || int64_t(target.shape(0)) != n)
        throw std::invalid_argument("image, tile, row and both outputs must have one row for each tile");
    if (int64_t(directions.size()) != pictures || int64_t(rotations.shape(0)) != pictures)
        throw std::invalid_argument("every picture needs directions, pixels and a rotation");
    for (int64_t i = 0; i < n; ++i) {
        const int64_t m = image.data()[i], t = tile.data()[i], r = row.data()[i];
        if (m < 0 || m >= pictures || t < 0 || t >= int64_t(directions[size_t(m)].shape(0)) || r < 0 ||
            r >= int64_t(pixels[size_t(m)].shape(0)))
            throw std::invalid_argument("a tile lies outside its picture");
    }
    nb::gil_scoped_release release;
    gather_tiles(from, image.data(), tile.data(), row.data(), n, out.data(), target.data());
}

// What training takes, by name: a term of the loss is one field here, of tree.h's LossOptions and of Python's.
void bind_training(nb::module_& m) {
    nb::class_<LossOptions>(m, "LossOptions")
        .def(nb::init<>())
        .def_prop_rw(
            "background", [](const LossOptions& o) { return std::array<float, 3>{o.background[0], o.background[1], o.background[2]}; },
            [](LossOptions& o, const std::array<float, 3>& rgb) { std::copy(rgb.begin(), rgb.end(), o.background); })
        .def_rw("early_stop_eps", &LossOptions::early_stop_eps)
        .def_rw("colour", &LossOptions::colour)
        .def_rw("distortion", &LossOptions::distortion)
        .def_rw("sparsity", &LossOptions::sparsity)
        .def_rw("tv_density", &LossOptions::tv_density)
        .def_rw("tv_sh", &LossOptions::tv_sh);
    nb::class_<Rates>(m, "Rates")
        .def(nb::init<>())
        .def_rw("density", &Rates::density)
        .def_rw("dc", &Rates::dc)
        .def_rw("sh", &Rates::sh)
        .def_rw("beta", &Rates::beta)
        .def_rw("eps", &Rates::eps);
    nb::class_<BatchArrays>(m, "Batch").def(
        "__init__", [](BatchArrays* self, Rows o, Rows d, Rows target, In<float, nb::ndim<1>> weight) {
            new (self) BatchArrays{o, d, target, weight};
        },
        nb::kw_only(), "rays_o"_a, "rays_d"_a, "target"_a, "weight"_a);
    nb::class_<StatisticsArrays>(m, "LeafStatistics").def(
        "__init__", [](StatisticsArrays* self, Floats max_weight, Floats error, Floats footprint, float pixel_angle) {
            new (self) StatisticsArrays{max_weight, error, footprint, pixel_angle};
        },
        nb::kw_only(), "max_weight"_a, "error"_a, "footprint"_a, "pixel_angle"_a);
    m.def("train_step", &py_train_step, "tree"_a, "batch"_a, "options"_a, "rates"_a, nb::kw_only(), "values"_a, "moments"_a,
          "slots"_a, "statistics"_a);
    m.def("loss_gradient", &py_loss_gradient, "tree"_a, "batch"_a, "options"_a, nb::kw_only(), "gradient"_a, "slots"_a);
    m.def("leaf_statistics", &py_leaf_statistics, "tree"_a, "batch"_a, "options"_a, nb::kw_only(), "statistics"_a);
    m.def("arena_bytes", &arena_bytes, nb::call_guard<nb::gil_scoped_release>());
    m.def("release_arenas", &release_arenas, nb::call_guard<nb::gil_scoped_release>());
}

}  // namespace

NB_MODULE(_nerfvol_kernels, m) {
    m.attr("__version__") = NERFVOL_VERSION;
    m.attr("TILE") = kTile;
    m.attr("MAX_LEVEL") = kMaxLevel;
    bind_photographs(m);
    bind_distilling(m);
    bind_around(m);
    bind_paths(m);
    nb::class_<TreeArrays>(m, "Tree").def(
        "__init__", &init_tree,
        "node_mask"_a, "leaf_mask"_a, "first_node"_a, "first_leaf"_a, "corners"_a, "values"_a, "sh_degree"_a, "origin"_a, "size"_a,
        "density_scale"_a, "node_corners"_a.none(), "node_values"_a.none(), "coarse"_a);
    m.def("render", &py_render, "tree"_a, "rays_o"_a, "rays_d"_a, "background"_a, "early_stop_eps"_a, "rgb"_a.none(),
          "trans"_a.none(), "depth"_a.none(), "median_depth"_a.none(), "normal"_a.none());
    m.def("render_view", &py_render_view, "tree"_a, "directions"_a, "rotation"_a, "origin"_a, "height"_a, "width"_a,
          "small"_a, "background"_a, "early_stop_eps"_a, "rgb"_a.none(), "trans"_a.none(), "depth"_a.none(),
          "median_depth"_a.none(), "normal"_a.none());
    m.def("render_backward", &py_render_backward, "tree"_a, "rays_o"_a, "rays_d"_a, "background"_a, "early_stop_eps"_a,
          "rgb"_a.none(), "trans"_a.none(), "depth"_a.none(), "gradient"_a, "slots"_a);
    bind_training(m);
    m.def("number_corners", &py_number_corners, "level"_a, "ijk"_a, "max_level"_a, "ids"_a);
    m.def("renumber_corners", &py_renumber_corners, "corners"_a, "kept"_a, "n_vertices"_a, "ids"_a);
    m.def("find_sources", &py_find_sources, "corners"_a, "parent"_a, "octant"_a, "source"_a, "place"_a);
    m.def("interpolate", &py_interpolate, "rows"_a, "corners"_a, "source"_a, "place"_a, "out"_a);
    m.def("prefilter", &py_prefilter, "tree"_a);
    m.def("gather_tiles", &py_gather_tiles, "directions"_a, "pixels"_a, "rotations"_a, "image"_a, "tile"_a, "row"_a, "out"_a, "target"_a);
    bind_splats(m);
    bind_fields(m);
    m.def("set_threads", &set_threads, "n"_a);
    m.def("get_threads", &get_threads);
    m.def("clock_ghz", &clock_ghz);
    m.def("isa", [] { return std::string(isa_name()); });
    m.def("set_isa", [](const std::string& name) { return set_isa(name.c_str()); }, "name"_a);
    m.def("available_isas", [] {
        const char* names[3];
        const int n = available_isas(names);
        return std::vector<std::string>(names, names + n);
    });
}
