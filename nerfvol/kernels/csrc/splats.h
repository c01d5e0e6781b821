// Views of the arrays that Python owns for Gaussian splats, and the parameters of their operators. Plain data, shared by all
// instruction sets. Equations: nerfvol/kernels/splat_reference.py.
#pragma once
#include <cstdint>

namespace nerfvol {

constexpr int kSplatTile = 16;      // pixels along a tile: 4x4 blocks of 4x4 pixels
constexpr int kSplatLanes = 16;     // Gaussians in a block of parameters

// Rows of a block of parameters: see nerfvol/splats/packing.py.
enum SplatRow { kMean = 0, kLogScale = 3, kQuat = 6, kLogit = 10, kSh = 11 };

struct Splats {
    const float* params;            // (n_blocks, 11 + 3 K, 16), cache lines
    int64_t n_blocks, n;
    int basis;                      // K = (degree + 1)^2
    bool mip;                       // opacities are scaled by rho, so that the low-pass filter keeps the light
    int rows() const { return kSh + 3 * basis; }
};

// A pinhole camera; axes x right, y down, z forward; pixel centres end in 1/2.
struct SplatView {
    float rotation[9], translation[3], eye[3];  // world to camera, row by row; the camera's centre; relative to the origin
    float fx, fy, cx, cy, near;                 // pixels; scene units
    int64_t width, height;
};

struct SplatRenderOptions {
    float background[3];
    float early_stop_eps;
};

struct SplatOutput {                // (height, width[, 3]); null = not wanted
    float *rgb, *opacity, *depth, *median_depth, *normal;
};

// What a step minimises, see splat_reference.loss. All terms are means over the picture's valid pixels.
struct SplatLoss {
    float background[3] = {1, 1, 1};
    float l1 = 0, squared = 1, ssim = 0;        // weights of the terms of a pixel, and of a block of 4x4
    float scale = 0, opacity = 0;               // weights of the mean size (1 / scene unit) and of the mean opacity
    float early_stop_eps = 3e-3f;
    float weight_threshold = 4e-3f;             // a tile in which a Gaussian stays below leaves it no gradient
};

// Adam with each Gaussian's own number of updates. The rate of the means is a factor of the Gaussian's size.
struct SplatRates {
    float means = 0, log_scales = 0, quats = 0, logits = 0, dc = 0, sh = 0;
    float beta1 = 0.9f, beta2 = 0.98f, eps = 1e-12f;
    float most_log_ratio = 0;                   // of the longest scale to the second; 0: any
};

struct SplatImage {                 // RGBA, rows and columns padded to multiples of 16; alpha is the pixel's weight
    const uint8_t* pixels;
    int64_t rows, columns;
};

struct SplatMemory {                // (n_blocks, rows, 16) and (n_blocks, 16), updated in place
    float *params, *first, *second, *updates;
    float *error, *max_weight, *seen;
    float* gradient;                // (n_blocks, rows, 16) instead of an update: then nothing else changes
    bool motion;                    // whether the report has the gradient in the camera's motion
};

struct SplatReport {
    double loss, squared_error;     // per valid pixel; squared error also per channel
    double pixels;                  // sum of weights
    int64_t visible, entries, blocks;
    double motion[6];               // gradient of the loss in (w, v), where the camera's axes see t + w x t + v for t
};

struct SplatKernels {
    void (*render)(const Splats&, const SplatView&, const SplatRenderOptions&, const SplatOutput&);
    void (*points)(const Splats&, const SplatView&, const SplatRenderOptions&, const SplatOutput&);
    SplatReport (*step)(const Splats&, const SplatView&, const SplatImage&, const SplatLoss&, const SplatRates&, const SplatMemory&);
};

}  // namespace nerfvol
