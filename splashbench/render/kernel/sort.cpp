// Step 2: splats from front to back, those of equal depth in the caller's order.
//
// A radix sort, least significant digit first, of the depths' bits; as many digits as the depths' range has. Each thread
// keeps a part of the rows and a histogram of its own, so the result is the same for any number of threads.

#include <algorithm>

#include "frame.h"
#include "native/threads.h"

namespace splash {
namespace {

constexpr int DIGIT_BITS = 11;
constexpr int DIGITS = 1 << DIGIT_BITS;
// Fewer rows than these are not worth a second thread.
constexpr int64_t ROWS_PER_THREAD = 4096;

// Collects the drawn rows in the caller's order; returns the least and the largest key.
void collect(Frame& frame, uint32_t& least, uint32_t& largest) {
    const int64_t count = frame.gaussians.count;
    const int parts = frame.threads;
    int64_t starts[MAX_THREADS + 1] = {0};
    uint32_t low[MAX_THREADS], high[MAX_THREADS];
    in_parts(parts, count, [&](int64_t begin, int64_t end, int part) {
        int64_t drawn_rows = 0;
        uint32_t first = NOT_DRAWN, last = 0;
        for (int64_t i = begin; i < end; ++i) {
            const uint32_t key = frame.keys[i];
            const bool drawn = key != NOT_DRAWN;
            drawn_rows += drawn;
            first = std::min(first, key);
            last = drawn ? std::max(last, key) : last;
        }
        starts[part + 1] = drawn_rows;
        low[part] = first;
        high[part] = last;
    });
    for (int part = 0; part < parts; ++part) starts[part + 1] += starts[part];
    frame.drawn = starts[parts];
    least = *std::min_element(low, low + parts);
    largest = *std::max_element(high, high + parts);
    frame.items.fit(frame.drawn);
    frame.other_items.fit(frame.drawn);
    in_parts(parts, count, [&](int64_t begin, int64_t end, int part) {
        SortItem* item = frame.items.data() + starts[part];
        for (int64_t i = begin; i < end; ++i) {
            if (frame.keys[i] != NOT_DRAWN) *item++ = {frame.keys[i] - least, static_cast<int32_t>(i)};
        }
    });
}

void sort_by_digit(Frame& frame, int shift, int parts) {
    int64_t* const histograms = frame.histograms.fit(static_cast<size_t>(parts) * DIGITS);
    const auto digit = [shift](uint32_t key) { return (key >> shift) & (DIGITS - 1); };
    in_parts(parts, frame.drawn, [&](int64_t begin, int64_t end, int part) {
        int64_t* const histogram = histograms + static_cast<size_t>(part) * DIGITS;
        std::fill(histogram, histogram + DIGITS, 0);
        for (int64_t k = begin; k < end; ++k) ++histogram[digit(frame.items[k].key)];
    });
    int64_t next = 0;
    for (int value = 0; value < DIGITS; ++value) {
        for (int part = 0; part < parts; ++part) {
            int64_t& place = histograms[static_cast<size_t>(part) * DIGITS + value];
            const int64_t here = place;
            place = next;
            next += here;
        }
    }
    in_parts(parts, frame.drawn, [&](int64_t begin, int64_t end, int part) {
        int64_t* const places = histograms + static_cast<size_t>(part) * DIGITS;
        for (int64_t k = begin; k < end; ++k) {
            const SortItem item = frame.items[k];
            frame.other_items[places[digit(item.key)]++] = item;
        }
    });
    frame.items.swap(frame.other_items);
}

void gather(Frame& frame) {
    const SplashGaussians& g = frame.gaussians;
    frame.splats.fit(frame.drawn);
    frame.ranks.fit(g.count);
    if (frame.table_colors) frame.channel_table.fit(static_cast<size_t>(frame.drawn) * frame.channels);
    in_parts(frame.threads, frame.drawn, [&](int64_t begin, int64_t end, int) {
        for (int64_t k = begin; k < end; ++k) {
            const int32_t id = frame.items[k].id;
            if (k + 8 < end) __builtin_prefetch(&frame.projected[frame.items[k + 8].id]);
            frame.splats[k] = frame.projected[id];
            frame.ranks[id] = static_cast<int32_t>(k);
            if (!frame.table_colors) continue;
            float* const row = frame.channel_table.data() + k * frame.channels;
            for (int channel = 0; channel < g.channels; ++channel) {
                row[channel] = g.colors[static_cast<int64_t>(id) * g.channels + channel];
            }
            if (frame.with_depth) row[g.channels] = frame.splats[k].depth;
        }
    });
}

}  // namespace

void sort_by_depth(Frame& frame) {
    uint32_t least = 0, largest = 0;
    collect(frame, least, largest);
    const int parts = static_cast<int>(std::clamp<int64_t>(frame.drawn / ROWS_PER_THREAD, 1, frame.threads));
    for (int shift = 0; shift < 32 && frame.drawn > 1 && (largest - least) >> shift != 0; shift += DIGIT_BITS) {
        sort_by_digit(frame, shift, parts);
    }
    gather(frame);
}

}  // namespace splash
