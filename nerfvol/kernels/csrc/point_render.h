// Pictures of points: surface by surface, each the weighted mean of the points that make it.
#pragma once
#include "points.h"
#include "splat_render.h"

namespace NERFVOL_ISA {

// A point on the sixteen pixels of a block: weights (0: not, or in an earlier surface) and distances along the axis.
struct PointOnBlock { f16 weight, depth; uint32_t rank; };

// The sums of a block's pixels.
struct BlockSums {
    f16 colour[3], normal[3], depth, median, passed;
    BlockSums() {
        for (f16* v : {&colour[0], &colour[1], &colour[2], &normal[0], &normal[1], &normal[2], &depth, &median}) *v = splat16(0);
        passed = splat16(1);
    }
};

// Reads a tile's list for one of its blocks.
class PointBlock {
public:
    PointBlock(const Frame& f, const PointFrame& p, int64_t tile, int block, float left, float top, Buffer<PointOnBlock>& kept)
        : frame_(f), points_(p), kept_(kept), next_(f.first_entry[size_t(tile)]), end_(f.first_entry[size_t(tile) + 1]),
          block_(block), x_(load<f16>(kLaneX) + (left + kBlockX[block] + 0.5f)),
          y_(load<f16>(kLaneY) + (top + kBlockY[block] + 0.5f)) {}

    BlockSums composite(float eps) {
        BlockSums sums;
        const f16 zero = splat16(0), one = splat16(1);
        eps = std::max(eps, 1e-9f);
        for (int surface = 0; surface < kMostSurfaces; ++surface) {
            const f16 alive = select_less(sums.passed, eps, zero, one);
            if (!greater_bits(alive, zero)) break;
            const f16 limit = nearest(alive);
            if (!greater_bits(splat16(kFar), limit)) break;      // nothing is left on any pixel
            take(limit, alive, sums);
        }
        return sums;
    }

private:
    const Frame& frame_;
    const PointFrame& points_;
    Buffer<PointOnBlock>& kept_;
    uint64_t next_, end_;
    size_t n_ = 0;
    int block_;
    f16 x_, y_;

    // How far the surface that is next reaches; kFar where there is none, and where the pixel has ended.
    f16 nearest(const f16& alive) {
        f16 first = splat16(kFar), limit = splat16(kFar);
        const f16 none = splat16(-kFar);
        const auto look = [&](const PointOnBlock& q) {
            const f16 d = select_less(splat16(0), q.weight, q.depth, splat16(kFar));
            limit = select_less(d, first, d + points_.points[frame_.sorted[q.rank].id].slab, limit);
            first = vmin(first, d);
        };
        for (size_t i = 0; i < n_; ++i) look(kept_[i]);
        for (; next_ < end_; ++next_) {
            const TileEntry entry = frame_.entries[next_];
            if (!(entry.mask() >> block_ & 1)) continue;
            const f16 open = select_less(splat16(0), alive, limit, none);
            if (greater_bits(splat16(points_.floors[next_]), open) == 0xffff) break;
            if (read(entry.rank(), alive)) look(kept_[n_ - 1]);
        }
        return select_less(splat16(0), alive, limit, splat16(kFar));
    }

    // Keeps a point if it is on a pixel that is alive.
    bool read(uint32_t rank, const f16& alive) {
        const Record& g = frame_.sorted[rank];
        const PointRecord& q = points_.points[g.id];
        const f16 px = x_ - g.x, py = y_ - g.y, zero = splat16(0);
        const f16 power = px * (px * g.a + py * g.b) + py * (py * g.c);
        f16 weight = select_less(splat16(0.5f * kReach * kReach * kLog2e), power, zero, vexp2(q.log2_weight - power)) * alive;
        if (!greater_bits(weight, zero)) return false;
        PointOnBlock* out = kept_.need_keeping(n_ + 1, n_) + n_;
        store(&out->weight, weight);
        f16 depth = splat16(g.z);
        if (q.plane[0] != 0 || q.plane[1] != 0 || q.plane[2] != 0) {
            // Seen edge on a plane may be anywhere within a pixel; the disc ends a slab from its mean.
            const f16 inverse = vmax(x_ * q.plane[0] + y_ * q.plane[1] + q.plane[2], splat16(1e-30f));
            depth = vmin(vmax(1.0f / inverse, splat16(g.z - q.slab)), splat16(g.z + q.slab));
        }
        store(&out->depth, depth);
        out->rank = rank;
        ++n_;
        return true;
    }

