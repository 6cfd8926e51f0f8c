// The C interface: checks nothing (the Python files beside it do), and turns exceptions into a status.

#include "api.h"

#include <cstdint>

#include "anchors.h"
#include "native/threads.h"

extern "C" {

int64_t splash_anchors_kept(const SplashHeads* heads, int64_t anchors) {
    return splash::blocks_of(anchors) * splash::Rows(*heads).total * splash::BLOCK + splash::ALIGNMENT_FLOATS;
}

int splash_anchors(const SplashHeads* heads, const SplashAnchors* anchors, const SplashChildren* children, float* kept,
                   int32_t threads) {
    try {
        splash::decode_anchors(splash::Weights(*heads), *anchors, *children, kept == nullptr ? nullptr : splash::aligned(kept),
                               splash::workers(threads));
        return SPLASH_DONE;
    } catch (...) {  // nothing but std::bad_alloc is thrown
        return SPLASH_OUT_OF_MEMORY;
    }
}

int splash_anchors_backward(const SplashHeads* heads, const SplashAnchors* anchors, const float* kept,
                            const SplashChildren* grad_children, int32_t threads, const SplashAnchorGradients* gradients) {
    try {
        splash::decode_anchors_backward(splash::Weights(*heads), *anchors, splash::aligned(kept), *grad_children,
                                        splash::workers(threads), *gradients);
        return SPLASH_DONE;
    } catch (...) {  // nothing but std::bad_alloc is thrown
        return SPLASH_OUT_OF_MEMORY;
    }
}

const char* splash_kernel(void) { return "scaffold_gs"; }

int splash_abi_version(void) { return SPLASH_ABI_VERSION; }

}  // extern "C"
