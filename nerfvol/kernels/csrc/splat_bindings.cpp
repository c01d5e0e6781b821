// Python bindings of the operators on splats. Ranges were checked by nerfvol/kernels/splat_ops.py; layouts are checked here.
#include "splat_bindings.h"

#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <vector>

#include "arrays.h"
#include "splat_rows.h"
#include "tree.h"

namespace nb = nanobind;
using namespace nb::literals;
using namespace nerfvol;

namespace {

using Params = In<float, nb::shape<-1, -1, 16>>;
using Blocks = Out<float, nb::shape<-1, -1, 16>>;
using PerGaussian = Out<float, nb::shape<-1, 16>>;
using Picture = std::optional<Out<float, nb::ndim<2>>>;
using Vectors = std::optional<Out<float, nb::shape<-1, -1, 3>>>;

// The kernels load whole cache lines.
template <class A> void require_lines(const A& array) {
    require(!array.size() || reinterpret_cast<uintptr_t>(array.data()) % 64 == 0, "blocks of splats must begin on a cache line");
}

Splats make_splats(const Params& params, int64_t n, bool mip) {
    const int64_t coefficients = int64_t(params.shape(1)) - kSh;
    require(coefficients == 3 || coefficients == 12 || coefficients == 27 || coefficients == 48,
            "splats must have 11 + 3 K rows, K = 1, 4, 9 or 16");
    require(n >= 0 && (n + kSplatLanes - 1) / kSplatLanes == int64_t(params.shape(0)), "the blocks do not fit the number of splats");
    require(n < int64_t(1) << 26, "there can be at most 2^26 splats");  // entries of tiles have 26 bits for them
    require_lines(params);
    return {params.data(), int64_t(params.shape(0)), n, int(coefficients / 3), mip};
}

void init_view(SplatView* self, const std::vector<float>& rotation, const std::vector<float>& translation,
               const std::vector<float>& eye, const std::vector<float>& lens, float near, int64_t width, int64_t height) {
    require(rotation.size() == 9 && translation.size() == 3 && eye.size() == 3 && lens.size() == 4, "a view has 9 + 3 + 3 + 4 numbers");
    require(near > 0 && width > 0 && height > 0, "a view needs a size and a near plane");
    require(width <= 1 << 20 && height <= (int64_t(1) << 30) / width, "a picture must have at most 2^30 pixels");  // entries have 22 bits
    auto* v = new (self) SplatView{};
    std::copy(rotation.begin(), rotation.end(), v->rotation);
    std::copy(translation.begin(), translation.end(), v->translation);
    std::copy(eye.begin(), eye.end(), v->eye);
    v->fx = lens[0];
    v->fy = lens[1];
    v->cx = lens[2];
    v->cy = lens[3];
    v->near = near;
    v->width = width;
    v->height = height;
}

void py_render(Params params, int64_t n, bool mip, const SplatView& view, const std::vector<float>& background, float eps,
               Vectors rgb, Picture opacity, Picture depth, Picture median, Vectors normal, bool surfaces) {
    const Splats splats = make_splats(params, n, mip);
    const auto check = [&](const auto& a) {
        require(!a || (int64_t(a->shape(0)) == view.height && int64_t(a->shape(1)) == view.width), "an output does not have the picture's size");
    };
    check(rgb); check(opacity); check(depth); check(median); check(normal);
    require(!surfaces || splats.basis == 1, "points have one colour");
    const SplatRenderOptions options{{background.at(0), background.at(1), background.at(2)}, eps};
    const SplatOutput out{pointer(rgb), pointer(opacity), pointer(depth), pointer(median), pointer(normal)};
    nb::gil_scoped_release release;
    (surfaces ? splat_kernels().points : splat_kernels().render)(splats, view, options, out);
}

// With `gradient` the gradient of the loss is written there, 0 where a Gaussian was not hit, and nothing else changes.
SplatReport py_step(Blocks params, int64_t n, bool mip, Blocks first, Blocks second, PerGaussian updates, PerGaussian error,
                    PerGaussian max_weight, PerGaussian seen, const SplatView& view, In<uint8_t, nb::shape<-1, -1, 4>> image,
                    const SplatLoss& loss, const SplatRates& rates, std::optional<Blocks> gradient, bool motion) {
    const Splats splats = make_splats(Params(params), n, mip);
    const auto check = [&](const Blocks& a) {
        require(a.shape(0) == params.shape(0) && a.shape(1) == params.shape(1), "the optimiser's arrays do not fit the splats");
        require_lines(a);
    };
    const auto check_row = [&](const PerGaussian& a) {
        require(a.shape(0) == params.shape(0), "the optimiser's arrays do not fit the splats");
        require_lines(a);
    };
    check(first); check(second);
    if (gradient) check(*gradient);
    check_row(updates); check_row(error); check_row(max_weight); check_row(seen);
    const auto padded = [](int64_t pixels) { return (pixels + 15) / 16 * 16; };
    require(int64_t(image.shape(0)) == padded(view.height) && int64_t(image.shape(1)) == padded(view.width),
            "the image must have the view's size, padded to multiples of 16");
    const SplatImage target{image.data(), int64_t(image.shape(0)), int64_t(image.shape(1))};
    const SplatMemory memory{params.data(), first.data(), second.data(), updates.data(), error.data(), max_weight.data(), seen.data(), pointer(gradient), motion};
    nb::gil_scoped_release release;
    return splat_kernels().step(splats, view, target, loss, rates, memory);
}

void py_gather(Params in, In<int64_t, nb::ndim<1>> index, In<float, nb::ndim<1>> padding, Blocks out) {
    const int64_t n = int64_t(index.shape(0)), available = int64_t(in.shape(0)) * kSplatLanes;
    require(in.shape(1) == out.shape(1) && padding.shape(0) == in.shape(1) && int64_t(out.shape(0)) == (n + kSplatLanes - 1) / kSplatLanes,
            "the gathered blocks do not fit");
    for (int64_t j = 0; j < n; ++j) require(index.data()[j] < available, "an index lies beyond the splats");
    nb::gil_scoped_release release;
    gather_splats(in.data(), int64_t(in.shape(1)), index.data(), n, padding.data(), out.data());
}

void py_morton(Params params, const std::vector<float>& middle, float size, Out<uint64_t, nb::ndim<1>> codes) {
    require(int64_t(codes.shape(0)) <= int64_t(params.shape(0)) * kSplatLanes && middle.size() == 3 && params.shape(1) >= 3, "the codes do not fit the splats");
    nb::gil_scoped_release release;
    morton_splats(params.data(), int64_t(params.shape(1)), int64_t(codes.shape(0)), middle.data(), size, codes.data());
}

template <class Class> void bind_background(Class& c) {
    c.def_prop_rw("background", [](const SplatLoss& l) { return std::vector<float>(l.background, l.background + 3); },
                  [](SplatLoss& l, const std::vector<float>& v) { for (size_t k = 0; k < 3; ++k) l.background[k] = v.at(k); });
}

}  // namespace

