// A step of the descent that fits a velocity to two signed distances.
#pragma once

#include "api.h"

namespace splash {

void descend(const SplashDescent&, float* update, float* residual, int threads);

}  // namespace splash
