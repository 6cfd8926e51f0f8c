// Work on several threads. What a piece of work computes must not depend on which thread runs it, or on how many do.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>

namespace splash {

constexpr int MAX_THREADS = 64;

// How many workers a caller that asks for so many threads gets.
inline int workers(int threads) { return std::clamp(threads, 1, MAX_THREADS); }

// Calls work(argument, worker) for every worker in [0, workers), on this thread and on others that are kept between calls,
// and waits. One thread may do the work of several workers, one after another; it does all of it while another caller uses
// the threads. So work must not wait for other workers. Rethrows std::bad_alloc.
void run_on_workers(int workers, void (*work)(void*, int), void* argument);

template <class Work>
void on_workers(int workers, Work&& work) {
    if (workers <= 1) {
        work(0);
        return;
    }
    run_on_workers(
        workers, [](void* argument, int worker) { (*static_cast<Work*>(argument))(worker); },
        const_cast<void*>(static_cast<const void*>(&work)));
}

// work(begin, end, worker) for one contiguous part of [0, count) per worker.
template <class Work>
void in_parts(int workers, int64_t count, Work&& work) {
    on_workers(workers, [&](int worker) {
        work(count * worker / workers, count * (worker + 1) / workers, worker);
    });
}

// work(begin, end, worker) for pieces of `grain` elements, taken as the workers get to them.
template <class Work>
void in_pieces(int workers, int64_t count, int64_t grain, Work&& work) {
    if (count <= grain) workers = 1;
    std::atomic<int64_t> next(0);
    on_workers(workers, [&](int worker) {
        for (;;) {
            const int64_t begin = next.fetch_add(grain);
            if (begin >= count) break;
            work(begin, std::min(count, begin + grain), worker);
        }
    });
}

}  // namespace splash
