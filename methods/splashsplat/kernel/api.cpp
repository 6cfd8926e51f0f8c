// The C interface: checks nothing (the Python files beside it do), and turns exceptions into a status.

#include "api.h"

#include <cstdint>
#include <cstring>

#include "adam.h"
#include "decode.h"
#include "descend.h"
#include "entropy.h"
#include "native/threads.h"
#include "shared.h"
#include "window_loss.h"

namespace {

template <class Work>
int coded(Work work) {
    try {
        return work() ? SPLASH_DONE : SPLASH_NOT_FINITE;
    } catch (...) {  // nothing but std::bad_alloc is thrown
        return SPLASH_OUT_OF_MEMORY;
    }
}

}  // namespace

extern "C" {

int64_t splash_decode_kept(const SplashHeads* heads, int64_t carriers) {
    return splash::blocks_of(carriers) * splash::Rows(*heads).total * splash::BLOCK + splash::ALIGNMENT_FLOATS;
}

int splash_decode(const SplashHeads* heads, const SplashCarriers* carriers, const SplashChildren* children, float* kept,
                  float* cell_colors, double penalties[3], int32_t threads) {
    try {
        splash::decode(splash::Weights(*heads), *carriers, *children, kept == nullptr ? nullptr : splash::aligned(kept),
                       cell_colors, penalties, splash::workers(threads));
        return SPLASH_DONE;
    } catch (...) {  // nothing but std::bad_alloc is thrown
        return SPLASH_OUT_OF_MEMORY;
    }
}

int splash_decode_backward(const SplashHeads* heads, const SplashCarriers* carriers, const float* kept,
                           const float* cell_colors, const SplashChildren* grad_children, const double grad_penalties[3],
                           int32_t threads, const SplashDecoderGradients* gradients) {
    try {
        splash::decode_backward(splash::Weights(*heads), *carriers, splash::aligned(kept), cell_colors, *grad_children,
                                grad_penalties, splash::workers(threads), *gradients);
        return SPLASH_DONE;
    } catch (...) {  // nothing but std::bad_alloc is thrown
        return SPLASH_OUT_OF_MEMORY;
    }
}

void splash_adam_rows(const SplashRowAdam* adam, int64_t count, const int64_t* rows, const float* gradient, float rate,
                      int32_t threads) {
    splash::adam_rows(*adam, count, rows, gradient, rate, splash::workers(threads));
}

void splash_sum_rows(const SplashSharedRows* shared, int64_t count, const int64_t* ids, float* sums, int32_t threads) {
    splash::sum_rows(*shared, count, ids, sums, splash::workers(threads));
}

void splash_add_by_member(int64_t count, int64_t width, const int64_t* places, const int32_t* members, const float* rows,
                          int64_t groups, float* sums) {
    splash::add_by_member(count, width, places, members, rows, groups, sums);
}

int splash_window_losses(const SplashWindow* window, const float* image, const float* opacity, double losses[3],
                         int32_t threads) {
    try {
        splash::window_losses(*window, image, opacity, losses, splash::workers(threads));
        return SPLASH_DONE;
    } catch (...) {  // nothing but std::bad_alloc is thrown
        return SPLASH_OUT_OF_MEMORY;
    }
}

int splash_window_gradients(const SplashWindow* window, const float* image, const float* opacity, const double weights[3],
                            float* grad_image, float* grad_opacity, int32_t threads) {
    try {
        splash::window_gradients(*window, image, opacity, weights, grad_image, grad_opacity, splash::workers(threads));
        return SPLASH_DONE;
    } catch (...) {  // nothing but std::bad_alloc is thrown
        return SPLASH_OUT_OF_MEMORY;
    }
}

void splash_descend(const SplashDescent* descent, float* update, float* residual, int32_t threads) {
    splash::descend(*descent, update, residual, splash::workers(threads));
}

SplashCode* splash_code_begin(const uint8_t* code, int64_t size) {
    try {
        return new SplashCode(code, size);
    } catch (...) {  // nothing but std::bad_alloc is thrown
        return nullptr;
    }
}

void splash_code_end(SplashCode* code) { delete code; }

int splash_code_table(SplashCode* code, int32_t* table, int64_t rows, int32_t columns, int32_t near) {
    return coded([&] { return splash::code_table(*code, table, rows, columns, near); });
}

int splash_code_field(SplashCode* code, int16_t* field, const int64_t shape[5]) {
    return coded([&] { return splash::code_field(*code, field, shape); });
}

int splash_code_frame(SplashCode* code, int8_t* now, const int8_t* before, uint8_t* changed, const int64_t shape[3],
                      int32_t least, int32_t most) {
    return coded([&] { return splash::code_frame(*code, now, before, changed, shape, least, most); });
}

int64_t splash_code_finish(SplashCode* code) {
    try {
        return code->writes ? splash::code_finished(*code) : code->size - code->at;
    } catch (...) {  // nothing but std::bad_alloc is thrown
        return -1;
    }
}

void splash_code_copy(const SplashCode* code, uint8_t* out) {
    if (!code->out.empty()) std::memcpy(out, code->out.data(), code->out.size());
}

const char* splash_kernel(void) { return "splashsplat"; }

int splash_abi_version(void) { return SPLASH_ABI_VERSION; }

}  // extern "C"
