// The renderer's C interface, which ../native.py declares to Python. Arrays are C-contiguous float32 unless said otherwise.
//
// N Gaussians, C channels (0 to 32), H x W pixels, tiles of splash_tile_height() x splash_tile_width() pixels row by row.
#pragma once

#include <stdint.h>

#include "native/abi.h"

#ifdef __cplusplus
extern "C" {
#endif

// Raised with every change to what follows; the loader refuses another version.
#define SPLASH_ABI_VERSION 4

typedef struct SplashCamera {
    double world_to_camera[12];  // [3, 4]: rotation and translation, x right, y down, z forward
    double fx, fy, cx, cy;       // px, pixel centres at +0.5
    int32_t width, height;
} SplashCamera;

typedef struct SplashGaussians {
    int64_t count;           // N
    int32_t channels;        // C
    const float* means;      // [N, 3]
    const float* factors;    // [N, 3, 3], covariance B B^T
    const float* opacities;  // [N]
    const float* colors;     // [N, C]; not read where C is 0
} SplashGaussians;

typedef struct SplashOutput {
    int32_t depth;                 // 1: sum of weight times depth follows the colours as a channel of its own
    int32_t compact;               // 1: planar tiles instead of images
    int32_t background_per_pixel;  // 1: background is [H, W, channels], else [channels]
    const uint8_t* modes;          // [tiles] of 0 skip, 1 opacity, 2 colour; null: all colour
    const float* background;       // null: black
    float* color;                  // [H, W, channels], or [K, channels, tile height, tile width] of the tiles not skipped
    float* opacity;                // [H, W], or [K, tile height, tile width]
} SplashOutput;

typedef struct SplashGradients {
    int32_t add;       // 1: add to what the arrays hold, 0: overwrite
    float* means;      // [N, 3]
    float* factors;    // [N, 3, 3]
    float* opacities;  // [N]
    float* colors;     // [N, C]; null where C is 0
} SplashGradients;

typedef struct SplashFrame SplashFrame;

// Renders. The caller keeps the Gaussians' arrays, the background and `frozen` alive until it releases the frame.
SPLASH_API int splash_forward(const SplashCamera*, const SplashGaussians*, const SplashOutput*, const SplashFrame* frozen,
                              int32_t threads, SplashFrame** frame);

// Projects, sorts and renders Gaussians that later frames of the same camera are merged with. `depth` as in SplashOutput.
SPLASH_API int splash_freeze(const SplashCamera*, const SplashGaussians*, int32_t depth, int32_t threads, SplashFrame** frame);

// Gradients of a loss, given those by the outputs (in their layout; null: zero). May be called again.
SPLASH_API int splash_backward(SplashFrame*, const float* grad_color, const float* grad_opacity, int32_t threads,
                               const SplashGradients*);

// What each Gaussian makes up of an image: the sum over its pixels of the weight with which it is composited there.
// counts: [H, W], how much each pixel counts; null: 1. weights: [N]. Colours are not read.
SPLASH_API int splash_weigh(const SplashCamera*, const SplashGaussians*, const float* counts, const SplashFrame* frozen,
                            int32_t threads, float* weights);

// Gives a frame back; its memory serves the next call.
SPLASH_API void splash_release(SplashFrame*);

// Bytes held by a frame.
SPLASH_API int64_t splash_frame_bytes(const SplashFrame*);

// Counts of a frame: Gaussians drawn, (Gaussian, tile) pairs, tiles with work.
SPLASH_API void splash_frame_counts(const SplashFrame*, int64_t counts[3]);

// Frees the frames kept for later calls (each thread keeps its scratch of one tile).
SPLASH_API void splash_trim(void);

SPLASH_API int splash_tile_width(void);
SPLASH_API int splash_tile_height(void);
SPLASH_API void splash_constants(double values[6]);  // in the order of constants.h

#ifdef __cplusplus
}
#endif
