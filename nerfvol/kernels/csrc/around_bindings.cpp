// Python bindings of making an octree around splats. Values were checked in Python; sizes are checked here.
#include <nanobind/stl/vector.h>

#include <algorithm>

#include "around.h"
#include "arrays.h"

namespace nb = nanobind;
using namespace nb::literals;
using namespace nerfvol;

namespace {

using Numbers = In<int64_t, nb::ndim<1>>;
using Doubles = In<double, nb::ndim<1>>;
using Points = In<double, nb::shape<-1, 3>>;
using Frames = In<double, nb::shape<-1, 3, 3>>;

GaussianAxes gaussians_of(const Points& means, const Frames& axes, const Doubles& side) {
    require(axes.shape(0) == means.shape(0) && side.shape(0) == means.shape(0), "there must be one row a Gaussian");
    return {means.data(), axes.data(), side.data(), int64_t(means.shape(0))};
}

nb::ndarray<nb::numpy, int64_t, nb::ndim<1>> handed_over(std::vector<int64_t>&& numbers) {
    auto* const held = new std::vector<int64_t>(std::move(numbers));
    nb::capsule owner(held, [](void* p) noexcept { delete static_cast<std::vector<int64_t>*>(p); });
    return {held->data(), {held->size()}, owner};
}

nb::tuple py_fill_cells(Points means, Frames axes, Doubles side, Points half, In<int64_t, nb::shape<-1, 3>> steps, Numbers level,
                        In<double, nb::shape<3>> origin) {
    const GaussianAxes gaussians = gaussians_of(means, axes, side);
    require(half.shape(0) == means.shape(0) && steps.shape(0) == means.shape(0) && level.shape(0) == means.shape(0),
            "there must be one row a Gaussian");
    for (size_t i = 0; i < level.shape(0); ++i)
        require(level.data()[i] >= 0 && level.data()[i] <= 20 && side.data()[i] > 0, "a level lies outside 0..20, or a side is none");
    std::vector<int64_t> gaussian, code;
    {
        nb::gil_scoped_release release;
        fill_cells(gaussians, half.data(), steps.data(), level.data(), origin.data(), gaussian, code);
    }
    return nb::make_tuple(handed_over(std::move(gaussian)), handed_over(std::move(code)));
}

nb::ndarray<nb::numpy, int64_t, nb::ndim<1>> py_distinct_codes(Numbers codes) {
    std::vector<int64_t> found;
    {
        nb::gil_scoped_release release;
        found = distinct_codes(codes.data(), int64_t(codes.shape(0)));
    }
    return handed_over(std::move(found));
}

void py_weigh_cells(In<uint8_t, nb::ndim<1>> node_mask, In<uint8_t, nb::ndim<1>> leaf_mask, In<int32_t, nb::ndim<1>> first_node,
                    In<int32_t, nb::ndim<1>> first_leaf, Points means, Frames axes, Points squares, Doubles thickness, double blur,
                    In<double, nb::shape<3>> origin, double size, Numbers gaussian, Numbers level, Numbers code,
                    Out<int64_t, nb::ndim<1>> leaf, Out<double, nb::ndim<1>> weight) {
    const size_t m = gaussian.shape(0), n = node_mask.shape(0);
    require(leaf_mask.shape(0) == n && first_node.shape(0) == n && first_leaf.shape(0) == n, "the octree's arrays do not fit");
    require(level.shape(0) == m && code.shape(0) == m && leaf.shape(0) == m && weight.shape(0) == m, "there must be one entry a pair");
    const GaussianAxes gaussians = gaussians_of(means, axes, thickness);
    require(squares.shape(0) == means.shape(0), "there must be one row a Gaussian");
    for (size_t i = 0; i < m; ++i)
        require(gaussian.data()[i] >= 0 && gaussian.data()[i] < gaussians.n && level.data()[i] >= 0 && level.data()[i] <= 20,
                "a pair names no Gaussian, or a level outside 0..20");
    const Masks octree{node_mask.data(), leaf_mask.data(), first_node.data(), first_leaf.data(), int64_t(n)};
    nb::gil_scoped_release release;
    weigh_cells(octree, gaussians, squares.data(), thickness.data(), blur, origin.data(), size, gaussian.data(), level.data(),
                code.data(), int64_t(m), leaf.data(), weight.data());
}

// poses (m, 12): world to camera axes, row by row, then the camera's place; lenses (m, 4): fx, fy, cx, cy.
void py_look_at_vertices(const std::vector<In<float, nb::shape<-1, -1, 3>>>& rgb, const std::vector<In<float, nb::ndim<2>>>& distance,
                         In<double, nb::shape<-1, 12>> poses, In<double, nb::shape<-1, 4>> lenses, const std::vector<double>& verdict, Points positions, Doubles side,
                         Out<int16_t, nb::ndim<1>> free, Out<int16_t, nb::ndim<1>> on, Out<float, nb::shape<-1, 3, -1>> sh) {
    const size_t m = rgb.size(), n = positions.shape(0);
    require(distance.size() == m && poses.shape(0) == m && lenses.shape(0) == m, "there must be one row a look");
    require(side.shape(0) == n && free.shape(0) == n && on.shape(0) == n && sh.shape(0) == n, "there must be one row a vertex");
    require(sh.shape(2) == 1 || sh.shape(2) == 4, "colours are of degree 0 or 1");
    std::vector<Look> looks(m);
    for (size_t i = 0; i < m; ++i) {
        Look& look = looks[i];
        look.rgb = rgb[i].data(); look.distance = distance[i].data();
        look.height = int64_t(rgb[i].shape(0)); look.width = int64_t(rgb[i].shape(1));
        require(int64_t(distance[i].shape(0)) == look.height && int64_t(distance[i].shape(1)) == look.width, "a look's pictures differ in size");
        const double *pose = poses.data() + 12 * i, *lens = lenses.data() + 4 * i;
        std::copy_n(pose, 9, look.rotation);
        std::copy_n(pose + 9, 3, look.position);
        look.fx = lens[0]; look.fy = lens[1]; look.cx = lens[2]; look.cy = lens[3];
    }
    const Verdict limits{verdict.at(0), verdict.at(1), verdict.at(2)};
    nb::gil_scoped_release release;
    look_at_vertices(looks, limits, positions.data(), side.data(), int64_t(n), int(sh.shape(2)), free.data(), on.data(), sh.data());
}

}  // namespace

void bind_around(nb::module_& m) {
    m.def("fill_cells", &py_fill_cells, nb::kw_only(), "means"_a, "axes"_a, "side"_a, "half"_a, "steps"_a, "level"_a, "origin"_a);
    m.def("distinct_codes", &py_distinct_codes, "codes"_a);
    m.def("weigh_cells", &py_weigh_cells, nb::kw_only(), "node_mask"_a, "leaf_mask"_a, "first_node"_a, "first_leaf"_a, "means"_a,
          "axes"_a, "squares"_a, "thickness"_a, "blur"_a, "origin"_a, "size"_a, "gaussian"_a, "level"_a, "code"_a, "leaf"_a, "weight"_a);
    m.def("look_at_vertices", &py_look_at_vertices, nb::kw_only(), "rgb"_a, "distance"_a, "poses"_a, "lenses"_a,
          "verdict"_a, "positions"_a, "side"_a, "free"_a, "on"_a, "sh"_a);
}
