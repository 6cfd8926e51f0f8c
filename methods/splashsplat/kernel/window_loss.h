// Losses of a rendered window against a photograph and its mask; window_loss.py has the equations.
#pragma once

#include "api.h"

namespace splash {

void window_losses(const SplashWindow&, const float* image, const float* alpha, double losses[3], int threads);
void window_gradients(const SplashWindow&, const float* image, const float* alpha, const double weights[3], float* grad_image,
                      float* grad_alpha, int threads);

}  // namespace splash
