// Products of small matrices that stay in the caches: C = A B or C += A B, the columns of B and C in the lanes.
#pragma once

#include <cstdint>

#include "native/simd.h"

namespace splash {

// Rows of `step` floats; element (i, j) of the left factor stands at i * step + j * stride.
struct Left {
    const float* at;
    int64_t step, stride;
};

// ROWS x (VECTORS * LANES) elements of C, held in registers while the sum over `depth` runs.
template <int ROWS, int VECTORS>
inline void multiply_tile(Left a, const float* b, int64_t b_step, float* c, int64_t c_step, int depth, bool add) {
    Floats sums[ROWS][VECTORS];
    for (int i = 0; i < ROWS; ++i) {
        for (int v = 0; v < VECTORS; ++v) sums[i][v] = add ? load(c + i * c_step + v * LANES) : Floats{};
    }
    for (int k = 0; k < depth; ++k) {
        Floats right[VECTORS];
        for (int v = 0; v < VECTORS; ++v) right[v] = load(b + k * b_step + v * LANES);
        for (int i = 0; i < ROWS; ++i) {
            const Floats left = all(a.at[i * a.step + k * a.stride]);
            for (int v = 0; v < VECTORS; ++v) sums[i][v] += left * right[v];
        }
    }
    for (int i = 0; i < ROWS; ++i) {
        for (int v = 0; v < VECTORS; ++v) store(c + i * c_step + v * LANES, sums[i][v]);
    }
}

template <int ROWS>
inline void multiply_rows(Left a, const float* b, int64_t b_step, float* c, int64_t c_step, int depth, int columns, bool add) {
    int column = 0;
    for (; column + 2 * LANES <= columns; column += 2 * LANES) {
        multiply_tile<ROWS, 2>(a, b + column, b_step, c + column, c_step, depth, add);
    }
    if (column < columns) multiply_tile<ROWS, 1>(a, b + column, b_step, c + column, c_step, depth, add);
}

// C [rows, columns] = A [rows, depth] B [depth, columns], added to what C holds where `add`. `columns` is a multiple of
// LANES, B and C are aligned for vectors, their rows b_step and c_step floats long. 6 x 2 sums fill the registers of AVX2.
inline void multiply(Left a, const float* b, int64_t b_step, float* c, int64_t c_step, int rows, int depth, int columns,
                     bool add = false) {
    constexpr int MAX_ROWS = 6;
    for (int row = 0; row < rows; row += MAX_ROWS, a.at += MAX_ROWS * a.step, c += MAX_ROWS * c_step) {
        switch (rows - row) {
            case 1: return multiply_rows<1>(a, b, b_step, c, c_step, depth, columns, add);
            case 2: return multiply_rows<2>(a, b, b_step, c, c_step, depth, columns, add);
            case 3: return multiply_rows<3>(a, b, b_step, c, c_step, depth, columns, add);
            case 4: return multiply_rows<4>(a, b, b_step, c, c_step, depth, columns, add);
            case 5: return multiply_rows<5>(a, b, b_step, c, c_step, depth, columns, add);
            default: multiply_rows<MAX_ROWS>(a, b, b_step, c, c_step, depth, columns, add);
        }
    }
}

}  // namespace splash
