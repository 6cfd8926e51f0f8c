// The kernel's C interface, which ../native.py loads. Arrays are C-contiguous float32 unless said otherwise.
//
// N Gaussians, C channels (0 to 32), H x W pixels, tiles of splash_tile_height() x splash_tile_width() pixels row by row.
#pragma once

#include <stdint.h>

#ifdef _WIN32
#define SPLASH_API __declspec(dllexport)
#else
#define SPLASH_API __attribute__((visibility("default")))
#endif

#ifdef __cplusplus
extern "C" {
#endif

// Raised with every change to what follows; the loader refuses another version.
#define SPLASH_ABI_VERSION 2

enum SplashStatus { SPLASH_DONE = 0, SPLASH_NOT_FINITE = 1, SPLASH_OUT_OF_MEMORY = 2, SPLASH_TOO_LARGE = 3 };

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

// Heads that turn n carriers' features into K children each (../decode.py): weights [outputs, inputs], biases [outputs].
typedef struct SplashHeads {
    int32_t features, children, hidden;  // F; K; H, the width of the colour head's hidden layer
    float offset_bound, scale_range, opacity_slope, opacity_band, separation_margin;
    const float *offset_weight, *offset_bias;    // [3K, F], [3K]
    const float *scale_weight, *scale_bias;      // [3K, F], [3K]
    const float *opacity_weight, *opacity_bias;  // [K, F], [K]
    const float *hidden_weight, *hidden_bias;    // [H, F + 3], [H]
    const float *color_weight, *color_bias;      // [3K, H], [3K]
} SplashHeads;

typedef struct SplashCarriers {
    int64_t count;             // n
    const int64_t* rows;       // [n] of the two tables; null: 0 to n - 1
    const float* features;     // table [., F]
    const float* log_scales;   // table [., 3]
    const float* positions;    // [n, 3]
    const float* deformation;  // [n, 3, 3]
    const float* phi;          // [n]
    const float* visibility;   // [n]; null: 1
    float eye[3];
    const int64_t* cells;      // [n], from 0 to cell_count - 1; null: no penalties
    int64_t cell_count;
} SplashCarriers;

// What a carrier's children are, or gradients by it; of gradients null is zero.
typedef struct SplashChildren {
    float* means;      // [n, K, 3]
    float* factors;    // [n, K, 3, 3]
    float* opacities;  // [n, K]
    float* colors;     // [n, K, 3]
    float* offsets;    // [n, K, 3]
} SplashChildren;

// Gradients by what is learned, overwritten.
typedef struct SplashDecoderGradients {
    float *features, *log_scales;  // [n, F], [n, 3]: of the rows used
    float *offset_weight, *offset_bias, *scale_weight, *scale_bias, *opacity_weight, *opacity_bias;
    float *hidden_weight, *hidden_bias, *color_weight, *color_bias;
} SplashDecoderGradients;

// Renders. The caller keeps the Gaussians' arrays, the background and `frozen` alive until it releases the frame.
SPLASH_API int splash_forward(const SplashCamera*, const SplashGaussians*, const SplashOutput*, const SplashFrame* frozen,
                              int32_t threads, SplashFrame** frame);

// Projects, sorts and renders Gaussians that later frames of the same camera are merged with. `depth` as in SplashOutput.
SPLASH_API int splash_freeze(const SplashCamera*, const SplashGaussians*, int32_t depth, int32_t threads, SplashFrame** frame);

// Gradients of a loss, given those by the outputs (in their layout; null: zero). May be called again.
SPLASH_API int splash_backward(SplashFrame*, const float* grad_color, const float* grad_opacity, int32_t threads,
                               const SplashGradients*);

// Gives a frame back; its memory serves the next call.
SPLASH_API void splash_release(SplashFrame*);

// Bytes held by a frame.
SPLASH_API int64_t splash_frame_bytes(const SplashFrame*);

// Counts of a frame: Gaussians drawn, (Gaussian, tile) pairs, tiles with work.
SPLASH_API void splash_frame_counts(const SplashFrame*, int64_t counts[3]);

// Floats that splash_decode keeps for splash_decode_backward.
SPLASH_API int64_t splash_decode_kept(const SplashHeads*, int64_t carriers);

// Decodes. kept: for the backward pass, of splash_decode_kept floats; null: there will be none.
// Where there are cells, also cell_colors [cell_count, 3], the mean colour in each cell, and the penalties: mean trace of
// the covariances, mean squared hinge of the children's distances, mean squared distance of the colours from their cell's.
SPLASH_API int splash_decode(const SplashHeads*, const SplashCarriers*, const SplashChildren*, float* kept,
                             float* cell_colors, double penalties[3], int32_t threads);

// Gradients of a loss, given those by the children and by the penalties.
SPLASH_API int splash_decode_backward(const SplashHeads*, const SplashCarriers*, const float* kept, const float* cell_colors,
                                      const SplashChildren* grad_children, const double grad_penalties[3], int32_t threads,
                                      const SplashDecoderGradients*);

// A step of Adam for some rows of a table [., width]. corrections: [., 2], what the first and the second moment are
// multiplied by after so many steps. rows: each at most once.
typedef struct SplashRowAdam {
    float *table, *first, *second;  // [., width]
    int32_t* steps;                 // [.] taken so far
    int64_t width;
    const float* corrections;
    double beta1, beta2, epsilon;
} SplashRowAdam;
SPLASH_API void splash_adam_rows(const SplashRowAdam*, int64_t count, const int64_t* rows, const float* gradient, float rate,
                                 int32_t threads);

// A rendered window and what is known of it: photograph and mask of a box within; outside, the mask is empty.
typedef struct SplashWindow {
    int32_t width, height;               // of the window
    int32_t left, top, columns, rows;    // the box
    const uint8_t* truth;                // [rows, columns, 3]
    const uint8_t* mask;                 // [rows, columns], 0 or not
} SplashWindow;

// Losses of an image [height, width, 3] and its opacity [height, width]: mean |error| in the mask, mean |step of the error|
// over pairs of neighbours that meet the mask, both within the box; sum of |opacity - mask| over the window.
SPLASH_API int splash_window_losses(const SplashWindow*, const float* image, const float* opacity, double losses[3],
                                    int32_t threads);

// Gradients of the losses' weighted sum.
SPLASH_API int splash_window_gradients(const SplashWindow*, const float* image, const float* opacity, const double weights[3],
                                       float* grad_image, float* grad_opacity, int32_t threads);

// Frees the frames kept for later calls (each thread keeps its scratch of one tile).
SPLASH_API void splash_trim(void);

SPLASH_API int splash_abi_version(void);
SPLASH_API const char* splash_variant(void);       // of this library
SPLASH_API const char* splash_best_variant(void);  // for this processor
SPLASH_API int splash_runs(const char* variant);   // 1: this processor runs it
SPLASH_API int splash_tile_width(void);
SPLASH_API int splash_tile_height(void);
SPLASH_API void splash_constants(double values[6]);  // in the order of constants.h

#ifdef __cplusplus
}
#endif
