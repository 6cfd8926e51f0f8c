// SSIM of two images and its gradient (ssim.py has the formula).
#pragma once

#include "api.h"

namespace splash {

// Throws std::bad_alloc.
void ssim(const SplashSsim& images, double* totals, float* gradient, int threads);

}  // namespace splash
