// Python binding of the path tracer. Values were checked in Python; sizes and indices are checked here.
#include <nanobind/stl/pair.h>

#include <optional>
#include <utility>

#include "arrays.h"
#include "path_scene.h"

namespace nb = nanobind;
using namespace nb::literals;
using namespace nerfvol;

namespace {

using Picture = Out<double, nb::shape<-1, -1, 8>>;
using Rows = In<double, nb::shape<-1, 3>>;
using Floats = In<float, nb::ndim<1>>;
constexpr int kBrickSamples = 729;

PathTable table(const Rows& rows) {
    require(rows.shape(0) > 0, "a table is empty");
    return {rows.data(), int(rows.shape(0))};
}

// numbers: lo (3), hi (3), brick_size (3), sigma_t (3), falloff, g1, g2, mix; whole: kind, phase, bricks (3).
void py_trace(In<double, nb::shape<16>> numbers, In<int64_t, nb::shape<5>> whole, In<int64_t, nb::ndim<1>> offsets, Floats samples,
              const std::optional<Floats>& attributes, In<double, nb::ndim<1>> brick_max, Rows albedo, Rows Le,
              In<double, nb::shape<-1, kLightColumns>> lights, In<double, nb::shape<16>> camera, int64_t spp, int64_t max_depth, bool jitter,
              bool opaque_sky, uint64_t seed, std::pair<int64_t, int64_t> blocks, int first, Picture out) {
    PathScene s{};
    PathMedium& m = s.medium;
    const double* x = numbers.data();
    for (int a = 0; a < 3; ++a) {
        m.lo[a] = x[a], m.hi[a] = x[3 + a], m.brick_size[a] = x[6 + a], m.sigma_t[a] = x[9 + a], m.bricks[a] = whole.data()[2 + a];
        require(m.bricks[a] > 0 && m.brick_size[a] > 0.0 && m.hi[a] > m.lo[a], "the box has no bricks");
        require((m.hi[a] - m.lo[a]) / m.brick_size[a] <= double(m.bricks[a]) * (1.0 + 1e-9), "the box is larger than its bricks");
    }
    m.falloff = x[12], m.g1 = x[13], m.g2 = x[14], m.mix = x[15];
    m.kind = int(whole.data()[0]), m.phase = int(whole.data()[1]);
    require(m.kind >= kHomogeneous && m.kind <= kExponential && m.phase >= kIsotropic && m.phase <= kHenyeyGreenstein,
            "the kind of medium or phase function is unknown");
    const size_t n = size_t(m.bricks[0]) * size_t(m.bricks[1]) * size_t(m.bricks[2]);
    require(brick_max.shape(0) == n, "there must be one bound a brick");
    if (m.kind == kGrid) {
        require(offsets.shape(0) == n, "there must be one offset a brick");
        const int64_t stored = int64_t(samples.shape(0));
        for (size_t k = 0; k < n; ++k) {
            const int64_t at = offsets.data()[k];
            require(at == -1 || (at >= 0 && at % kBrickSamples == 0 && at + kBrickSamples <= stored), "an offset is no brick's");
        }
        require(!attributes || attributes->shape(0) == samples.shape(0), "there must be one attribute a sample");
    }
    m.offsets = offsets.data(), m.samples = samples.data(), m.brick_max = brick_max.data();
    m.attributes = attributes && m.kind == kGrid ? attributes->data() : nullptr;
    m.albedo = table(albedo), m.Le = table(Le);
    s.lights = lights.data(), s.n_lights = int(lights.shape(0));
    for (int k = 0; k < s.n_lights; ++k) {
        const double kind = s.lights[k * kLightColumns];
        require(kind == kPointLight || kind == kDirectionalLight || kind == kSkyLight, "the kind of light is unknown");
    }
    for (int k = 0; k < 12; ++k) s.camera.c2w[k] = camera.data()[k];
    s.camera.fx = camera.data()[12], s.camera.fy = camera.data()[13], s.camera.cx = camera.data()[14], s.camera.cy = camera.data()[15];
    require(spp > 0 && max_depth >= 0 && first >= 0, "expected paths, a depth and a first row");
    require(blocks.first >= 0 && blocks.first < blocks.second && (blocks.second - 1) * kBlock < spp, "expected blocks of the paths");
    s.settings = {spp, max_depth, jitter, opaque_sky, seed, blocks.first, blocks.second};
    const int height = int(out.shape(0)), width = int(out.shape(1));
    nb::gil_scoped_release release;
    path_kernels().trace(s, width, first, first + height, out.data());
}

}  // namespace

void bind_paths(nb::module_& m) {
    m.def("trace_paths", &py_trace, "numbers"_a, "whole"_a, "offsets"_a, "samples"_a, "attributes"_a.none(), "brick_max"_a, "albedo"_a,
          "Le"_a, "lights"_a, "camera"_a, "spp"_a, "max_depth"_a, "jitter"_a, "opaque_sky"_a, "seed"_a, "blocks"_a, "first"_a, "out"_a);
}