    // Composites what lies before `limit`, and forgets it.
    void take(const f16& limit, const f16& alive, BlockSums& sums) {
        const f16 zero = splat16(0), one = splat16(1);
        f16 total = zero, depth = zero, colour[3] = {zero, zero, zero}, normal[3] = {zero, zero, zero};
        size_t left = 0;
        const f16 open = select_less(limit, kFar, limit, splat16(-kFar));
        for (size_t i = 0; i < n_; ++i) {
            const PointOnBlock q = kept_[i];
            const Record& g = frame_.sorted[q.rank];
            const float* n = points_.points[g.id].normal;
            const f16 share = select_less(open, q.depth, zero, q.weight);
            total += share;
            depth += share * q.depth;
            for (int c = 0; c < 3; ++c) {
                colour[c] += share * g.colour[c];
                normal[c] += share * n[c];
            }
            const f16 rest = (q.weight - share) * alive;
            if (greater_bits(rest, zero)) {
                store(&kept_[left].weight, rest);
                store(&kept_[left].depth, q.depth);
                kept_[left++].rank = q.rank;
            }
        }
        n_ = left;
        const f16 inverse = select_less(zero, total, 1.0f / vmax(total, splat16(1e-30f)), zero);
        const f16 cover = vmin(total, one), w = sums.passed * cover * inverse, after = sums.passed * (one - cover);
        for (int c = 0; c < 3; ++c) {
            sums.colour[c] += w * colour[c];
            sums.normal[c] += w * normal[c];
        }
        sums.depth += w * depth;
        const f16 half = splat16(0.5f), crossed = select_less(half, sums.passed, select_less(half, after, zero, one), zero);
        sums.median += crossed * (depth * inverse);
        sums.passed = after;
    }
};

struct PointTile { alignas(64) float colour[3][16][16], normal[3][16][16], depth[16][16], median[16][16], opacity[16][16]; };

inline void render_point_tile(const Frame& f, PointFrame& p, const SplatView& v, int64_t tile, const SplatRenderOptions& options,
                              const SplatOutput& out, Buffer<PointOnBlock>& kept) {
    const TileGrid grid(v);
    const int64_t left = 16 * (tile % grid.columns), top = 16 * (tile / grid.columns);
    find_floors(f, p, tile);
    PointTile t;
    for (int block = 0; block < 16; ++block) {
        const BlockSums sums = PointBlock(f, p, tile, block, float(left), float(top), kept).composite(options.early_stop_eps);
        for (int c = 0; c < 3; ++c) {
            store(t.colour[c][block], sums.colour[c] + sums.passed * options.background[c]);
            store(t.normal[c][block], sums.normal[c]);
        }
        store(t.depth[block], sums.depth);
        store(t.median[block], sums.median);
        store(t.opacity[block], 1.0f - sums.passed);
    }
    along_rays(t.depth, v, float(left), float(top));
    along_rays(t.median, v, float(left), float(top));
    for (int c = 0; c < 3; ++c) {
        if (out.rgb) copy_tile(t.colour[c], out.rgb + c, 3, v, left, top);
        if (out.normal) copy_tile(t.normal[c], out.normal + c, 3, v, left, top);
    }
    if (out.opacity) copy_tile(t.opacity, out.opacity, 1, v, left, top);
    if (out.depth) copy_tile(t.depth, out.depth, 1, v, left, top);
    if (out.median_depth) copy_tile(t.median, out.median_depth, 1, v, left, top);
}

// Splats of degree 0 that are points of surfaces.
inline void render_points(const Splats& splats, const SplatView& view, const SplatRenderOptions& options, const SplatOutput& out) {
    static PointFrame points;
    static std::vector<Buffer<PointOnBlock>> kept;               // of each thread
    const std::lock_guard<std::mutex> lock(one_splat_call());
    Frame& frame = shared_frame();
    PointRecord* records = points.points.need(size_t(16 * splats.n_blocks));
    project_chunks(splats, view, frame, [&](const float* block, int64_t b, Record* to) {
        return project_points(block, view, splats.mip, uint32_t(16 * b), to, records + 16 * b);
    });
    sort_by_depth(frame);
    make_lists(frame, TileGrid(view), 16 * splats.n_blocks);
    points.floors.need(size_t(frame.first_entry.back()));
    if (kept.size() < size_t(nerfvol::get_threads())) kept.resize(size_t(nerfvol::get_threads()));
    splat_for(TileGrid(view).size(), [&](int tile, int thread) {
        render_point_tile(frame, points, view, tile, options, out, kept[size_t(thread)]);
    });
}

}  // namespace NERFVOL_ISA
