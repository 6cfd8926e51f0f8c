// Blocks of things that are worked on together: one a lane, each of their quantities a row of BLOCK floats.
#pragma once

#include <cstdint>

#include "simd.h"

namespace splash {

constexpr int BLOCK = 64;
static_assert(BLOCK % (2 * LANES) == 0, "whole tiles of multiply.h");

// Sums are taken piece by piece and then in the pieces' order, whoever computed them.
constexpr int BLOCKS_PER_PIECE = 8;

// The things of one block.
struct Part {
    int64_t begin;
    int count;
};

inline int64_t blocks_of(int64_t count) { return (count + BLOCK - 1) / BLOCK; }
inline int64_t pieces_of(int64_t count) { return (blocks_of(count) + BLOCKS_PER_PIECE - 1) / BLOCKS_PER_PIECE; }
inline Part part_of(int64_t count, int64_t block) {
    const int64_t begin = block * BLOCK;
    return {begin, static_cast<int>(count - begin < BLOCK ? count - begin : BLOCK)};
}

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
