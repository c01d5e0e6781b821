// Python bindings of what prepares photographs and starting points. Values were checked in Python; sizes are checked here.
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <vector>

#include "arrays.h"
#include "neighbours.h"
#include "similarity.h"
#include "sweep.h"
#include "warp.h"

namespace nb = nanobind;
using namespace nb::literals;
using namespace nerfvol;

namespace {

using Plane = In<float, nb::ndim<2>>;
using Mask = In<uint8_t, nb::ndim<2>>;

// maps (m, k, 12), others (m, k) picture numbers, -1 = none; outputs one (height, width) a reference.
void py_plane_sweep(const std::vector<Plane>& greys, const std::vector<std::optional<Mask>>& masks, In<int32_t, nb::ndim<1>> picture,
                    In<int32_t, nb::ndim<2>> others, In<float, nb::shape<-1, -1, 12>> maps,
                    In<int32_t, nb::ndim<1>> apart, int planes, float first, float step,
                    const std::vector<Out<float, nb::ndim<2>>>& inverse_depth, const std::vector<Out<float, nb::ndim<2>>>& score,
                    const std::vector<Out<float, nb::ndim<2>>>& rival) {
    const size_t m = picture.shape(0), k = others.shape(1);
    require(masks.size() == greys.size() && others.shape(0) == m && maps.shape(0) == m && maps.shape(1) == k,
            "pictures, references and maps do not fit one another");
    require(inverse_depth.size() == m && score.size() == m && rival.size() == m && apart.shape(0) == m, "there must be one output a reference");
    std::vector<Grey> pictures;
    for (size_t i = 0; i < greys.size(); ++i) {
        const auto& g = greys[i];
        require(g.shape(0) > 0 && g.shape(1) > 0, "a picture is empty");
        if (masks[i]) require(masks[i]->shape(0) == g.shape(0) && masks[i]->shape(1) == g.shape(1), "a mask has another size");
        pictures.push_back({g.data(), masks[i] ? masks[i]->data() : nullptr, int(g.shape(0)), int(g.shape(1))});
    }
    std::vector<Reference> references;
    for (size_t i = 0; i < m; ++i) {
        const int p = picture.data()[i];
        require(p >= 0 && size_t(p) < pictures.size(), "a reference is no picture");
        for (const auto* out : {&inverse_depth[i], &score[i], &rival[i]})
            require(out->shape(0) == greys[size_t(p)].shape(0) && out->shape(1) == greys[size_t(p)].shape(1),
                    "an output does not have its picture's size");
        Reference r{p, {}, apart.data()[i], inverse_depth[i].data(), score[i].data(), rival[i].data()};
        for (size_t j = 0; j < k; ++j) {
            Comparison c{others.data()[i * k + j], {}};
            require(c.picture < int(pictures.size()), "a comparison is no picture");
            std::copy_n(maps.data() + 12 * (i * k + j), 12, c.map);
            if (c.picture >= 0) r.others.push_back(c);
        }
        references.push_back(r);
    }
    nb::gil_scoped_release release;
    plane_sweep(pictures, references, planes, first, step);
}

Bytes bytes_of(const In<uint8_t, nb::ndim<3>>& a) {
    require(a.shape(0) > 0 && a.shape(1) > 0 && (a.shape(2) == 3 || a.shape(2) == 4), "expected a picture of 3 or 4 bytes a pixel");
    return {a.data(), int64_t(a.shape(0)), int64_t(a.shape(1)), int(a.shape(2))};
}

void py_remap(In<uint8_t, nb::ndim<3>> source, In<float, nb::shape<-1, -1, 2>> grid, int step, int64_t used_height,
              int64_t used_width, Out<uint8_t, nb::shape<-1, -1, 4>> out) {
    const int64_t height = int64_t(out.shape(0)), width = int64_t(out.shape(1));
    require(used_height >= 0 && used_width >= 0 && used_height <= height && used_width <= width && step > 0,
            "the used part is larger than the output");
    const PositionGrid g{grid.data(), int64_t(grid.shape(0)), int64_t(grid.shape(1)), step};
    require(g.rows > 0 && g.columns > 0 && (g.rows - 1) * step >= used_height - 1 && (g.columns - 1) * step >= used_width - 1,
            "the grid does not cover the output");
    const Bytes from = bytes_of(source);
    nb::gil_scoped_release release;
    remap(from, g, used_height, used_width, height, width, out.data());
}

void py_reduce(In<uint8_t, nb::ndim<3>> source, int64_t factor, Out<uint8_t, nb::shape<-1, -1, 4>> out) {
    require(factor >= 1 && factor <= 256, "the factor must be 1 to 256");
    const Bytes from = bytes_of(source);
    nb::gil_scoped_release release;
    reduce(from, factor, int64_t(out.shape(0)), int64_t(out.shape(1)), out.data());
}

void py_sample(In<float, nb::ndim<3>> picture, In<float, nb::shape<-1, 2>> positions, bool cubic, Out<float, nb::ndim<2>> out) {
    require(picture.shape(0) > 0 && picture.shape(1) > 0, "the picture is empty");
    require(out.shape(0) == positions.shape(0) && out.shape(1) == picture.shape(2), "the output does not fit");
    nb::gil_scoped_release release;
    sample(picture.data(), int64_t(picture.shape(0)), int64_t(picture.shape(1)), int64_t(picture.shape(2)), positions.data(),
           int64_t(positions.shape(0)), cubic, out.data());
}

void py_nearest(In<double, nb::shape<-1, 3>> points, std::optional<In<double, nb::shape<-1, 3>>> queries,
                Out<double, nb::ndim<2>> squared, Out<int32_t, nb::ndim<2>> index) {
    const size_t m = queries ? queries->shape(0) : points.shape(0);
    require(squared.shape(0) == m && index.shape(0) == m && squared.shape(1) == index.shape(1) && squared.shape(1) > 0,
            "the outputs do not fit");
    require(points.shape(0) < size_t(1) << 31, "too many points");
    nb::gil_scoped_release release;
    nearest(points.data(), int64_t(points.shape(0)), queries ? queries->data() : nullptr, int64_t(m), int(squared.shape(1)),
            squared.data(), index.data());
}

void py_similarity(In<float, nb::ndim<3>> a, In<float, nb::ndim<3>> b, In<float, nb::ndim<1>> weights, float c1, float c2,
                   Out<float, nb::ndim<3>> out) {
    const size_t taps = weights.shape(0);
    require(taps > 0 && a.shape(0) >= taps && a.shape(1) >= taps, "the window is larger than the picture");
    for (size_t k = 0; k < 3; ++k) {
        const size_t inner = k < 2 ? a.shape(k) - taps + 1 : a.shape(k);
        require(a.shape(k) == b.shape(k) && out.shape(k) == inner, "the pictures and the output do not fit one another");
    }
    nb::gil_scoped_release release;
    similarity(a.data(), b.data(), int64_t(a.shape(0)), int64_t(a.shape(1)), int64_t(a.shape(2)), weights.data(), int(taps), c1, c2,
               out.data());
}

}  // namespace

void bind_photographs(nb::module_& m) {
    m.def("plane_sweep", &py_plane_sweep, "greys"_a, "masks"_a, "picture"_a, "others"_a, "maps"_a, "apart"_a, "planes"_a, "first"_a, "step"_a,
          "inverse_depth"_a, "score"_a, "rival"_a);
    m.def("remap", &py_remap, "source"_a, "grid"_a, "step"_a, "used_height"_a, "used_width"_a, "out"_a);
    m.def("reduce", &py_reduce, "source"_a, "factor"_a, "out"_a);
    m.def("sample", &py_sample, "picture"_a, "positions"_a, "cubic"_a, "out"_a);
    m.def("similarity", &py_similarity, "a"_a, "b"_a, "weights"_a, "c1"_a, "c2"_a, "out"_a);
    m.def("nearest", &py_nearest, "points"_a, "queries"_a.none(), "squared"_a, "index"_a);
}
