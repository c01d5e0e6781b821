// What a trained field is asked for: pictures, and values at points.
#pragma once
#include <memory>

#include "field_train.h"

namespace NERFVOL_ISA {

inline void render_field(const FieldShape& f, const FieldParameters& given, const FieldRays& rays, const FieldMarch& march, const FieldLoss& loss,
                         const nerfvol::FieldOutput& out) {
    const Network net(f, given.network, false);
    const Marcher marcher(f, march);
    nerfvol::Arenas arenas;
    std::vector<std::unique_ptr<Chunk>> of_thread(static_cast<std::size_t>(nerfvol::get_threads()));
    nerfvol::parallel_for(int((rays.n + kRays - 1) / kRays), [&](int task, int thread) {
        auto& chunk = of_thread[std::size_t(thread)];
        if (!chunk) chunk = std::make_unique<Chunk>(net, given, marcher, arenas.of_thread(thread), false);
        const int64_t from = int64_t(task) * kRays;
        chunk->forward(rays, from, int(std::min<int64_t>(kRays, rays.n - from)), loss.early_stop_eps);
        for (int r = 0; r < chunk->n; ++r) {
            const ChunkRay& a = chunk->rays[r];
            for (int k = 0; k < 3 && out.rgb; ++k) out.rgb[3 * (from + r) + k] = a.colour[k] + a.trans * loss.background[k];
            if (out.opacity) out.opacity[from + r] = 1.0f - a.trans;
            if (out.depth) out.depth[from + r] = a.depth;
        }
    });
}

inline void march_field(const FieldShape& f, const FieldRays& rays, const FieldMarch& march, uint64_t* bits) {
    const Marcher marcher(f, march);
    for (int64_t r = 0; r < rays.n; ++r) {
        float o[3], d[3];
        for (int axis = 0; axis < 3; ++axis) {
            o[axis] = (rays.origins[3 * r + axis] - f.center[axis]) / f.half;
            d[axis] = rays.directions[3 * r + axis] / f.half;
        }
        marcher.march(o, d, rays.jitter ? rays.jitter[r] : 0.5f, bits + r * marcher.words());
    }
}

// Values at up to a block of points, packed; `at` numbers them in the given arrays.
struct Evaluator {
    const FieldShape& f;
    const FieldParameters& given;
    const nerfvol::FieldPoints& points;
    Layers layers;
    Floats position, encoded, directions, one_direction;
    int64_t at[nerfvol::kFieldBlock];

    Evaluator(const Network& net, const FieldParameters& parameters, const nerfvol::FieldPoints& wanted)
        : f(net.f), given(parameters), points(wanted), layers(net, false), position(std::size_t(3 * nerfvol::kFieldBlock)),
          encoded(std::size_t(encoded_rows(f) * nerfvol::kFieldBlock)), directions(std::size_t(f.encoded_dir * nerfvol::kFieldBlock)) {}

    void run(int n) {
        const int packets = int(padded(n, 2 * kLanes)) / kLanes;
        for (int s = 0; s < packets * kLanes; ++s) {
            const float* x = points.positions + 3 * at[std::min(s, n - 1)];
            for (int axis = 0; axis < 3; ++axis) position[std::size_t((s / kLanes * 3 + axis) * kLanes + s % kLanes)] = (x[axis] - f.center[axis]) / f.half;
        }
        for (int p = 0; p < packets; ++p) {
            to_encoding(f, position.data() + p * 3 * kLanes);
            encode(f, given.table, position.data() + p * 3 * kLanes, encoded.data() + p * layers.stride(0));
        }
        const bool colours = points.values && !f.sh_head;
        if (colours) encode_directions(n, packets);
        layers.run(encoded.data(), directions.data(), packets, colours ? f.n_layers - 1 : f.head, points.values ? 0 : 1);
        for (int p = 0; p < packets; ++p) write(p, std::min(kLanes, n - p * kLanes));
    }

private:
    void encode_directions(int n, int packets) {
        alignas(64) float d[3 * kLanes];
        for (int p = 0; p < packets; ++p) {
            for (int k = 0; k < kLanes; ++k)
                for (int axis = 0; axis < 3; ++axis) d[axis * kLanes + k] = points.directions[3 * at[std::min(p * kLanes + k, n - 1)] + axis];
            encode_frequencies(f.frequencies_dir, d, directions.data() + p * f.encoded_dir * kLanes);
        }
    }

    void write(int p, int n) {
        const float* raw = layers.output(f.head) + p * layers.stride(f.head + 1);
        alignas(64) float sigma[kLanes];
        f16 value, slope;
        activate(f, load<f16>(raw), splat16(f.density_scale), value, slope);
        store(sigma, value);
        for (int k = 0; k < n; ++k) points.sigma[at[p * kLanes + k]] = sigma[k];
        if (!points.values) return;
        const float* rows = f.sh_head ? raw + kLanes : layers.output(f.n_layers - 1) + p * layers.stride(f.n_layers);
        const int count = f.sh_head ? 3 * f.coefficients() : 3;
        alignas(64) float made[48 * kLanes];
        for (int r = 0; r < count; ++r) store(made + r * kLanes, f.sh_head ? load<f16>(rows + r * kLanes) : sigmoid(load<f16>(rows + r * kLanes)));
        for (int k = 0; k < n; ++k)
            for (int r = 0; r < count; ++r) points.values[count * at[p * kLanes + k] + r] = made[r * kLanes + k];
    }
};

inline void evaluate_field(const FieldShape& f, const FieldParameters& given, const nerfvol::FieldPoints& points) {
    constexpr int64_t kPoints = 4096;
    const Network net(f, given.network, false);
    std::unique_ptr<Marcher> marcher;
    if (points.where) marcher = std::make_unique<Marcher>(f, *points.where);
    std::vector<std::unique_ptr<Evaluator>> of_thread(static_cast<std::size_t>(nerfvol::get_threads()));
    const int count = f.sh_head ? 3 * f.coefficients() : 3;
    nerfvol::parallel_for(int((points.n + kPoints - 1) / kPoints), [&](int task, int thread) {
        auto& evaluator = of_thread[std::size_t(thread)];
        if (!evaluator) evaluator = std::make_unique<Evaluator>(net, given, points);
        int n = 0;
        for (int64_t i = int64_t(task) * kPoints; i < std::min(points.n, int64_t(task + 1) * kPoints); ++i) {
            if (marcher && !marcher->occupied(points.positions + 3 * i)) {
                points.sigma[i] = 0;
                if (points.values) std::fill(points.values + count * i, points.values + count * (i + 1), 0.0f);
                continue;
            }
            evaluator->at[n++] = i;
            if (n == nerfvol::kFieldBlock) evaluator->run(n), n = 0;
        }
        if (n) evaluator->run(n);
    });
}

}  // namespace NERFVOL_ISA
