// The threads behind threads.h: started once, woken for each call. They spin for some microseconds before they sleep,
// because the steps of one frame follow each other faster than a sleeping thread wakes.

#include "threads.h"

#include <pthread.h>

#include <condition_variable>
#include <mutex>
#include <new>
#include <system_error>
#include <thread>

namespace splash {
namespace {

inline void pause() { __builtin_ia32_pause(); }

constexpr int SPINS = 2000;

class Pool {
  public:
    // False where the pool is busy; nothing was done then.
    bool run(int workers, void (*work)(void*, int), void* argument) {
        std::unique_lock<std::mutex> turn(busy_, std::try_to_lock);
        if (!turn.owns_lock()) return false;
        start_threads(workers - 1);
        uint64_t number;
        {
            std::lock_guard<std::mutex> lock(mutex_);
            work_ = work;
            argument_ = argument;
            failed_.store(false, std::memory_order_relaxed);
            unfinished_.store(workers, std::memory_order_relaxed);
            number = call_.load(std::memory_order_relaxed) + 1;
            unclaimed_.store(number << WORKER_BITS | static_cast<uint64_t>(workers), std::memory_order_release);
            call_.store(number, std::memory_order_release);
        }
        wake_.notify_all();
        take_part(number);
        for (int spin = 0; spin < SPINS && unfinished_.load(std::memory_order_acquire) != 0; ++spin) pause();
        if (unfinished_.load(std::memory_order_acquire) != 0) {
            std::unique_lock<std::mutex> lock(mutex_);
            done_.wait(lock, [&] { return unfinished_.load(std::memory_order_acquire) == 0; });
        }
        if (failed_.load(std::memory_order_relaxed)) throw std::bad_alloc();
        return true;
    }

  private:
    // Where the system gives no more threads, those that are there do all the work.
    void start_threads(int count) {
        while (threads_ < count) {
            try {
                std::thread(&Pool::loop, this, call_.load(std::memory_order_relaxed)).detach();
            } catch (const std::system_error&) {
                break;
            }
            ++threads_;
        }
    }

    // Does the work of workers that nobody has claimed yet. Whoever comes first claims the most, the caller often all of
    // them: a thread that the system wakes late, because the processors are busy, is not waited for.
    void take_part(uint64_t number) {
        uint64_t left = unclaimed_.load(std::memory_order_acquire);
        while (left >> WORKER_BITS == number && (left & WORKER_MASK) != 0) {
            if (!unclaimed_.compare_exchange_weak(left, left - 1, std::memory_order_acq_rel)) continue;
            try {
                work_(argument_, static_cast<int>((left & WORKER_MASK) - 1));
            } catch (...) {
                failed_.store(true, std::memory_order_relaxed);
            }
            if (unfinished_.fetch_sub(1, std::memory_order_acq_rel) == 1) {
                std::lock_guard<std::mutex> lock(mutex_);
                done_.notify_one();
            }
            left = unclaimed_.load(std::memory_order_acquire);
        }
    }

    void loop(uint64_t seen) {
        for (;;) {
            for (int spin = 0; spin < SPINS && call_.load(std::memory_order_acquire) == seen; ++spin) pause();
            if (call_.load(std::memory_order_acquire) == seen) {
                std::unique_lock<std::mutex> lock(mutex_);
                wake_.wait(lock, [&] { return call_.load(std::memory_order_acquire) != seen; });
            }
            seen = call_.load(std::memory_order_acquire);
            take_part(seen);
        }
    }

    // Workers left to claim in the low bits, the call's number above: a thread that comes late finds another number.
    static constexpr int WORKER_BITS = 8;
    static constexpr uint64_t WORKER_MASK = (uint64_t(1) << WORKER_BITS) - 1;
    static_assert(MAX_THREADS <= int(WORKER_MASK), "the workers of a call are counted in WORKER_BITS");

    std::mutex busy_, mutex_;
    std::condition_variable wake_, done_;
    std::atomic<uint64_t> call_{0}, unclaimed_{0};
    std::atomic<int> unfinished_{0};
    std::atomic<bool> failed_{false};
    void (*work_)(void*, int) = nullptr;
    void* argument_ = nullptr;
    int threads_ = 0;
};

// Never freed: its threads run until the process ends. A forked child has no threads and begins with a new pool.
std::atomic<Pool*> pool{nullptr};

Pool* current_pool() {
    Pool* current = pool.load(std::memory_order_acquire);
    if (current != nullptr) return current;
    Pool* const created = new Pool;
    if (pool.compare_exchange_strong(current, created)) {
        static std::once_flag once;
        std::call_once(once, [] { pthread_atfork(nullptr, nullptr, [] { pool.store(nullptr); }); });
        return created;
    }
    delete created;
    return current;
}

}  // namespace

void run_on_workers(int workers, void (*work)(void*, int), void* argument) {
    if (current_pool()->run(workers, work, argument)) return;
    for (int worker = 0; worker < workers; ++worker) work(argument, worker);
}

}  // namespace splash
