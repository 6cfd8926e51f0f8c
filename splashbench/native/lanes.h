// Blocks of things that are worked on together: one a lane, each of their quantities a row of BLOCK floats.
#pragma once

#include "simd.h"

namespace splash {

constexpr int BLOCK = 64;
static_assert(BLOCK % (2 * LANES) == 0, "whole tiles of multiply.h");

inline int in_vectors(int count) { return (count + LANES - 1) / LANES * LANES; }

// rows[j][i] = source[i][j] for `count` rows of `width` floats; lanes beyond them are zero, and so are all without a source.
inline void to_lanes(const float* source, int width, int count, float* rows) {
    if (source == nullptr) count = 0;
    for (int i = 0; i < count; ++i) {
        for (int j = 0; j < width; ++j) rows[j * BLOCK + i] = source[i * width + j];
    }
    for (int j = 0; j < width; ++j) {
        for (int i = count; i < BLOCK; ++i) rows[j * BLOCK + i] = 0.0f;
    }
}

// target[i][j] = rows[j][i] for `count` rows of `width` floats, `step` floats apart.
inline void from_lanes(const float* rows, int width, int count, float* target, int step) {
    for (int i = 0; i < count; ++i) {
        for (int j = 0; j < width; ++j) target[i * step + j] = rows[j * BLOCK + i];
    }
}

}  // namespace splash
