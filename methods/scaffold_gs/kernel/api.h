// The C interface of Scaffold-GS's kernel, which library.py declares to Python. Arrays are C-contiguous float32 unless said
// otherwise.
#pragma once

#include <stdint.h>

#include "native/abi.h"

#ifdef __cplusplus
extern "C" {
#endif

// Raised with every change to what follows; the loader refuses another version.
#define SPLASH_ABI_VERSION 1

// A network with one hidden layer that reads an anchor's feature and the viewing direction: weights [outputs, inputs].
typedef struct SplashHead {
    const float *hidden_weight, *hidden_bias;  // [H, F + 3], [H]
    const float *output_weight, *output_bias;  // [outputs, H], [outputs]
} SplashHead;

// The heads that turn an anchor's feature into K children (decode.py): K, 7K and 3K outputs.
typedef struct SplashHeads {
    int32_t features, children, hidden;  // F; K; H
    int32_t shape_sees_direction;        // 0: zeros in the direction's place for opacity and shape
    int32_t base_color;                  // 1: the first three features are added to the colours' logits
    SplashHead opacity, shape, color;
} SplashHeads;

typedef struct SplashAnchors {
    int64_t count;            // n, those that are decoded
    const int64_t* rows;      // [n] of the tables, each at most once; null: 0 to n - 1
    const float* features;    // table [., F]
    const float* offsets;     // table [., K, 3]
    const float* log_scales;  // table [., 6]
    const float* positions;   // table [., 3]
    float eye[3];
} SplashAnchors;

// What an anchor's children are, or gradients by it; of gradients null is zero.
typedef struct SplashChildren {
    float* means;      // [n, K, 3]
    float* factors;    // [n, K, 3, 3]
    float* opacities;  // [n, K]
    float* colors;     // [n, K, 3]
    float* scales;     // [n, K, 3]
} SplashChildren;

// Gradients by what is learned. Rows of the tables that are not decoded stay as they are; all else is overwritten.
typedef struct SplashHeadGradients {
    float *hidden_weight, *hidden_bias, *output_weight, *output_bias;
} SplashHeadGradients;

typedef struct SplashAnchorGradients {
    float *features, *offsets, *log_scales;  // as the tables
    SplashHeadGradients opacity, shape, color;
} SplashAnchorGradients;

// Floats that splash_anchors keeps for splash_anchors_backward.
SPLASH_API int64_t splash_anchors_kept(const SplashHeads*, int64_t anchors);

// Decodes. kept: for the backward pass, of splash_anchors_kept floats; null: there will be none.
SPLASH_API int splash_anchors(const SplashHeads*, const SplashAnchors*, const SplashChildren*, float* kept, int32_t threads);

// Gradients of a loss, given those by the children.
SPLASH_API int splash_anchors_backward(const SplashHeads*, const SplashAnchors*, const float* kept,
                                       const SplashChildren* grad_children, int32_t threads, const SplashAnchorGradients*);

#ifdef __cplusplus
}
#endif