void bind_splats(nb::module_& m) {
    nb::class_<SplatView>(m, "SplatView").def("__init__", &init_view, "rotation"_a, "translation"_a, "eye"_a, "lens"_a, "near"_a, "width"_a, "height"_a);
    auto loss = nb::class_<SplatLoss>(m, "SplatLoss").def(nb::init<>());
    bind_background(loss);
    loss.def_rw("l1", &SplatLoss::l1).def_rw("squared", &SplatLoss::squared).def_rw("ssim", &SplatLoss::ssim)
        .def_rw("scale", &SplatLoss::scale).def_rw("opacity", &SplatLoss::opacity)
        .def_rw("early_stop_eps", &SplatLoss::early_stop_eps).def_rw("weight_threshold", &SplatLoss::weight_threshold);
    nb::class_<SplatRates>(m, "SplatRates").def(nb::init<>())
        .def_rw("means", &SplatRates::means).def_rw("log_scales", &SplatRates::log_scales).def_rw("quats", &SplatRates::quats)
        .def_rw("logits", &SplatRates::logits).def_rw("dc", &SplatRates::dc).def_rw("sh", &SplatRates::sh)
        .def_rw("beta1", &SplatRates::beta1).def_rw("beta2", &SplatRates::beta2).def_rw("eps", &SplatRates::eps)
        .def_rw("most_log_ratio", &SplatRates::most_log_ratio);
    nb::class_<SplatReport>(m, "SplatReport")
        .def_ro("loss", &SplatReport::loss).def_ro("squared_error", &SplatReport::squared_error).def_ro("pixels", &SplatReport::pixels)
        .def_ro("visible", &SplatReport::visible).def_ro("entries", &SplatReport::entries).def_ro("blocks", &SplatReport::blocks)
        .def_prop_ro("motion", [](const SplatReport& r) { return std::vector<double>(r.motion, r.motion + 6); });
    m.def("splat_render", &py_render, "params"_a, "n"_a, "mip"_a, "view"_a, "background"_a, "early_stop_eps"_a, "rgb"_a.none(),
          "opacity"_a.none(), "depth"_a.none(), "median_depth"_a.none(), "normal"_a.none(), "surfaces"_a = false);
    m.def("splat_step", &py_step, "params"_a, "n"_a, "mip"_a, "first"_a, "second"_a, "updates"_a, "error"_a, "max_weight"_a,
          "seen"_a, "view"_a, "image"_a, "loss"_a, "rates"_a, "gradient"_a.none(), "motion"_a);
    m.def("splat_gather", &py_gather, "blocks"_a, "index"_a, "padding"_a, "out"_a);
    m.def("splat_morton", &py_morton, "params"_a, "middle"_a, "size"_a, "codes"_a);
}
