// Static anchors to Gaussians (Lu et al. 2024, Sec. 3.2; decode.py has the equations).
//
// Anchors are worked on in blocks (native/lanes.h). The hidden layers of the three heads are one matrix,
//     first [3H, F + 4]: by features, viewing direction and one,
// whose last column holds the biases. Each head's answers are a product of its own.
#pragma once

#include <cstdint>

#include "api.h"
#include "native/buffer.h"
#include "native/lanes.h"

namespace splash {

constexpr int HEADS = 3;

// Where a block's quantities stand, in rows of BLOCK floats: what the backward pass needs of the forward pass.
struct Rows {
    explicit Rows(const SplashHeads& heads)
        : k(heads.children),
          hidden(0),
          opacity(HEADS * heads.hidden),
          shape(opacity + k),
          color(shape + 7 * k),
          extent(color + 3 * k),
          offset(extent + 6),
          direction(offset + 3 * k),
          total(direction + 3) {}

    // The first row of a head's answers; their number is outputs(head).
    int answers(int head) const { return head == 0 ? opacity : head == 1 ? shape : color; }
    int outputs(int head) const { return head == 0 ? k : head == 1 ? 7 * k : 3 * k; }

    int k;
    int hidden;     // H of each head, after the ReLU
    int opacity;    // K, after the tanh
    int shape;      // 7K: of each child three sigmoids, and a quaternion as answered
    int color;      // 3K, after the sigmoid
    int extent;     // 6: exponentials of the log scales
    int offset;     // 3K
    int direction;  // 3
    int total;
};

struct Weights {
    explicit Weights(const SplashHeads& heads);

    const SplashHead& head(int number) const {
        return number == 0 ? heads.opacity : number == 1 ? heads.shape : heads.color;
    }

    SplashHeads heads;
    int inputs;      // F + 4
    int first_step;  // floats in a row of `first`
    Buffer<float> first;
};

// The row of the tables that anchor i has.
inline int64_t row_of(const SplashAnchors& a, int64_t i) { return a.rows == nullptr ? i : a.rows[i]; }

// Columns of a 3 x 3 rotation by the unit quaternion (w, x, y, z): matrix[3 * row + column].
inline void rotation(const Floats q[4], Floats matrix[9]) {
    const Floats &w = q[0], &x = q[1], &y = q[2], &z = q[3];
    matrix[0] = 1.0f - 2.0f * (y * y + z * z);
    matrix[1] = 2.0f * (x * y - w * z);
    matrix[2] = 2.0f * (x * z + w * y);
    matrix[3] = 2.0f * (x * y + w * z);
    matrix[4] = 1.0f - 2.0f * (x * x + z * z);
    matrix[5] = 2.0f * (y * z - w * x);
    matrix[6] = 2.0f * (x * z - w * y);
    matrix[7] = 2.0f * (y * z + w * x);
    matrix[8] = 1.0f - 2.0f * (x * x + y * y);
}

// 1 / |q|, of a quaternion of almost no length 1e12.
inline Floats per_length(const Floats q[4]) {
    return 1.0f / max(all(1e-12f), square_root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]));
}

void decode_anchors(const Weights&, const SplashAnchors&, const SplashChildren&, float* kept, int threads);
void decode_anchors_backward(const Weights&, const SplashAnchors&, const float* kept, const SplashChildren& grad, int threads,
                             const SplashAnchorGradients&);

}  // namespace splash
