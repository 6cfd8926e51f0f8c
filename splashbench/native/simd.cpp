// The constants of simd.h.

#include "simd.h"

namespace splash {

const Exp2Constants EXP2 = {
    all(12582912.0f),
    {all(1.0f), all(6.9314720e-1f), all(2.4022239e-1f), all(5.5503406e-2f), all(9.6769225e-3f), all(1.3400097e-3f)},
};

}  // namespace splash
