// Sums of rows of tables that carriers share, and gradients summed by what is shared; shared.py says what for.
#pragma once

#include <cstdint>

#include "api.h"

namespace splash {

void sum_rows(const SplashSharedRows&, int64_t count, const int64_t* ids, float* sums, int threads);
void add_by_member(int64_t count, int64_t width, const int64_t* places, const int32_t* members, const float* rows,
                   int64_t groups, float* sums);

}  // namespace splash
