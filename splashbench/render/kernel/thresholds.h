// Thresholds of constants.h as vectors, for the loops over pixels; in memory for the reason that simd.h gives.
#pragma once

#include "native/simd.h"

namespace splash {

struct Thresholds {
    Floats log2_min_alpha, max_alpha, min_transmittance, one;
};
extern const Thresholds THRESHOLDS;

}  // namespace splash
