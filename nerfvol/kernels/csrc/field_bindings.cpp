// Python bindings of the operators on neural fields. Ranges were checked by nerfvol/kernels/field_ops.py; layouts are checked here.
#include "field_bindings.h"

#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "tree.h"

namespace nb = nanobind;
using namespace nb::literals;
using namespace nerfvol;

namespace {

using Vectors = In<float, nb::shape<-1, 3>>;
using Numbers = Out<float, nb::ndim<1>>;
using Layer = std::tuple<int, int, bool, int>;  // in, out, relu, extra

int64_t entries(const FieldShape& f) { return f.hashed ? f.start[f.levels] * f.features : 0; }

void set_grid(FieldShape& f, const std::vector<int>& resolutions, const std::vector<int64_t>& starts, int features, int dense, int64_t bricks) {
    require(!resolutions.empty() && resolutions.size() <= std::size_t(kFieldLevels) && starts.size() == resolutions.size() + 1, "a grid has 1 to 16 levels");
    require(features == 1 || features == 2 || features == 4 || features == 8, "an entry has 1, 2, 4 or 8 features");
    require(bricks > 0 && (bricks & (bricks - 1)) == 0 && bricks <= int64_t(1) << 26, "the bricks of a level must be a power of two");
    f.hashed = true;
    f.levels = f.active = int(resolutions.size());
    f.features = features;
    f.dense = dense;
    f.bricks = uint32_t(bricks);
    f.encoded = f.levels * features;
    std::copy(resolutions.begin(), resolutions.end(), f.resolution);
    std::copy(starts.begin(), starts.end(), f.start);
    for (int l = 0; l < f.levels; ++l) {
        const int64_t n = f.resolution[l] + 1, size = l < dense ? n * n * n : bricks * kFieldBrick;
        require(n > 1 && n <= 1 << 20 && (l >= dense || n <= 1024) && f.start[l + 1] - f.start[l] >= size, "a level has fewer entries than it is asked for");
    }
    require(f.start[0] == 0, "the first level begins at 0");
}

void set_frequencies(FieldShape& f, int n) {
    require(n >= 0 && n <= 16, "there are 0 to 16 frequencies");
    f.hashed = false;
    f.frequencies = n;
    f.levels = f.active = 0;
    f.encoded = 3 + 6 * n;
}

void set_network(FieldShape& f, const std::vector<Layer>& layers, int head, bool sh_head, int sh_degree, int frequencies_dir) {
    require(!layers.empty() && layers.size() <= std::size_t(kFieldLayers) && head >= 0 && head < int(layers.size()), "a network has 1 to 11 layers");
    require(sh_degree >= 0 && sh_degree <= 3 && frequencies_dir >= 0 && frequencies_dir <= 16, "degree or frequencies out of range");
    f.n_layers = int(layers.size());
    f.head = head;
    f.sh_head = sh_head;
    f.sh_degree = sh_degree;
    f.frequencies_dir = frequencies_dir;
    f.encoded_dir = sh_head ? 0 : 3 + 6 * frequencies_dir;
    f.n_network = 0;
    for (int l = 0; l < f.n_layers; ++l) {
        FieldLayer& a = f.layers[l];
        std::tie(a.in, a.out, a.relu, a.extra) = layers[std::size_t(l)];
        require(a.in > 0 && a.out > 0 && a.in <= 2048 && a.out <= 1024 && a.extra >= kNothing && a.extra <= kDirection, "a layer is out of range");
        const int before = l == 0 ? f.encoded : f.layers[l - 1].out - (l == head + 1 ? 1 : 0);
        const int more = a.extra == kPosition ? f.encoded : a.extra == kDirection ? f.encoded_dir : 0;
        require(a.in == before + more && (l > 0 || !more), "a layer does not fit the one before it");
        a.weights = f.n_network;
        a.biases = a.weights + int64_t(a.in) * a.out;
        f.n_network = a.biases + a.out;
    }
    if (sh_head) require(head == f.n_layers - 1 && f.layers[head].out == 1 + 3 * f.coefficients(), "the head does not have the degree's outputs");
    else require(head == f.n_layers - 3 && f.layers[f.n_layers - 1].out == 3, "a network of colours has two layers and three outputs");
}

void set_domain(FieldShape& f, const std::vector<float>& center, float half, float outer, float scale, float bias, bool softplus) {
    require(center.size() == 3 && half > 0 && outer >= 1, "a domain has a centre and a size");
    std::copy(center.begin(), center.end(), f.center);
    f.half = half;
    f.outer = outer;
    f.density_scale = scale;
    f.density_bias = bias;
    f.softplus = softplus;
}

// Holds what it points to.
struct MarchArrays {
    In<float, nb::ndim<1>> edges;
    In<uint64_t, nb::ndim<1>> occupied, coarse;
    int group, resolution, cubes;
    float step, near_plane;
    FieldMarch view() const { return {edges.data(), int(edges.shape(0)) - 1, group, step, near_plane, occupied.data(), coarse.data(), resolution, cubes}; }
};

void init_march(MarchArrays* self, In<float, nb::ndim<1>> edges, int group, float step, float near_plane, In<uint64_t, nb::ndim<1>> occupied,
                In<uint64_t, nb::ndim<1>> coarse, int resolution, int cubes) {
    const int64_t steps = int64_t(edges.shape(0)) - 1, r = resolution, cells = r * r * r * cubes;
    require(group > 0 && 16 % group == 0 && steps > 0 && steps % group == 0 && steps < 1 << 16, "steps must come in whole groups");
    require(resolution >= 4 && resolution % 4 == 0 && resolution <= 512 && cubes >= 1 && cubes <= 16, "the cells are out of range");
    require(int64_t(occupied.shape(0)) * 64 >= cells && int64_t(coarse.shape(0)) * 64 >= cells / 64, "too few bits for the cells");
    new (self) MarchArrays{edges, occupied, coarse, group, resolution, cubes, step, near_plane};
}

FieldRays make_rays(const Vectors& o, const Vectors& d, const std::optional<In<float, nb::ndim<1>>>& jitter, const std::optional<Vectors>& target) {
    const std::size_t n = o.shape(0);
    require(d.shape(0) == n && (!jitter || jitter->shape(0) == n) && (!target || target->shape(0) == n), "rays must be as many as directions, jitters and targets");
    return {o.data(), d.data(), pointer(jitter), pointer(target), int64_t(n)};
}

FieldReport py_step(const FieldShape& f, Vectors o, Vectors d, std::optional<In<float, nb::ndim<1>>> jitter, Vectors target, const MarchArrays& march,
                    const FieldLoss& loss, const FieldRates& rates, const std::vector<Numbers>& table, const std::vector<Numbers>& network,
                    Out<int64_t, nb::ndim<1>> updates, std::optional<In<uint8_t, nb::ndim<1>>> moves) {
    require(table.size() == 4 && network.size() == 4, "values, two moments and a gradient are wanted");
    for (int k = 0; k < 4; ++k) {
        require(int64_t(table[std::size_t(k)].shape(0)) >= entries(f) && int64_t(network[std::size_t(k)].shape(0)) >= f.n_network, "the arrays do not fit the field");
        require(!f.hashed || reinterpret_cast<uintptr_t>(table[std::size_t(k)].data()) % 64 == 0, "the grid's arrays must begin on a cache line");
    }
    require(int64_t(updates.shape(0)) >= f.levels + 1 && (!moves || int64_t(moves->shape(0)) >= f.levels), "a count is wanted for each level and the network");
    const FieldRays rays = make_rays(o, d, jitter, target);
    const FieldMemory memory{table[0].data(), table[1].data(), table[2].data(), table[3].data(), network[0].data(), network[1].data(), network[2].data(),
                             network[3].data(), updates.data(), pointer(moves)};
    nb::gil_scoped_release release;
    return field_kernels().step(f, rays, march.view(), loss, rates, memory);
}

FieldParameters parameters(const FieldShape& f, const In<float, nb::ndim<1>>& table, const In<float, nb::ndim<1>>& network) {
    require(int64_t(table.shape(0)) >= entries(f) && int64_t(network.shape(0)) >= f.n_network, "the arrays do not fit the field");
    return {table.data(), network.data()};
}

void py_render(const FieldShape& f, In<float, nb::ndim<1>> table, In<float, nb::ndim<1>> network, Vectors o, Vectors d, const MarchArrays& march,
               const FieldLoss& loss, std::optional<Out<float, nb::shape<-1, 3>>> rgb, std::optional<Numbers> opacity, std::optional<Numbers> depth) {
    const FieldParameters given = parameters(f, table, network);
    const FieldRays rays = make_rays(o, d, std::nullopt, std::nullopt);
    const auto check = [&](const auto& a) { require(!a || int64_t(a->shape(0)) == rays.n, "an output does not have a row for each ray"); };
    check(rgb); check(opacity); check(depth);
    const FieldOutput out{pointer(rgb), pointer(opacity), pointer(depth)};
    nb::gil_scoped_release release;
    field_kernels().render(f, given, rays, march.view(), loss, out);
}

void py_evaluate(const FieldShape& f, In<float, nb::ndim<1>> table, In<float, nb::ndim<1>> network, Vectors positions, std::optional<Vectors> directions,
                 const MarchArrays* where, Numbers sigma, std::optional<Out<float, nb::ndim<2>>> values) {
    const FieldParameters given = parameters(f, table, network);
    const int64_t n = int64_t(positions.shape(0)), count = f.sh_head ? 3 * f.coefficients() : 3;
    require(int64_t(sigma.shape(0)) == n && (!directions || int64_t(directions->shape(0)) == n), "an array does not have a row for each point");
    require(!values || (int64_t(values->shape(0)) == n && int64_t(values->shape(1)) == count), "the values do not fit the head");
    require(f.sh_head || !values || directions, "a network of colours needs directions");
    FieldMarch march;
    if (where) march = where->view();
    const FieldPoints points{positions.data(), pointer(directions), n, where ? &march : nullptr, sigma.data(), pointer(values)};
    nb::gil_scoped_release release;
    field_kernels().evaluate(f, given, points);
}

void py_march(const FieldShape& f, Vectors o, Vectors d, std::optional<In<float, nb::ndim<1>>> jitter, const MarchArrays& march, Out<uint64_t, nb::ndim<2>> bits) {
    const FieldRays rays = make_rays(o, d, jitter, std::nullopt);
    require(int64_t(bits.shape(0)) == rays.n && int64_t(bits.shape(1)) == (int64_t(march.edges.shape(0)) - 1 + 63) / 64, "the bits do not fit rays and steps");
    nb::gil_scoped_release release;
    field_kernels().march(f, rays, march.view(), bits.data());
}

// Pictures and their cameras, held for as long as a field trains.
struct PixelArrays {
    std::vector<In<uint8_t, nb::shape<-1, -1, 3>>> pictures;
    std::vector<Vectors> tables;
    In<float, nb::shape<-1, 3, 3>> rotations;
    Vectors origins;
    std::vector<const uint8_t*> colours;
    std::vector<const float*> directions;
    std::vector<int64_t> starts;
};

void init_pixels(PixelArrays* self, const std::vector<In<uint8_t, nb::shape<-1, -1, 3>>>& pictures, const std::vector<Vectors>& tables,
                 In<float, nb::shape<-1, 3, 3>> rotations, Vectors origins) {
    const std::size_t views = pictures.size();
    require(views > 0 && tables.size() == views && rotations.shape(0) == views && origins.shape(0) == views, "a table, a rotation and an origin a view are wanted");
    PixelArrays a{pictures, tables, rotations, origins, {}, {}, {0}};
    for (std::size_t v = 0; v < views; ++v) {
        const std::size_t n = pictures[v].shape(0) * pictures[v].shape(1);
        require(n > 0 && tables[v].shape(0) == n, "a view must have a direction for each pixel");
        a.colours.push_back(pictures[v].data());
        a.directions.push_back(tables[v].data());
        a.starts.push_back(a.starts.back() + int64_t(n));
    }
    require(a.starts.back() < int64_t(1) << 32, "there can be at most 2^32 pixels");
    new (self) PixelArrays(std::move(a));
}

void py_draw(const PixelArrays& a, uint64_t key, Out<float, nb::shape<-1, 3>> o, Out<float, nb::shape<-1, 3>> d, Out<float, nb::shape<-1, 3>> target, Numbers jitter) {
    const std::size_t n = jitter.shape(0);
    require(o.shape(0) == n && d.shape(0) == n && target.shape(0) == n, "rays must be as many as jitters");
    const FieldPixels from{a.colours.data(), a.starts.data(), a.rotations.data(), a.origins.data(), a.directions.data(), int64_t(a.tables.size())};
    nb::gil_scoped_release release;
    draw_pixels(from, key, int64_t(n), o.data(), d.data(), target.data(), jitter.data());
}

void py_refresh(In<float, nb::ndim<1>> sigmas, In<float, nb::ndim<1>> thresholds, int resolution, Out<uint64_t, nb::ndim<1>> occupied,
                Out<uint64_t, nb::ndim<1>> coarse) {
    const int64_t r = resolution, cubes = int64_t(thresholds.shape(0)), cells = r * r * r * cubes;
    require(r >= 4 && r % 4 == 0 && r <= 512 && cubes <= 16 && int64_t(sigmas.shape(0)) == cells, "the cells do not fit the resolution");
    require(int64_t(occupied.shape(0)) * 64 >= cells && int64_t(coarse.shape(0)) * 64 >= cells / 64, "too few bits for the cells");
    nb::gil_scoped_release release;
    refresh_occupancy(sigmas.data(), int(cubes), resolution, thresholds.data(), occupied.data(), coarse.data());
}

}  // namespace

