// The C interface of the kernel of training losses, which ssim.py declares to Python. Arrays are C-contiguous unless said.
#pragma once

#include <stdint.h>

#include "native/abi.h"

#ifdef __cplusplus
extern "C" {
#endif

// Raised with every change to what follows; the loader refuses another version.
#define SPLASH_ABI_VERSION 1

// An image and the one that it is compared with.
typedef struct SplashSsim {
    int32_t height, width, channels;
    const float* image;    // [height, width, channels], rows `stride` floats apart
    int64_t stride;
    const float* truth;    // [height, width, channels]; null: truth_bytes are
    const uint8_t* truth_bytes;  // likewise, 255ths; null: truth is
    const float* weight;   // [height, width], what the image is multiplied by, and its gradient; null: 1
    const float* window;   // [11] of the blur along rows and along columns
    float c1, c2;
} SplashSsim;

// totals: [channels], SSIM summed over pixels. gradient: [height, width, channels], of the mean by the image.
SPLASH_API int splash_ssim(const SplashSsim*, double* totals, float* gradient, int32_t threads);

#ifdef __cplusplus
}
#endif
