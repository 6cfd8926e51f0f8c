// Sums of rows of tables that carriers share, and gradients summed by what is shared.

#include "shared.h"

#include <algorithm>

#include "native/simd.h"
#include "native/threads.h"

namespace splash {
namespace {

// Fewer rows than these are not worth a second thread.
constexpr int64_t ROWS_PER_PIECE = 1024;
// Rows lie all over the tables: each is asked for so many rows ahead, and what says where it lies twice as far.
constexpr int64_t AHEAD = 8;

inline void prefetch_row(const float* row, int64_t width) {
    for (int64_t j = 0; j < width; j += 16) prefetch(row + j);
}

inline void add_row(float* sum, const float* row, int64_t width) {
    int64_t j = 0;
    for (; j + LANES <= width; j += LANES) store_anywhere(sum + j, load_anywhere(sum + j) + load_anywhere(row + j));
    for (; j < width; ++j) sum[j] += row[j];
}

}  // namespace

void sum_rows(const SplashSharedRows& shared, int64_t count, const int64_t* ids, float* sums, int threads) {
    const int64_t width = shared.width;
    in_pieces(threads, count, ROWS_PER_PIECE, [&](int64_t begin, int64_t end, int) {
        for (int64_t i = begin; i < end; ++i) {
            if (i + 2 * AHEAD < end) {
                for (int level = 0; level < shared.levels; ++level) prefetch(shared.cells[level] + ids[i + 2 * AHEAD]);
            }
            if (i + AHEAD < end) {
                const int64_t later = ids[i + AHEAD];
                prefetch_row(shared.own + later * width, width);
                for (int level = 0; level < shared.levels; ++level) {
                    prefetch_row(shared.tables[level] + shared.cells[level][later] * width, width);
                }
            }
            float* const sum = sums + i * width;
            const float* const own = shared.own + ids[i] * width;
            std::copy(own, own + width, sum);
            for (int level = 0; level < shared.levels; ++level) {
                add_row(sum, shared.tables[level] + shared.cells[level][ids[i]] * width, width);
            }
        }
    });
}

void add_by_member(int64_t count, int64_t width, const int64_t* places, const int32_t* members, const float* rows,
                   int64_t groups, float* sums) {
    std::fill(sums, sums + groups * width, 0.0f);
    const auto member = [&](int64_t i) -> int64_t { return members[places == nullptr ? i : places[i]]; };
    for (int64_t i = 0; i < count; ++i) {
        if (i + AHEAD < count) prefetch_row(sums + member(i + AHEAD) * width, width);
        add_row(sums + member(i) * width, rows + i * width, width);
    }
}

}  // namespace splash
