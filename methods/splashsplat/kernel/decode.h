// Carriers to Gaussians (paper, "Decoding Carriers into Gaussians"; decode.py has the equations).
//
// Carriers are worked on in blocks of BLOCK, one carrier a lane, each quantity a row of BLOCK floats. The heads' weights
// are packed into two matrices, so that a block passes through all heads by two products:
//     first  [7K + H, F + 4]: offset, scale, opacity and hidden rows by features, viewing direction and one,
//     second [3K, H + 1]: colour by hidden units and one.
// The columns for one hold the biases; the linear heads' columns for the direction are zero, and their gradient unused.
#pragma once

#include <cstdint>

#include "api.h"
#include "native/buffer.h"
#include "native/lanes.h"

namespace splash {

// Where a block's quantities stand, in rows of BLOCK floats: what the backward pass needs of the forward pass.
struct Rows {
    explicit Rows(const SplashHeads& heads)
        : k(heads.children),
          offset(0),
          scale(3 * k),
          opacity(6 * k),
          hidden(7 * k),
          one(hidden + heads.hidden),
          color(one + 1),
          extent(color + 3 * k),
          base(extent + 3 * k),
          fade(base + 3),
          direction(fade + 1),
          deformation(direction + 3),
          total(deformation + 9) {}

    int k;
    int offset, scale;  // 3K each: tanh of the heads' answers, tanh of half of them
    int opacity;        // K, before the fade
    int hidden, one;    // H after the ReLU; then ones
    int color, extent;  // 3K each
    int base;           // 3
    int fade;           // 1, visibility included
    int direction;      // 3
    int deformation;    // 9
    int total;
};

struct Weights {
    explicit Weights(const SplashHeads& heads);

    SplashHeads heads;
    int inputs, outputs;            // F + 4, 7K + H
    int first_step, second_step;    // floats in a row of each matrix
    Buffer<float> first, second;
};

// The row of the tables that carrier i has.
inline int64_t row_of(const SplashCarriers& c, int64_t i) { return c.rows == nullptr ? i : c.rows[i]; }

// Asks for the features of the carrier one block after carrier i: rows lie all over the table.
inline void prefetch_features(const SplashCarriers& c, int size, int64_t i) {
    if (i + BLOCK >= c.count) return;
    const float* const next = c.features + row_of(c, i + BLOCK) * size;
    for (int j = 0; j < size; j += 16) prefetch(next + j);
}

void decode(const Weights&, const SplashCarriers&, const SplashChildren&, float* kept, float* cell_colors,
            double penalties[3], int threads);
void decode_backward(const Weights&, const SplashCarriers&, const float* kept, const float* cell_colors,
                     const SplashChildren& grad, const double grad_penalties[3], int threads, const SplashDecoderGradients&);

}  // namespace splash
