// The C interface: checks nothing; carving.py does.

#include "api.h"

#include "carve.h"
#include "native/threads.h"

extern "C" {

void splash_carve(const SplashCarving* carving, int32_t threads) { splash::carve(*carving, splash::workers(threads)); }

const char* splash_kernel(void) { return "observe"; }

int splash_abi_version(void) { return SPLASH_ABI_VERSION; }

}  // extern "C"
