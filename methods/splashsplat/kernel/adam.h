// Adam for some rows of a table; row_adam.py has the equations.
#pragma once

#include <cstdint>

#include "api.h"

namespace splash {

void adam_rows(const SplashRowAdam&, int64_t count, const int64_t* rows, const float* gradient, float rate, int threads);

}  // namespace splash
