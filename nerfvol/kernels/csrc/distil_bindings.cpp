// Python bindings of distilling. Values were checked in Python; sizes are checked here.
#include "arrays.h"
#include "distil.h"

namespace nb = nanobind;
using namespace nb::literals;
using namespace nerfvol;

namespace {

void py_dilate_cells(In<int32_t, nb::shape<-1, 3>> cells, In<uint8_t, nb::ndim<1>> holds, Out<uint8_t, nb::ndim<1>> kept) {
    require(holds.shape(0) == cells.shape(0) && kept.shape(0) == cells.shape(0), "there must be one entry a cell");
    nb::gil_scoped_release release;
    dilate_cells(cells.data(), holds.data(), int64_t(cells.shape(0)), kept.data());
}

void py_merge_errors(In<float, nb::ndim<2>> values, int density, In<int32_t, nb::ndim<1>> slots, In<float, nb::ndim<1>> bounds,
                     In<int32_t, nb::shape<-1, 8>> corners, In<int64_t, nb::ndim<1>> first, In<float, nb::ndim<1>> scale,
                     Out<float, nb::ndim<1>> error) {
    const int64_t width = int64_t(values.shape(1)), leaves = int64_t(corners.shape(0)), m = int64_t(first.shape(0));
    require(bounds.shape(0) == slots.shape(0) && int64_t(scale.shape(0)) == m && int64_t(error.shape(0)) == m,
            "the arrays do not fit one another");
    require(density >= 0 && density < width, "the density lies outside the rows");
    for (size_t k = 0; k < slots.shape(0); ++k)
        require(slots.data()[k] >= 0 && slots.data()[k] < width, "a coefficient lies outside the rows");
    for (int64_t i = 0; i < m; ++i)
        require(first.data()[i] >= 0 && first.data()[i] + 8 <= leaves, "a family lies outside the leaves");
    const VertexRows rows{values.data(), width, density, slots.data(), bounds.data(), int(slots.shape(0))};
    nb::gil_scoped_release release;
    merge_errors(rows, corners.data(), first.data(), scale.data(), m, error.data());
}

void py_add_rows(In<double, nb::ndim<2>> rows, In<int64_t, nb::ndim<1>> from, In<double, nb::ndim<1>> weight,
                 In<int64_t, nb::ndim<1>> to, Out<double, nb::ndim<2>> sums) {
    const int64_t m = int64_t(from.shape(0)), width = int64_t(rows.shape(1));
    require(int64_t(weight.shape(0)) == m && int64_t(to.shape(0)) == m && int64_t(sums.shape(1)) == width,
            "the arrays do not fit one another");
    for (int64_t i = 0; i < m; ++i)
        require(from.data()[i] >= 0 && from.data()[i] < int64_t(rows.shape(0)) && to.data()[i] < int64_t(sums.shape(0)),
                "a row lies outside the array");
    nb::gil_scoped_release release;
    add_rows(rows.data(), width, from.data(), weight.data(), to.data(), m, sums.data(), int64_t(sums.shape(0)));
}

void py_add_to_corners(In<double, nb::ndim<2>> rows, In<double, nb::ndim<1>> weight, In<int32_t, nb::shape<-1, 8>> corners,
                       Out<double, nb::ndim<2>> sums) {
    const int64_t m = int64_t(rows.shape(0)), n = int64_t(sums.shape(0)), width = int64_t(rows.shape(1));
    require(int64_t(weight.shape(0)) == m && int64_t(corners.shape(0)) == m && int64_t(sums.shape(1)) == width,
            "the arrays do not fit one another");
    for (int64_t i = 0; i < 8 * m; ++i) require(corners.data()[i] >= 0 && corners.data()[i] < n, "a corner lies outside the vertices");
    nb::gil_scoped_release release;
    add_to_corners(rows.data(), width, weight.data(), corners.data(), m, sums.data(), n);
}

}  // namespace

void bind_distilling(nb::module_& m) {
    m.def("dilate_cells", &py_dilate_cells, "cells"_a, "holds"_a, "kept"_a);
    m.def("merge_errors", &py_merge_errors, nb::kw_only(), "values"_a, "density"_a, "slots"_a, "bounds"_a, "corners"_a, "first"_a,
          "scale"_a, "error"_a);
    m.def("add_rows", &py_add_rows, "rows"_a, "from"_a, "weight"_a, "to"_a, "sums"_a);
    m.def("add_to_corners", &py_add_to_corners, "rows"_a, "weight"_a, "corners"_a, "sums"_a);
}
