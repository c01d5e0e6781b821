// The loss of one block of 4x4 pixels and its gradient in the colour: weighted L1 and squared errors, SSIM of the block.
#pragma once
#include "simd_math.h"
#include "splats.h"

namespace NERFVOL_ISA {

using nerfvol::SplatImage;
using nerfvol::SplatLoss;

constexpr float kSsim1 = 1e-4f, kSsim2 = 9e-4f;

// Target colours and weights of a block's sixteen pixels, all in [0, 1].
struct Target {
    f16 colour[3], weight;
    bool whole;                              // no pixel is masked

    Target(const SplatImage& image, int64_t left, int64_t top) {
        i4v pixels[4];
        i4v all = {-1, -1, -1, -1};
        for (int y = 0; y < 4; ++y) {
            std::memcpy(&pixels[y], image.pixels + 4 * ((top + y) * image.columns + left), 16);
            all &= pixels[y];
        }
        const auto channel = [&](int c) {
            f4 rows[4];
            for (int y = 0; y < 4; ++y) rows[y] = __builtin_convertvector((pixels[y] >> (8 * c)) & 255, f4);
            return join(rows[0], rows[1], rows[2], rows[3]) * (1.0f / 255);
        };
        for (int c = 0; c < 3; ++c) colour[c] = channel(c);
        weight = channel(3);
        whole = ((all[0] & all[1] & all[2] & all[3]) >> 24 & 255) == 255;
    }
};

struct LossSums { double loss = 0, squared = 0, weight = 0; };

// 1 - SSIM of one channel of a block; adds `scale` times its gradient in x to g.
inline float add_ssim(const f16& x, const f16& y, float scale, f16& g) {
    const float mu = sum(x) * (1.0f / 16), nu = sum(y) * (1.0f / 16);
    const f16 dx = x - mu, dy = y - nu;
    const float a1 = 2 * mu * nu + kSsim1, a2 = 2 * sum(dx * dy) * (1.0f / 16) + kSsim2;
    const float b1 = mu * mu + nu * nu + kSsim1, b2 = (sum(dx * dx) + sum(dy * dy)) * (1.0f / 16) + kSsim2;
    const float inverse = 1 / (b1 * b2), s = a1 * a2 * inverse;
    const float whole = nu * a2 * inverse - mu * s / b1;
    g -= (dy * (a1 * inverse) - dx * (s / b2) + whole) * (scale * 2 / 16);
    return 1 - s;
}

// A block's share of the loss, times the picture's sum of weights: g gets the gradient in the colour, `error` each pixel's error.
inline void block_loss(const SplatLoss& loss, const Target& target, const f16 (&colour)[3], LossSums& sums, f16 (&g)[3], f16& error) {
    const f16 zero = splat16(0);
    f16 squared = zero, absolute = zero;
    const f16 third = target.weight * (1.0f / 3);
    float ssim = 0;
    for (int c = 0; c < 3; ++c) {
        const f16 e = colour[c] - target.colour[c], size = vmax(e, -e);
        const f16 sign = select_less(e, 0.0f, splat16(-1), select_less(zero, e, splat16(1), zero));
        squared += e * e;
        absolute += size;
        g[c] = third * (sign * loss.l1 + e * (2 * loss.squared));
        // Half of 1 - S, mean over channels, for each of the sixteen pixels.
        const float scale = loss.ssim * (16.0f / 6);
        if (target.whole && scale > 0) ssim += scale * add_ssim(colour[c], target.colour[c], scale, g[c]);
    }
    error = third * (absolute * loss.l1 + squared * loss.squared);
    sums.loss += double(sum(error) + ssim);
    sums.squared += double(sum(third * squared));
    sums.weight += double(sum(target.weight));
}

}  // namespace NERFVOL_ISA
