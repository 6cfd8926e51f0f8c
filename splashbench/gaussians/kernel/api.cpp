// The C interface: checks nothing; ssim.py does.

#include "api.h"

#include <new>

#include "native/threads.h"
#include "ssim.h"

extern "C" {

int splash_ssim(const SplashSsim* images, double* totals, float* gradient, int32_t threads) {
    try {
        splash::ssim(*images, totals, gradient, splash::workers(threads));
    } catch (const std::bad_alloc&) {
        return SPLASH_OUT_OF_MEMORY;
    }
    return SPLASH_DONE;
}

const char* splash_kernel(void) { return "gaussians"; }

int splash_abi_version(void) { return SPLASH_ABI_VERSION; }

}  // extern "C"
