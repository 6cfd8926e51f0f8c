// Adam (Kingma and Ba 2015) for some rows of a table, with a step count for each row.

#include <cmath>

#include "adam.h"
#include "native/simd.h"
#include "native/threads.h"

namespace splash {

// Fewer rows than these are not worth a second thread.
constexpr int64_t ROWS_PER_PIECE = 1024;
// Rows lie all over the table: each is asked for so many rows ahead.
constexpr int64_t AHEAD = 8;

void adam_rows(const SplashRowAdam& adam, int64_t count, const int64_t* rows, const float* gradient, float rate, int threads) {
    const int64_t width = adam.width;
    const float decay1 = static_cast<float>(adam.beta1), decay2 = static_cast<float>(adam.beta2);
    const float share1 = static_cast<float>(1.0 - adam.beta1), share2 = static_cast<float>(1.0 - adam.beta2);
    const float epsilon = static_cast<float>(adam.epsilon);
    in_pieces(threads, count, ROWS_PER_PIECE, [&](int64_t begin, int64_t end, int) {
        for (int64_t i = begin; i < end; ++i) {
            if (i + AHEAD < count) {
                const int64_t later = rows[i + AHEAD] * width;
                for (int64_t j = 0; j < width; j += 16) {
                    prefetch(adam.table + later + j);
                    prefetch(adam.first + later + j);
                    prefetch(adam.second + later + j);
                }
            }
            const int64_t row = rows[i];
            const float* const correction = adam.corrections + 2 * ++adam.steps[row];
            const float step = rate * correction[0], unbias = correction[1];
            const float* const g = gradient + i * width;
            float* const value = adam.table + row * width;
            float* const first = adam.first + row * width;
            float* const second = adam.second + row * width;
            int64_t j = 0;
            for (; j + LANES <= width; j += LANES) {
                const Floats slope = load_anywhere(g + j);
                const Floats mean = decay1 * load_anywhere(first + j) + share1 * slope;
                const Floats square = decay2 * load_anywhere(second + j) + share2 * slope * slope;
                store_anywhere(first + j, mean);
                store_anywhere(second + j, square);
                const Floats move = step * mean / (square_root(unbias * square) + epsilon);
                store_anywhere(value + j, load_anywhere(value + j) - move);
            }
            for (; j < width; ++j) {
                first[j] = decay1 * first[j] + share1 * g[j];
                second[j] = decay2 * second[j] + share2 * g[j] * g[j];
                value[j] -= step * first[j] / (std::sqrt(unbias * second[j]) + epsilon);
            }
        }
    });
}

}  // namespace splash