void bind_fields(nb::module_& m) {
    nb::class_<FieldShape>(m, "FieldShape").def(nb::init<>())
        .def("grid", &set_grid, "resolutions"_a, "starts"_a, "features"_a, "dense"_a, "bricks"_a)
        .def("use_levels", [](FieldShape& f, int n) { require(n >= 0 && n <= f.levels, "more levels than the grid has"); f.active = n; }, "n"_a)
        .def("frequencies", &set_frequencies, "n"_a)
        .def("network", &set_network, "layers"_a, "head"_a, "sh_head"_a, "sh_degree"_a, "frequencies_dir"_a)
        .def("domain", &set_domain, "center"_a, "half"_a, "outer"_a, "density_scale"_a, "density_bias"_a, "softplus"_a);
    nb::class_<MarchArrays>(m, "FieldMarch").def("__init__", &init_march, "edges"_a, "group"_a, "step"_a, "near_plane"_a, "occupied"_a, "coarse"_a, "resolution"_a, "cubes"_a);
    nb::class_<FieldLoss>(m, "FieldLoss").def(nb::init<>())
        .def_prop_rw("background", [](const FieldLoss& l) { return std::vector<float>(l.background, l.background + 3); },
                     [](FieldLoss& l, const std::vector<float>& v) { for (std::size_t k = 0; k < 3; ++k) l.background[k] = v.at(k); })
        .def_rw("colour", &FieldLoss::colour).def_rw("distortion", &FieldLoss::distortion).def_rw("entropy", &FieldLoss::entropy)
        .def_rw("early_stop_eps", &FieldLoss::early_stop_eps).def_rw("negligible", &FieldLoss::negligible);
    nb::class_<FieldRates>(m, "FieldRates").def(nb::init<>())
        .def_rw("rate", &FieldRates::rate).def_rw("beta1", &FieldRates::beta1).def_rw("beta2", &FieldRates::beta2).def_rw("eps", &FieldRates::eps)
        .def_rw("table_decay", &FieldRates::table_decay).def_rw("network_decay", &FieldRates::network_decay);
    nb::class_<FieldReport>(m, "FieldReport").def_ro("squared_error", &FieldReport::squared_error).def_ro("loss", &FieldReport::loss)
        .def_ro("samples", &FieldReport::samples).def_ro("used", &FieldReport::used);
    m.def("field_step", &py_step, "shape"_a, "rays_o"_a, "rays_d"_a, "jitter"_a.none(), "target"_a, "march"_a, "loss"_a, "rates"_a, "table"_a, "network"_a,
          "updates"_a, "moves"_a.none());
    m.def("field_render", &py_render, "shape"_a, "table"_a, "network"_a, "rays_o"_a, "rays_d"_a, "march"_a, "loss"_a, "rgb"_a.none(), "opacity"_a.none(), "depth"_a.none());
    m.def("field_evaluate", &py_evaluate, "shape"_a, "table"_a, "network"_a, "positions"_a, "directions"_a.none(), "where"_a.none(), "sigma"_a, "values"_a.none());
    m.def("field_march", &py_march, "shape"_a, "rays_o"_a, "rays_d"_a, "jitter"_a.none(), "march"_a, "bits"_a);
    nb::class_<PixelArrays>(m, "FieldPixels").def("__init__", &init_pixels, "pictures"_a, "tables"_a, "rotations"_a, "origins"_a);
    m.def("field_draw", &py_draw, "pixels"_a, "key"_a, "rays_o"_a, "rays_d"_a, "target"_a, "jitter"_a);
    m.def("field_refresh", &py_refresh, "sigmas"_a, "thresholds"_a, "resolution"_a, "occupied"_a, "coarse"_a);
}
