// The constants of thresholds.h.

#include "thresholds.h"

#include "constants.h"

namespace splash {

const Thresholds THRESHOLDS = {all(LOG2_MIN_ALPHA), all(MAX_ALPHA), all(MIN_TRANSMITTANCE), all(1.0f)};

}  // namespace splash
