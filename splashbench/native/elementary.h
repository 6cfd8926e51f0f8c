// Elementary functions of vectors. NaN stays NaN.
#pragma once

#include "simd.h"

namespace splash {

constexpr float LOG2_E = 1.4426950408889634f;
constexpr float LN_2 = 0.6931471805599453f;

// e^x, relative error below 1e-6 for |x| < 10 and below 1e-5 elsewhere; clamped to [2^-125, 2^125].
inline Floats exp(Floats x) {
    const Floats power = x * LOG2_E;
    // Where an operand is NaN, min and max give the second one.
    return exp2(max(all(-125.0f), min(all(125.0f), power)));
}

// 1 / (1 + e^-x)
inline Floats sigmoid(Floats x) { return 1.0f / (1.0f + exp(-x)); }

// Absolute error below 1e-6.
inline Floats tanh(Floats x) { return 1.0f - 2.0f / (1.0f + exp(x + x)); }

inline Floats absolute(Floats x) { return max(x, -x); }

}  // namespace splash
