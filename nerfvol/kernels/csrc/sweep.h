// Plane sweep: the inverse depth of a picture's pixels from how well other pictures agree there (starts/plane_sweep.py).
#pragma once
#include <cstdint>
#include <vector>

namespace nerfvol {

// grey: (height, width) in [0, 1]. mask: 1 where there is a picture, or null where it is one everywhere.
struct Grey {
    const float* grey;
    const uint8_t* mask;
    int height, width;
};

// The pictures that one reference is compared with. Row by row `map` holds A (3x3) and b (3): what the reference sees at
// pixel (x, y) and inverse depth w lies at A (x, y, 1) + w b in the other picture, in homogeneous pixels.
struct Comparison {
    int picture;
    float map[12];
};

struct Reference {
    int picture;
    std::vector<Comparison> others;
    int apart;  // planes between the best and another that may be its rival
    // Outputs (height, width): inverse depth between planes, its score in [-1, 1] (-1: none), its best rival's score.
    float *inverse_depth, *score, *rival;
};

// Planes: n of them, inverse depths from `first` in steps of `step`. References are worked on in parallel, each by one
// thread alone, so that results do not depend on the number of threads.
void plane_sweep(const std::vector<Grey>& pictures, const std::vector<Reference>& references, int n, float first, float step);

}  // namespace nerfvol
