// The C interface of SplashSplat's kernel, which library.py declares to Python. Arrays are C-contiguous float32 unless said
// otherwise.
#pragma once

#include <stdint.h>

#include "native/abi.h"

#ifdef __cplusplus
extern "C" {
#endif

// Raised with every change to what follows; the loader refuses another version.
#define SPLASH_ABI_VERSION 4

// Heads that turn n carriers' features into K children each (decode.py): weights [outputs, inputs], biases [outputs].
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

// What is added up for each carrier: a row of its own, [., width], and at each level the row of the table that its cell has.
#define SPLASH_MAX_LEVELS 8
typedef struct SplashSharedRows {
    int64_t width;
    const float* own;
    int32_t levels;                             // up to SPLASH_MAX_LEVELS
    const float* tables[SPLASH_MAX_LEVELS];     // [., width]
    const int32_t* cells[SPLASH_MAX_LEVELS];    // [carriers]
} SplashSharedRows;

// sums [count, width]: of the carriers `ids` [count].
SPLASH_API void splash_sum_rows(const SplashSharedRows*, int64_t count, const int64_t* ids, float* sums, int32_t threads);

// sums [groups, width], overwritten: of the `rows` [count, width] by group, added in their order. Row i is of the group
// members[places[i]]; places: null: members[i].
SPLASH_API void splash_add_by_member(int64_t count, int64_t width, const int64_t* places, const int32_t* members,
                                     const float* rows, int64_t groups, float* sums);

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

// What a velocity is fitted to. shape: of the signed distances' grid; before: [., ., ., 4], phi_t and its gradient; after:
// [., ., .], phi_{t+1}. control: [., ., ., 4], the velocity on a grid of control_shape, voxels a frame, and nothing;
// factor: voxels per control cell. nodes: [., 3], by control cell: those of cell c are starts[c] to starts[c + 1].
// step: share of the displacement that is taken.
typedef struct SplashDescent {
    int32_t shape[3], control_shape[3];
    float factor[3], step;
    const float *before, *after, *control;
    int64_t cells;
    const int64_t* starts;
    const int32_t* nodes;
} SplashDescent;

// Sums over each control cell's nodes: of displacements [cells, 3] and of absolute residuals [cells].
SPLASH_API void splash_descend(const SplashDescent*, float* update, float* residual, int32_t threads);

// Bytes that whole numbers become, or come from (entropy.h). code: to be read, and there until the end; null: to be
// written. Null: out of memory.
typedef struct SplashCode SplashCode;
SPLASH_API SplashCode* splash_code_begin(const uint8_t* code, int64_t size);
SPLASH_API void splash_code_end(SplashCode*);

// What is written or read next: a table [rows, columns] of numbers of up to 31 bits and a sign, whose context are the rows
// before (near 1), and the columns before as well (2); a field [frames, nx, ny, nz, components]; a frame [nx, ny, nz] of
// signed distances from `least` to `most`. before: the frame before it. now: when reading, a copy of it. changed: which
// blocks of 4x4x4 nodes changed last, and then now; zeros at first. SPLASH_NOT_FINITE: no writer gave such a code.
SPLASH_API int splash_code_table(SplashCode*, int32_t* table, int64_t rows, int32_t columns, int32_t near);
SPLASH_API int splash_code_field(SplashCode*, int16_t* field, const int64_t shape[5]);
SPLASH_API int splash_code_frame(SplashCode*, int8_t* now, const int8_t* before, uint8_t* changed, const int64_t shape[3],
                                 int32_t least, int32_t most);

// Ends what is written, and says how many bytes these are; splash_code_copy has them. Negative: out of memory. When
// reading: how many bytes are left, below zero where there were too few.
SPLASH_API int64_t splash_code_finish(SplashCode*);
SPLASH_API void splash_code_copy(const SplashCode*, uint8_t* out);

#ifdef __cplusplus
}
#endif
