// Vectors of LANES floats by the compilers' vector extensions (GCC, clang), and the few operations these lack.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <immintrin.h>

#ifndef SPLASH_LANES
#error "SPLASH_LANES (4, 8 or 16 floats per vector) comes from the build file"
#endif

namespace splash {

constexpr int LANES = SPLASH_LANES;

typedef float Floats __attribute__((vector_size(LANES * 4), aligned(LANES * 4)));
typedef int32_t Ints __attribute__((vector_size(LANES * 4), aligned(LANES * 4)));

inline Floats all(float value) { return Floats{} + value; }
inline Ints all(int32_t value) { return Ints{} + value; }
inline Floats load(const float* at) { return *reinterpret_cast<const Floats*>(at); }
inline Ints load(const int32_t* at) { return *reinterpret_cast<const Ints*>(at); }
inline void store(float* at, Floats value) { *reinterpret_cast<Floats*>(at) = value; }
inline void store(int32_t* at, Ints value) { *reinterpret_cast<Ints*>(at) = value; }

// The same at any address.
typedef float UnalignedFloats __attribute__((vector_size(LANES * 4), aligned(4), may_alias));
inline Floats load_anywhere(const float* at) { return *reinterpret_cast<const UnalignedFloats*>(at); }
inline void store_anywhere(float* at, Floats value) { *reinterpret_cast<UnalignedFloats*>(at) = value; }

// By intrinsics: GCC makes two instructions of a comparison and a choice, where the processor has one. Those of AVX-512 take
// a mask of all lanes, which GCC drops again; it warns that the header's plain ones read what was never set.
inline Floats min(Floats a, Floats b) {
#if SPLASH_LANES == 16
    return (Floats)_mm512_maskz_min_ps(0xffff, (__m512)a, (__m512)b);
#elif SPLASH_LANES == 8
    return (Floats)_mm256_min_ps((__m256)a, (__m256)b);
#else
    return (Floats)_mm_min_ps((__m128)a, (__m128)b);
#endif
}

inline Floats max(Floats a, Floats b) {
#if SPLASH_LANES == 16
    return (Floats)_mm512_maskz_max_ps(0xffff, (__m512)a, (__m512)b);
#elif SPLASH_LANES == 8
    return (Floats)_mm256_max_ps((__m256)a, (__m256)b);
#else
    return (Floats)_mm_max_ps((__m128)a, (__m128)b);
#endif
}

// `value` where the mask is set, 0 elsewhere, whatever `value` holds there.
inline Floats where(Ints mask, Floats value) { return (Floats)((Ints)value & mask); }

inline Floats square_root(Floats value) {
    Floats root;
    for (int lane = 0; lane < LANES; ++lane) root[lane] = std::sqrt(value[lane]);
    return root;
}

// 0, 1, 2, ...
inline Floats ramp() {
    Floats values;
    for (int lane = 0; lane < LANES; ++lane) values[lane] = static_cast<float>(lane);
    return values;
}

// Whether any lane of the mask (all bits or none) is set.
inline bool any(Ints mask) {
#if SPLASH_LANES == 16
    return _mm512_movepi32_mask((__m512i)mask) != 0;
#elif SPLASH_LANES == 8
    return _mm256_movemask_ps((__m256)mask) != 0;
#else
    return _mm_movemask_ps((__m128)mask) != 0;
#endif
}

// Sum of the lanes, always in the same order.
inline float sum(Floats value) {
    typedef float Four __attribute__((vector_size(16)));
    Four parts[LANES / 4];
    std::memcpy(parts, &value, sizeof value);
    Four four = parts[0];
    for (int part = 1; part < LANES / 4; ++part) four += parts[part];
    return (four[0] + four[2]) + (four[1] + four[3]);
}

inline int32_t largest(Ints value) {
    int32_t result = value[0];
    for (int lane = 1; lane < LANES; ++lane) result = value[lane] > result ? value[lane] : result;
    return result;
}

// Constants of exp2. They stand in memory, out of the compiler's sight (simd.cpp): it would rather spread each from one
// float anew in every turn of a loop than read the vector as an operand.
struct Exp2Constants {
    Floats rounding;
    Floats polynomial[6];
};
extern const Exp2Constants EXP2;

// 2^x for x in [-30, 1], relative error below 3e-7: the integer part goes into the exponent, a polynomial takes the rest
// (in [-1/2, 1/2]). Adding 1.5 * 2^23 rounds to an integer that stands in the low bits of the sum.
inline Floats exp2(Floats x) {
    const Floats rounding = EXP2.rounding;
    const Floats shifted = x + rounding;
    const Ints exponent = (Ints)shifted << 23;
    const Floats f = x - (shifted - rounding);
    Floats p = EXP2.polynomial[5];
    for (int i = 4; i >= 0; --i) p = p * f + EXP2.polynomial[i];
    return (Floats)((Ints)p + exponent);
}

inline void prefetch(const void* at) { __builtin_prefetch(at); }

}  // namespace splash
