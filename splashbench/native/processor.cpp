// Which variant this library is, and which one this processor runs. The processor is asked by hand, because the compilers'
// own question needs a run-time library that not all of them bring.

#include <cpuid.h>

#include <cstring>

#include "abi.h"

namespace {

// Whether the processor has the instructions of x86-64-v3 (AVX2 and its kin), and the system saves their registers.
bool runs_x86_64_v3() {
    unsigned a, b, c, d;
    const unsigned first = bit_FMA | bit_MOVBE | bit_OSXSAVE | bit_AVX | bit_F16C;
    if (!__get_cpuid(1, &a, &b, &c, &d) || (c & first) != first) return false;
    unsigned saved, high;
    __asm__("xgetbv" : "=a"(saved), "=d"(high) : "c"(0));
    const unsigned sse_and_avx = 6;
    if ((saved & sse_and_avx) != sse_and_avx) return false;
    const unsigned second = bit_BMI | bit_AVX2 | bit_BMI2;
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || (b & second) != second) return false;
    return __get_cpuid(0x80000001, &a, &b, &c, &d) && (c & bit_LZCNT) != 0;
}

// And those of x86-64-v4 (the common parts of AVX-512).
bool runs_x86_64_v4() {
    unsigned a, b, c, d, saved, high;
    if (!runs_x86_64_v3()) return false;
    __asm__("xgetbv" : "=a"(saved), "=d"(high) : "c"(0));
    const unsigned all_registers = 0xe6;
    if ((saved & all_registers) != all_registers || !__get_cpuid_count(7, 0, &a, &b, &c, &d)) return false;
    const unsigned common = bit_AVX512F | bit_AVX512DQ | bit_AVX512CD | bit_AVX512BW | bit_AVX512VL;
    return (b & common) == common;
}

}  // namespace

extern "C" int splash_runs(const char* variant) {
    if (std::strcmp(variant, "avx512") == 0) return runs_x86_64_v4();
    if (std::strcmp(variant, "avx2") == 0) return runs_x86_64_v3();
    return std::strcmp(variant, "baseline") == 0;
}

// The avx512 variant is there for those who ask for it: fits take as long by it (docs/renderer.md).
extern "C" const char* splash_best_variant(void) { return runs_x86_64_v3() ? "avx2" : "baseline"; }

extern "C" const char* splash_variant(void) { return SPLASH_VARIANT; }
