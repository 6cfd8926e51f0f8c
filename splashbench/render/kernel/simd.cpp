// The constants of simd.h.

#include "simd.h"

#include "constants.h"

namespace splash {

const Constants CONSTANTS = {
    all(12582912.0f),
    {all(1.0f), all(6.9314720e-1f), all(2.4022239e-1f), all(5.5503406e-2f), all(9.6769225e-3f), all(1.3400097e-3f)},
    all(LOG2_MIN_ALPHA),
    all(MAX_ALPHA),
    all(MIN_TRANSMITTANCE),
    all(1.0f),
};

}  // namespace splash
