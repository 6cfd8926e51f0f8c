// What every compiled kernel exports besides its own functions; library.py reads it.
#pragma once

#include <stdint.h>

#define SPLASH_API __attribute__((visibility("default")))

#ifdef __cplusplus
extern "C" {
#endif

enum SplashStatus { SPLASH_DONE = 0, SPLASH_NOT_FINITE = 1, SPLASH_OUT_OF_MEMORY = 2, SPLASH_TOO_LARGE = 3 };

// Each kernel's api.cpp defines these two.
SPLASH_API const char* splash_kernel(void);  // its name, that of the folder above its sources
SPLASH_API int splash_abi_version(void);     // of its own interface

SPLASH_API const char* splash_variant(void);       // of this library
SPLASH_API const char* splash_best_variant(void);  // for this processor
SPLASH_API int splash_runs(const char* variant);   // 1: this processor runs it

#ifdef __cplusplus
}
#endif
