// A batch of training rays from tiles of the training pictures: rotated directions and colours.
#include "batch.h"

#include "pool.h"

namespace nerfvol {

void gather_tiles(const TileSources& from, const int64_t* image, const int64_t* tile, const int64_t* row, int64_t n,
                  float* directions, float* target) {
    constexpr int64_t kChunk = 16, kRow = 3 * kTile;
    parallel_for(int((n + kChunk - 1) / kChunk), [&](int chunk, int) {
        for (int64_t i = chunk * kChunk; i < n && i < (chunk + 1) * kChunk; ++i) {
            const float* camera = from.directions[std::size_t(image[i])] + kRow * tile[i];
            const uint8_t* colours = from.pixels[std::size_t(image[i])] + kRow * row[i];
            const float* r = from.rotations + 9 * image[i];
            float *d = directions + kRow * i, *c = target + kRow * i;
            for (int l = 0; l < kTile; ++l)
                for (int axis = 0; axis < 3; ++axis)
                    d[3 * l + axis] = r[3 * axis] * camera[3 * l] + r[3 * axis + 1] * camera[3 * l + 1] + r[3 * axis + 2] * camera[3 * l + 2];
            for (int k = 0; k < kRow; ++k) c[k] = float(colours[k]) * (1.0f / 255.0f);
        }
    });
}

}  // namespace nerfvol
